"""Light that few samples gather for many, evened out over their pixels.

Where one sample in eight gathers, with the weight 8, reconstruction filters see few bright samples
among many dark ones: g (Σ f w/Σ f − 1) is noise, however even the gathered light g is. So each
sample with the weight w (n/c, or 0: see ``thinning``) also gets (1 − w) ĝ, a control variate: ĝ is
what the gathers of the pixels around its own found. Those are chosen independently of it, and the
mean of w is 1, so that the mean of the picture stays exactly what it is, and what is left of
the noise is that of w (g − ĝ).

Of the four sides of a pixel ĝ is the darkest, and 0 where nothing is gathered on two of them: at
edges of dark things w g + (1 − w) ĝ would be far below zero. What remains of that is gone after a
few samples; sums over passes and layers keep it, pictures show it as black where nothing else can
be below zero (see ``film.show``).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.thinning import Thinning
from .allotment import Lanes

# Pixels on each side of a pixel: (columns, rows) away.
_ACROSS = -1, 0, 1
_SIDES = [
    [(side, d) if along else (d, side) for d in _ACROSS] for along in (0, 1) for side in (-1, 1)
]


@dataclass
class Evening:
    """For one wavefront. wide: pixels of a row of the film."""

    thinning: Thinning
    lanes: Lanes
    wide: int

    def __call__(self, gathered, *parts):
        """(1 − w) ĝ of each lane. gathered: what each lane gathers, its weight included.

        Returns a list: that of ``gathered``, and of parts of it, with the ĝ of the same sides, so
        that parts that add up still do.
        """
        gathers, worth = self.thinning.chosen()
        weight = dr.select(gathers, worth, 0)
        dr.eval(gathered, *parts, weight)
        weights, *lights = (self._in_pixels(v) for v in (weight, gathered, *parts))
        dr.eval(weights, lights)
        around = self._around(weights, *lights)
        dr.eval(around)
        pixel = self.lanes.pixel - dr.opaque(mi.UInt32, self.lanes.first)
        return [(1 - weight) * dr.gather(mi.Spectrum, light, pixel) for light in around]

    @dr.syntax
    def _in_pixels(self, values):
        """Sums over the lanes of each pixel."""
        pixel = dr.arange(mi.UInt32, self.lanes.pixels)
        begin, end = self.lanes.begin(pixel), self.lanes.begin(pixel + 1)
        total = dr.zeros(type(values))
        while dr.hint(begin < end, label="samples of a pixel"):
            total += dr.gather(type(values), values, begin)
            begin += 1
        return total

    def _around(self, weights, light, *parts):
        """ĝ of each pixel, and the parts of it: lists."""
        pixels = dr.opaque(mi.Int32, self.lanes.pixels)
        wide = dr.opaque(mi.Int32, self.wide)
        pixel = dr.arange(mi.Int32, self.lanes.pixels)
        column = (pixel + dr.opaque(mi.Int32, self.lanes.first)) % wide
        missing, least = mi.UInt32(0), mi.Spectrum(dr.inf)
        least_parts = [dr.zeros(mi.Spectrum) for _ in parts]
        for side in _SIDES:
            total_weight, outside = mi.Float(0), mi.Bool(True)
            totals = [dr.zeros(mi.Spectrum) for _ in (light, *parts)]
            for dx, dy in side:
                other = pixel + dy * wide + dx
                there = (column + dx >= 0) & (column + dx < wide) & (other >= 0) & (other < pixels)
                index = mi.UInt32(dr.select(there, other, 0))
                totals = [
                    total + dr.gather(mi.Spectrum, values, index, there)
                    for total, values in zip(totals, (light, *parts), strict=True)
                ]
                total_weight += dr.gather(mi.Float, weights, index, there)
                outside &= ~there
            some = total_weight > 0
            some &= dr.all(dr.isfinite(totals[0]))
            mean, *mean_parts = (total / total_weight for total in totals)
            darker = some & (mean < least)  # of each colour
            least = mi.Spectrum(dr.select(darker, mean, least))
            least_parts = [
                mi.Spectrum(dr.select(darker, part, best))
                for part, best in zip(mean_parts, least_parts, strict=True)
            ]
            missing += dr.select(some | outside, mi.UInt32(0), 1)
        known = dr.isfinite(least) & (missing < 2)
        # ``dr.select`` makes another type of some spectra.
        return [mi.Spectrum(dr.select(known, v, 0)) for v in (least, *least_parts)]
