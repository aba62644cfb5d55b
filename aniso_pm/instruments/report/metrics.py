"""Errors of pictures against a reference that is noisy itself: pure NumPy.

S pictures I_s (one a seed) are compared with a reference of two independent halves R1, R2. Means
⟨·⟩ are over the pixels and colours of a region; w is 1 or, for everything *relative*,
1/(R² + 0.01), with R² the mean of R1·R2 over 3 × 3 pixels, so that the noise of a pixel does not
choose its own weight. All comes from one S × S table

    P_st = ⟨w (I_s − R1)(I_t − R2)⟩,
    MSE       the mean of P_ss,
    bias²     the mean of P_st over s ≠ t,
    variance  their difference, which is the unbiased sample variance over seeds.

Their expectations contain no noise of the reference, because R1 and R2 are independent, and that of
bias² none of the pictures; so an estimate of bias² may be negative.

Intervals are 95 %, by the jackknife over seeds with Student's t. (The bootstrap is no good here:
with five seeds its "95 %" cover some 80 %.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
# Added to R² in relative errors: dark pixels do not explode.
FLOOR = 0.01
# A row whose error is not this many times that of the reference is limited by the reference.
CLEAR = 10.0


@dataclass(frozen=True)
class Estimate:
    """A value with the ends of its 95 % interval; NaN where there is none."""

    value: float
    low: float
    high: float


NONE = Estimate(math.nan, math.nan, math.nan)


def weights(halves) -> np.ndarray:
    """1/(R² + 0.01) of each pixel and colour. halves: two arrays (y, x, colours)."""
    level = np.pad(halves[0] * halves[1], ((1, 1), (1, 1), (0, 0)), mode="edge")
    level = np.lib.stride_tricks.sliding_window_view(level, (3, 3), (0, 1)).mean((-1, -2))
    return 1 / (np.maximum(level, 0) + FLOOR)


def products(images, halves, mask, weight=None) -> np.ndarray:
    """The table P (seeds, seeds). images: (seeds, y, x, colours). mask: pixels of the region.
    weight: as of :func:`weights`, or None for 1."""
    root = 1.0 if weight is None else np.sqrt(weight[mask])
    first, second = (
        (root * (np.asarray(images, np.float64)[:, mask] - half[mask])).reshape(len(images), -1)
        for half in halves
    )
    return first @ second.T / first.shape[1]


def reference_error(halves, mask, weight=None) -> float:
    """Mean squared error of the mean of the halves, by their difference."""
    squared = ((halves[0] - halves[1]) / 2)[mask] ** 2
    return float(np.mean(squared if weight is None else squared * weight[mask]))


def mse(table: np.ndarray) -> float:
    return float(np.diag(table).mean())


def bias2(table: np.ndarray) -> float:
    n = len(table)
    return float((table.sum() - np.trace(table)) / (n * (n - 1))) if n > 1 else math.nan


def variance(table: np.ndarray) -> float:
    return mse(table) - bias2(table)


def estimate(statistic: Callable[[np.ndarray], float], *tables: np.ndarray) -> Estimate:
    """``statistic`` of tables of the same seeds, with its interval: each seed is left out once.

    With n seeds, values T and T_(s) without seed s, the standard error is
    √((n − 1)/n Σ (T_(s) − mean T_(s))²).
    """
    n = len(tables[0])
    value = statistic(*tables)
    # What is left after leaving one out must still be two for a bias².
    if n < 3 or not math.isfinite(value):
        return Estimate(value, math.nan, math.nan)
    left_out = np.array(
        [statistic(*(np.delete(np.delete(t, s, 0), s, 1) for t in tables)) for s in range(n)]
    )
    if not np.isfinite(left_out).all():
        return Estimate(value, math.nan, math.nan)
    error = math.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2))
    reach = _student(n) * error
    return Estimate(value, value - reach, value + reach)


def ratio(table: np.ndarray, base: np.ndarray) -> Estimate:
    """MSE of one method over that of another at the same time, paired by seeds: the interval is
    that of the logarithm. NONE where noise makes one of them negative."""

    def log_ratio(a, b):
        top, bottom = mse(a), mse(b)
        return math.log(top / bottom) if top > 0 and bottom > 0 else math.nan

    found = estimate(log_ratio, table, base)
    if math.isnan(found.value):
        return NONE
    return Estimate(*(math.exp(v) for v in (found.value, found.low, found.high)))


def mean_ratio(values, base) -> Estimate:
    """Geometric mean of the ratios of positive numbers, paired by seeds, with its interval."""
    logs = np.log(np.asarray(values, np.float64) / np.asarray(base, np.float64))
    value, n = float(logs.mean()), len(logs)
    if n < 3:
        return Estimate(math.exp(value), math.nan, math.nan)
    reach = _student(n) * logs.std(ddof=1) / math.sqrt(n)
    return Estimate(*(math.exp(v) for v in (value, value - reach, value + reach)))


def energy(images, halves, mask) -> Estimate:
    """Mean of the pictures over that of the reference, the reference's own noise included."""
    mean, half_difference = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
    level = mean[mask].mean()
    values = np.asarray(images, np.float64)[:, mask].reshape(len(images), -1).mean(1) / level
    value, n = float(values.mean()), len(values)
    if n < 3:
        return Estimate(value, math.nan, math.nan)
    own = math.sqrt(np.mean(half_difference[mask] ** 2) / half_difference[mask].size) / level
    reach = math.hypot(_student(n) * values.std(ddof=1) / math.sqrt(n), _student(1000) * own)
    return Estimate(value, value - reach, value + reach)


def verdict(found: Estimate) -> str:
    """What a ratio of errors says: "better", "worse", "cannot be told apart"."""
    if found.high < 1:
        return "better"
    if found.low > 1:
        return "worse"
    return "cannot be told apart"


def _student(n: int) -> float:
    return float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1))
