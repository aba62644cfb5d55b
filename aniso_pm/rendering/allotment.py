"""Which pixel gets how many eye samples in a pass, and the lanes that trace them.

Pixel p takes n_p samples in every pass, on average n of them, more where a pilot saw more noise
(see ``survey``). Each sample goes into the film with the weight n/n_p: density times weight is the
same everywhere, so that reconstruction filters see what they would with even samples, and every
n_p >= 1 converges to the same picture. n_p does not depend on the pass: the stratified sequence of
a pixel goes on from pass to pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own

# Samples of a pixel as multiples of the mean: the fewest and the most.
LEAST, MOST = 0.25, 8.0
# The fewest in the mean that can be uneven.
FEW = 4
# Uneven wavefronts are filled so far, because their sizes differ a little.
_FULL, _GOLDEN = 0.95, 0.5 * (5**0.5 - 1)


@dataclass(frozen=True)
class Lanes:
    """One wavefront of eye samples: of ``pixels`` pixels from number ``first`` on, in this order.

    pixel   number of the pixel, row by row from the film's border on.
    sample  number of the sample in the sequence of its pixel.
    place   the same, counted from the first of this pass; of: samples of the pixel in the pass.
    weight  with which it goes into the film; None: 1.
    count   lanes.
    starts  first lane of each of the pixels, and ``count``; a number: so many lanes a pixel.
    """

    pixel: Any
    sample: Any
    place: Any
    of: Any
    weight: Any
    count: int
    first: int
    pixels: int
    starts: Any

    def begin(self, index):
        """First lane of a pixel, counted from the first of this wavefront; ``count`` behind all."""
        if isinstance(self.starts, int):
            return index * dr.opaque(mi.UInt32, self.starts)
        return dr.gather(mi.UInt32, self.starts, index)


@dataclass(frozen=True)
class Allotment:
    """Samples of ``pixels`` pixels in a pass: ``each`` in the mean; ``counts`` (integers) says how
    many pixel by pixel, None: all alike."""

    pixels: int
    each: int
    counts: np.ndarray | None = None
    _kept: dict[Any, tuple] = field(default_factory=dict, repr=False)  # lanes of the last wavefront

    def wavefronts(self, index: int, more: int, before: int, most: int) -> Iterator[tuple]:
        """(Lanes, share of the pass that is done after them) of pass ``index``.

        more    samples that every pixel takes in this pass beyond its number.
        before  such samples in all passes before.
        most    lanes of a wavefront, about. Fewer than there are pixels: parts of the film.
        """
        n: Any = (self.each if self.counts is None else self.counts) + more
        largest = int(np.max(n))
        at_once = min(self.pixels, most)
        if at_once < self.pixels:
            slices = largest
        elif self.counts is None:
            slices = -(-largest // (most // self.pixels))
        else:
            count = int(n.sum())
            slices = 1 if count <= most else min(largest, math.ceil(count / (_FULL * most)))
        # Pixels with as many samples take them in different slices: all slices are about as large.
        shift: Any = 0
        if self.counts is not None and slices > 1:
            shift = (np.arange(self.pixels) * _GOLDEN % 1 * slices).astype(np.int64)
        for part in range(slices):
            low, high = ((n * k + shift) // slices for k in (part, part + 1))
            for first in range(0, self.pixels, at_once):
                some = min(at_once, self.pixels - first)
                done = (part + (first + some) / self.pixels) / slices
                if self.counts is None:
                    begin = index * self.each + before
                    yield self._even(first, some, begin, low, high - low, n), done
                    continue
                here = slice(first, first + some)
                if not (high - low)[here].any():
                    continue
                start = index * self.counts[here] + before
                part_of = low[here], (high - low)[here]
                yield self._uneven(first, start, *part_of, n[here], more), done

    def _even(self, first, pixels, start, low, each, n) -> Lanes:
        """``each`` samples of the n of a pass, from ``low`` on; start: number of its first."""
        count = pixels * each
        lane, divisor = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, each)
        pixel = lane // divisor
        place = lane - pixel * divisor + dr.opaque(mi.UInt32, low)
        sample = place + dr.opaque(mi.UInt32, start)
        pixel += dr.opaque(mi.UInt32, first)
        of = dr.opaque(mi.UInt32, n, count)
        return Lanes(pixel, sample, place, of, None, count, first, pixels, each)

    def _uneven(self, first, start, low, counts, n, more) -> Lanes:
        """As ``_even``, of each pixel; all but ``start`` is the same in every pass."""
        key = (first, more, low.tobytes(), counts.tobytes())
        if key not in self._kept:
            self._kept.clear()
            pixel = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
            place = np.arange(len(pixel), dtype=np.uint32)
            starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
            place += np.repeat(low.astype(np.uint32) - starts[:-1], counts)
            weight = np.repeat(((self.each + more) / n).astype(np.float32), counts)
            self._kept[key] = (
                own(mi.UInt32, pixel),
                own(mi.UInt32, place),
                own(mi.UInt32, np.repeat(n, counts).astype(np.uint32)),
                own(mi.Float, weight),
                own(mi.UInt32, starts),
            )
        pixel, place, of, weight, starts = self._kept[key]
        sample = dr.gather(mi.UInt32, own(mi.UInt32, start.astype(np.uint32)), pixel) + place
        count = dr.width(pixel)
        pixel = pixel + dr.opaque(mi.UInt32, first)
        return Lanes(pixel, sample, place, of, weight, count, first, len(counts), starts)


def in_proportion(noise: np.ndarray, each: int) -> np.ndarray | None:
    """Samples of each pixel in proportion to ``noise``, exactly ``each`` in the mean; None where
    that is too little to tell pixels apart."""
    if each < FEW or not noise.mean() > 0:
        return None
    share = noise / noise.mean()
    for _ in range(8):  # bounds and mean together
        share = np.clip(share, LEAST, MOST)
        share /= share.mean()
    # What rounding takes from a pixel its neighbour gets.
    counts = np.diff(np.round(np.cumsum(share) * each), prepend=0).astype(np.int64)
    counts = np.maximum(counts, 1)
    counts[np.argmax(counts)] += each * counts.size - counts.sum()
    return None if (counts == each).all() else counts
