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
from collections.abc import Sequence
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
    box = box or rfilter.is_box_filter()
    reach = 0 if box else math.ceil(rfilter.radius() - 0.5)
    window = lambda d: mi.Float(1) if box else rfilter.eval(d)  # noqa: E731
    width, height = (int(n) for n in film.crop_size())
    corner = film.crop_offset()
    edge = rfilter.border_size() if film.sample_border() else 0
    wide = width + 2 * edge  # of the rows that are sampled

    dr.eval(position, list(channels), lanes.weight)
    total = dr.zeros(mi.Float, height * width * len(channels))
    first, last = lanes.first // wide - edge, (lanes.first + lanes.pixels - 1) // wide - edge
    top, bottom = max(first - reach, 0), min(last + reach + 1, height)
    step = max(1, _BAND // width)
    for t in range(top, bottom, step):
        # Rows t to t + rows of the picture, out of those from ``low`` to ``high`` of samples.
        rows = min(step, bottom - t)
        low, high = max(t - reach, first), min(t + rows + reach, last + 1)
        sums = _along_rows(
            lanes, position, channels, window, reach, low, high, width, wide, edge, corner
        )
        _across(total, sums, reach, low, high, t, rows, width)
    return mi.TensorXf(total, (height, width, len(channels)))


@dr.syntax
def _along_rows(
    lanes, position, channels, window, reach, low, high, width, wide, edge, corner
) -> list[Any]:
    """A of the rows low to high: for d = −R … R and every channel, in this order."""
    lane = dr.arange(mi.UInt32, (high - low) * width)
    across = dr.opaque(mi.UInt32, width)
    row = lane // across
    column = lane - row * across
    x = mi.Float(column) + (dr.opaque(mi.Float, corner.x) + 0.5)
    y = mi.Float(row) + (dr.opaque(mi.Float, corner.y + low) + 0.5)

    # --- Pixels from c − R to c + R, and their samples ---
    begin = dr.opaque(mi.Int32, edge - reach) + mi.Int32(column)
    end = dr.minimum(begin + (2 * reach + 1), dr.opaque(mi.Int32, wide))
    row_begins = mi.Int32(row * dr.opaque(mi.UInt32, wide))
    row_begins += dr.opaque(mi.Int32, (low + edge) * wide - lanes.first)
    pixels = dr.opaque(mi.Int32, lanes.pixels)
    begin, end = (
        mi.UInt32(dr.clip(row_begins + pixel, 0, pixels)) for pixel in (dr.maximum(begin, 0), end)
    )
    sample, end = lanes.begin(begin), lanes.begin(end)

    extra: Any = lanes.weight
    of = lambda column, k: column if dr.width(column) == 1 else dr.gather(mi.Float, column, k)  # noqa: E731
    sums = [mi.Float(0) for _ in range((2 * reach + 1) * len(channels))]
    while dr.hint(sample < end, label="reconstruction filter"):
        at = dr.gather(mi.Point2f, position, sample)
        weight = window(at.x - x)
        if dr.hint(extra is not None, mode="scalar"):
            weight *= of(extra, sample)
        values = [weight * of(channel, sample) for channel in channels]
        for d in range(2 * reach + 1):
            down = window(at.y - y - (d - reach))
            for k in range(len(values)):
                j = d * len(values) + k
                sums[j] = dr.fma(down, values[k], sums[j])
        sample += 1
    dr.eval(sums)
    return sums


def _across(total, sums, reach, low, high, t, rows, width):
    """Σ_d A_d of rows t to t + rows, into ``total``."""
    channels = len(sums) // (2 * reach + 1)
    lane = dr.arange(mi.UInt32, rows * width)
    across = dr.opaque(mi.Int32, width)
    row = mi.Int32(lane) // across + dr.opaque(mi.Int32, t - low)
    inside = dr.opaque(mi.Int32, high - low)
    start = mi.Int32(lane) + dr.opaque(mi.Int32, (t - low) * width)
    found = [mi.Float(0) for _ in range(channels)]
    for d in range(-reach, reach + 1):
        active = (row >= d) & (row < inside + d)
        for k in range(channels):
            column = sums[(d + reach) * channels + k]
            found[k] += dr.gather(mi.Float, column, mi.UInt32(start - d * across), active)
    dr.scatter(total, mi.ArrayXf(found), lane + dr.opaque(mi.UInt32, t * width))
    dr.eval(total)
