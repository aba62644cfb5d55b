"""Which eye paths read the photon map: a share of them, with the weight 1/share.

Samples of a pixel read much the same photons. Sample k of a pixel gathers where frac(k φ + ξ) <
share, φ the golden ratio and ξ random for the pixel: each sample with the same chance, so that the
mean is right, and of any number of consecutive samples that share within one or two, however they
are spread over wavefronts and passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Thinning:
    """The choice for one wavefront.

    share   of the paths, above 0 and at most 1, of each lane.
    seed    of the choice.
    pixel   of each lane; sample: its number among the pixel's samples.
    """

    share: Any
    seed: Any
    pixel: Any
    sample: Any

    @staticmethod
    def of(share, seed: int, pixel, sample) -> Thinning:
        """share: of each pixel (mi.Float)."""
        share = dr.gather(mi.Float, share, pixel)
        return Thinning(share, dr.opaque(mi.UInt32, seed), pixel, sample)

    def chosen(self):
        """Does the path of each lane gather?"""
        start, _ = mi.sample_tea_32(self.pixel, self.seed, 8)  # with 4 rounds pixels are alike
        u = mi.Float((self.sample * 0x9E3779B9 + start) >> 8) * 2.0**-24
        return u < self.share
