"""Which eye paths read the photon map: a share of them, with the weight 1/share.

Samples of a pixel read much the same photons. Of its n samples in a pass c gather, the same number
whatever wavefronts they are in: with chance, c would add its own noise to all that is gathered.
c is n share, rounded down or up so often that it is right in the mean over passes. Those c samples
follow one another in the sequence of the pixel, from a random one on, so that they are as well
stratified as all of them; behind the last comes the first again. Each has the weight n/c, and the
same chance c/n. Where n share is less than one, c is 0 or 1, and the weight 1/share.

What is random is independent from pixel to pixel and from pass to pass (see ``evening``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Thinning:
    """The choice for one wavefront. Arrays of all lanes.

    share   of the paths, above 0 and at most 1.
    random  two numbers for each pixel and pass, 32 bits.
    place   of the sample among those of its pixel in the pass; of: so many are these.
    """

    share: Any
    random: tuple[Any, Any]
    place: Any
    of: Any

    @staticmethod
    def of_pass(share, seed: int, pixel, place, of) -> Thinning:
        """share: of each pixel (mi.Float). seed: of the pass."""
        share = dr.gather(mi.Float, share, pixel)
        # With 4 rounds pixels are alike.
        random = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, seed), 8)
        return Thinning(share, random, place, of)

    def chosen(self):
        """(does the path of each lane gather?, for how many?)"""
        rounding, first = (mi.Float(number >> 8) * 2.0**-24 for number in self.random)
        n = mi.Float(self.of)
        c = dr.minimum(mi.UInt32(n * self.share + rounding), self.of)
        place = self.place + dr.minimum(mi.UInt32(first * n), self.of - 1)
        place = dr.select(place < self.of, place, place - self.of)
        few = n * self.share < 1
        return place < c, dr.select(few, dr.rcp(self.share), n / mi.Float(dr.maximum(c, 1)))
