"""Sums over passes: the mean image and how far it can be trusted.

Pass i leaves in every pixel and channel of the film A_i = Σ w L and W_i = Σ w, sums over its
samples weighted by the reconstruction filter. The image is the ratio M = Σ A_i / Σ W_i. Passes are
independent, so its variance is that of a ratio estimator [Cochran 1977, Sec. 6.4]

    Var M ≈ m/(m − 1) · Σ (A_i − M W_i)² / (Σ W_i)²,        m passes,

which needs Σ A², Σ A W and Σ W² only. It is the variance of the mean image, not of one pass. It
never divides by the W_i of a single pass, which filters with negative lobes bring close to zero,
and it holds for passes that differ in samples or in variance. The bias that later passes lose adds
a little to it; the bias that all passes share is not in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own

# Arrays of sums: Σ A, Σ A², Σ A W.
NAMES = ("first", "square", "cross")


@dataclass(frozen=True)
class Sums:
    """Sums over passes, double precision, flat, in the order (row, column, channel); the last
    channel is the filter weight.

    shape   (height, width, channels) of the film's crop window, weight included.
    first   Σ A; square: Σ A²; cross: Σ A W. The last two are None where no variance is wanted.
    """

    shape: tuple[int, int, int]
    first: Any
    square: Any | None
    cross: Any | None

    @staticmethod
    def zeros(shape: tuple[int, int, int], variance: bool) -> Sums:
        empty = lambda: dr.zeros(mi.Float64, int(np.prod(shape)))  # noqa: E731
        return Sums(shape, empty(), *((empty(), empty()) if variance else (None, None)))

    def plus(self, image) -> Sums:
        """The sums with one more pass. image: TensorXf of ``shape`` as film blocks hold it, not
        normalised."""
        value = mi.Float64(image.array)
        square = cross = None
        if self.square is not None:
            channels = self.shape[2]
            weight = dr.arange(mi.UInt32, dr.width(value)) // channels * channels + (channels - 1)
            square = self.square + dr.square(value)
            cross = self.cross + value * dr.gather(mi.Float64, value, weight)
        sums = Sums(self.shape, self.first + value, square, cross)
        dr.eval(sums.first, square, cross)
        return sums

    def joined(self, other: Sums) -> Sums:
        """The sums over the passes of both."""
        both = lambda a, b: None if a is None or b is None else a + b  # noqa: E731
        sums = Sums(
            self.shape,
            self.first + other.first,
            both(self.square, other.square),
            both(self.cross, other.cross),
        )
        dr.eval(sums.first, sums.square, sums.cross)
        return sums

    def film_tensor(self):
        """Σ A as the film's own storage has it (TensorXf)."""
        return mi.TensorXf(mi.Float(self.first), self.shape)

    def arrays(self) -> dict[str, np.ndarray]:
        """The sums as NumPy arrays of ``shape``."""
        present = {"first": self.first, "square": self.square, "cross": self.cross}
        return {k: v.numpy().reshape(self.shape) for k, v in present.items() if v is not None}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> Sums:
        """Inverse of :meth:`arrays`; other arrays are left alone."""
        height, width, channels = map(int, arrays["first"].shape)
        shape = height, width, channels
        flat = {
            name: own(mi.Float64, arrays[name].astype(float)) for name in NAMES if name in arrays
        }
        return Sums(shape, flat["first"], flat.get("square"), flat.get("cross"))


def mean_and_variance(arrays: dict[str, np.ndarray], passes: int) -> tuple[np.ndarray, np.ndarray]:
    """(M, Var M) of every pixel and channel but the weight; 0 where no sample was taken.

    arrays: ``Sums.arrays()`` of at least two passes.
    """
    first, square, cross = (arrays[k] for k in ("first", "square", "cross"))
    weight = first[..., -1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = first[..., :-1] / weight
        rest = square[..., :-1] - 2 * mean * cross[..., :-1] + mean**2 * square[..., -1:]
        variance = passes / (passes - 1) * np.maximum(rest, 0) / weight**2
    return np.where(weight != 0, mean, 0), np.where(weight != 0, variance, 0)


def relative_standard_error(mean: np.ndarray, variance: np.ndarray) -> float:
    """√ of the mean over pixels of Var M / (M² + f²), the noise of an image in one number.

    M is a pixel's mean over its colour channels and f a tenth of the median of all that are lit:
    dark pixels do not explode, and a lamp in the picture does not hide the rest. Noise only: bias
    is not in it. 0 for a black picture.
    """
    colour, variance = mean[..., :3].mean(-1), variance[..., :3].mean(-1)
    lit = colour[colour > 0]
    if lit.size == 0:
        return 0.0
    floor = 0.1 * float(np.median(lit))
    return float(np.sqrt(np.mean(variance / (colour**2 + floor**2))))
