"""Which eye paths read the photon map: a share of them, with the weight 1/share.

Samples of a pixel read much the same photons. Of its n samples in a pass c gather, the same number
whatever wavefronts they are in: with chance, c would add its own noise to all that is gathered.
c is n share, rounded down or up so often that it is right in the mean over passes. Those c samples
follow one another in the sequence of the pixel, from a random one on, so that they are as well
stratified as all of them; behind the last comes the first again. Each has the weight n/c, and the
same chance c/n. Where n share is less than one, c is 0 or 1, and the weight 1/share.

Rounding and first sample are, for each pixel, random and then stratified over the passes, as
the sequence frac(index (1/g, 1/g²)) with g³ = g + 1 (Roberts 2018, "The unreasonable effectiveness
of quasirandom sequences") is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

# 2³² (1/g, 1/g²)
_STEPS = 0xC13FA9A9, 0x91E10DA5


@dataclass
class Thinning:
    """The choice for one wavefront. Arrays of all lanes.

    share  of the paths, above 0 and at most 1.
    start  numbers of the pixel and the pass, as two 32-bit fractions.
    place  of the sample among those of its pixel in the pass.
    of     so many are these.
    """

    share: Any
    start: tuple[Any, Any]
    place: Any
    of: Any

    @staticmethod
    def of_pass(share, seed: int, index: int, pixel, place, of) -> Thinning:
        """share: of each pixel (mi.Float). seed: of the rendering; index: of the pass."""
        share = dr.gather(mi.Float, share, pixel)
        seed, index = (dr.opaque(mi.UInt32, number) for number in (seed, index))
        a, b = mi.sample_tea_32(pixel, seed, 8)  # with 4 rounds pixels are alike
        return Thinning(share, (a + index * _STEPS[0], b + index * _STEPS[1]), place, of)

    def chosen(self):
        """(does the path of each lane gather, and for how many others?)"""
        rounding, first = (mi.Float(number >> 8) * 2.0**-24 for number in self.start)
        n = mi.Float(self.of)
        c = dr.minimum(mi.UInt32(n * self.share + rounding), self.of)
        place = self.place + dr.minimum(mi.UInt32(first * n), self.of - 1)
        place = dr.select(place < self.of, place, place - self.of)
        few = n * self.share < 1
        return place < c, dr.select(few, dr.rcp(self.share), n / mi.Float(dr.maximum(c, 1)))
