"""Samples into pixels, weighted by the film's reconstruction filter.

Every sample counts for all pixels that the filter reaches from it, 25 with Mitsuba's default.
Adding it to each of them (``ImageBlock.put``) takes a third of the time of a sparse pass. But lanes
come in the order of their pixels, so that pixels can ask for samples instead, without atomic
additions, in two steps, f being separable:

    A_d(r, c) = Σ f(x − c) f(y − (r + d)) v     over the samples of row r from column c − R to c + R
    I(t, c)   = Σ_d A_d(t − d, c)               d = −R … R

The samples of the first sum lie next to each other in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .allotment import Lanes

# Pixels of a band of rows that is summed at once: bounds the memory of A.
_BAND = 1 << 18


def image(film, lanes: Lanes, position, channels: Sequence[Any], box: bool = False):
    """Σ w v of every pixel of the film's crop window, (height, width, channels) as TensorXf.

    position  of the samples on the film, each within its pixel.
    channels  values of the samples, and last their weight (mi.Float).
    box       weighted by a box filter, not by the film's.
    """
    rfilter = film.rfilter()
    width, height = (int(n) for n in film.crop_size())
    edge = rfilter.border_size() if film.sample_border() else 0
    if box or rfilter.is_box_filter():
        grid = _Grid(film.crop_offset(), width, edge, 0, lambda d: mi.Float(1))
    else:
        reach = math.ceil(rfilter.radius() - 0.5)
        grid = _Grid(film.crop_offset(), width, edge, reach, rfilter.eval)
    dr.eval(position, list(channels), lanes.weight)
    total = dr.zeros(mi.Float, height * width * len(channels))
    # Rows of the picture in which the first and the last of the samples lie.
    first, last = ((n // grid.wide) - edge for n in (lanes.first, lanes.first + lanes.pixels - 1))
    top, bottom = max(first - grid.reach, 0), min(last + grid.reach + 1, height)
    step = max(1, _BAND // width)
    for t in range(top, bottom, step):
        end = min(t + step, bottom)
        low, high = max(t - grid.reach, first), min(end + grid.reach, last + 1)
        sums = _along_rows(grid, low, high, lanes, position, channels)
        _across_rows(grid, low, high, sums, t, end, total)
    return mi.TensorXf(total, (height, width, len(channels)))


@dataclass(frozen=True)
class _Grid:
    """Pixels of a picture, out of those that are sampled, ``edge`` more on each side.

    corner  of the picture on the film; width: of its rows, in pixels.
    reach   R; window: f.
    """

    corner: Any
    width: int
    edge: int
    reach: int
    window: Callable[[Any], Any]

    @property
    def wide(self) -> int:
        """Of the rows that are sampled."""
        return self.width + 2 * self.edge

    @property
    def offsets(self) -> range:
        """d."""
        return range(-self.reach, self.reach + 1)


@dr.syntax
def _along_rows(grid, low, high, lanes, position, channels) -> list[Any]:
    """A of the rows low to high, for every d and every channel, in this order."""
    lane = dr.arange(mi.UInt32, (high - low) * grid.width)
    width = dr.opaque(mi.UInt32, grid.width)
    row = lane // width
    column = lane - row * width
    x = mi.Float(column) + (dr.opaque(mi.Float, grid.corner.x) + 0.5)
    y = mi.Float(row) + (dr.opaque(mi.Float, grid.corner.y + low) + 0.5)

    # --- Pixels from c − R to c + R, and their samples ---
    begin = mi.Int32(column) + dr.opaque(mi.Int32, grid.edge - grid.reach)
    end = dr.minimum(begin + len(grid.offsets), dr.opaque(mi.Int32, grid.wide))
    start = mi.Int32(row * dr.opaque(mi.UInt32, grid.wide))
    start += dr.opaque(mi.Int32, (low + grid.edge) * grid.wide - lanes.first)
    pixels = dr.opaque(mi.Int32, lanes.pixels)
    begin, end = (
        lanes.begin(mi.UInt32(dr.clip(start + pixel, 0, pixels)))
        for pixel in (dr.maximum(begin, 0), end)
    )

    window, offsets, extra = grid.window, grid.offsets, lanes.weight
    of = lambda values, k: values if dr.width(values) == 1 else dr.gather(mi.Float, values, k)  # noqa: E731
    sums = [mi.Float(0) for _ in range(len(offsets) * len(channels))]
    while dr.hint(begin < end, label="reconstruction filter"):
        at = dr.gather(mi.Point2f, position, begin)
        weight = window(at.x - x)
        if dr.hint(extra is not None, mode="scalar"):
            weight *= of(extra, begin)
        values = [weight * of(channel, begin) for channel in channels]
        for d in offsets:
            down = window(at.y - y - d)
            for k in range(len(values)):
                j = (d - offsets[0]) * len(values) + k
                sums[j] = dr.fma(down, values[k], sums[j])
        begin += 1
    dr.eval(sums)
    return sums


def _across_rows(grid, low, high, sums, top, bottom, total):
    """Σ_d A_d of rows ``top`` to ``bottom``, into ``total``. sums: A of the rows low to high."""
    channels = len(sums) // len(grid.offsets)
    lane = dr.arange(mi.UInt32, (bottom - top) * grid.width)
    width = dr.opaque(mi.Int32, grid.width)
    row = mi.Int32(lane) // width + dr.opaque(mi.Int32, top - low)
    rows = dr.opaque(mi.Int32, high - low)
    start = mi.Int32(lane) + dr.opaque(mi.Int32, (top - low) * grid.width)
    found = [mi.Float(0) for _ in range(channels)]
    for d in grid.offsets:
        active = (row >= d) & (row < rows + d)
        source = mi.UInt32(start - d * width)
        for k in range(channels):
            column = sums[(d + grid.reach) * channels + k]
            found[k] += dr.gather(mi.Float, column, source, active)
    dr.scatter(total, mi.ArrayXf(found), lane + dr.opaque(mi.UInt32, top * grid.width))
    dr.eval(total)
