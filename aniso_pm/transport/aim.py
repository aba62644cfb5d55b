"""Light paths where they show: emission aimed at what eye paths read.

Where a light path begins follows from five random numbers: emitter, place and direction (two each).
A pilot's paths have them spread evenly over the unit cube and score

    q = Σ_photons Σ_points W (Φ w f / (π |s × t| …))²,

the squared contributions of their photons to the pilot's gather points, W the weight that makes
errors relative: the path's part in the variance of the picture, as all photons are independent. The
cube is halved again and again, each box across the number that gains most, and boxes get light
paths in proportion to

    p ∝ V √(Σq/Σc),

V the volume, Σ over the pilot's paths in the box, c the work of a path: that makes variance times
work, (Σ V²q̄/p)(Σ p c̄), smallest, and by Cauchy and Schwarz the smallest is (Σ √(Σq Σc))². A box
is left whole where halving it would gain no more than chance does. A tenth of all paths stays
spread evenly, so that no weight V/p is above ten: any p > 0 gives the right energy. Paths of a pass
are stratified over the boxes.

What was gained is judged by one half of the pilot where the other half has aimed; where that is
too little, nothing is aimed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own

# Share of the light paths that stays spread evenly.
_EVEN = 0.1
# A box's score counts by so much, the rest is that of the box it was a half of.
_TRUST = 0.97
# Halvings of the cube, one after the other; paths in effect that a box to be halved holds.
_HALVINGS, _ENOUGH = 14, 8
# Gain of a halving: at least this share of all, and so much of what chance brings.
_LEAST_GAIN, _CHANCE = 1e-4, 0.1
# Variance times work have to fall below this share.
_WORTH = 0.85


@dataclass  # not frozen: Dr.Jit traverses it
class Aim:
    """Boxes of the five numbers, as columns: chance, corner, size, weight volume/chance."""

    choose: Any
    low: list[Any]
    size: list[Any]
    weight: Any

    def __call__(self, u, u1, u2, u3):
        """(u1, u2, u3, weight) of light paths from even ones. u: chooses the box."""
        box = self.choose.sample(u)
        even = (u1, u2.x, u2.y, u3.x, u3.y)
        below_one = 1 - 2.0**-24
        own = lambda column: dr.gather(mi.Float, column, box)  # noqa: E731
        a, b, c, d, e = (
            dr.minimum(dr.fma(v, own(size), own(low)), below_one)
            for v, size, low in zip(even, self.size, self.low, strict=True)
        )
        return a, mi.Point2f(b, c), mi.Point2f(d, e), own(self.weight)


@dataclass(frozen=True)
class Learned:
    """What a pilot says about aiming.

    low, size  of the boxes, (boxes, 5).
    chance     of each box.
    variance, work, photons  of a light path, as shares of those of paths spread evenly.
    """

    low: np.ndarray
    size: np.ndarray
    chance: np.ndarray
    variance: float
    work: float
    photons: float

    def gains(self) -> dict[str, float]:
        """As statistics show it."""
        ratios = {"variance": self.variance, "work": self.work, "photons": self.photons}
        return {"parts": len(self.low), **{k: round(v, 3) for k, v in ratios.items()}}

    def aim(self) -> Aim:
        """For tracing."""
        column = lambda values: own(mi.Float, values.astype(np.float32))  # noqa: E731
        weight = self.size.prod(1) / self.chance
        return Aim(
            mi.DiscreteDistribution(column(self.chance)),
            [column(v) for v in self.low.T],
            [column(v) for v in self.size.T],
            column(weight),
        )


def learn(numbers: np.ndarray, score: np.ndarray, work: np.ndarray, photons) -> Learned | None:
    """From the paths of two maps, or None where aiming does not pay.

    numbers  (2, paths, 5) in [0, 1); score, work, photons: (2, paths), of each path.
    """
    # Paths that do not score are known by their number and their mean.
    scored = score > 0
    if not scored.any(1).all():
        return None
    idle = ~scored
    idle_work = float(work[idle].mean()) if idle.any() else 0.0
    idle_photons = float(photons[idle].mean()) if idle.any() else 0.0
    half = np.nonzero(scored)[0]
    paths, score = scored.size, score[scored]
    more_work, more_photons = work[scored] - idle_work, photons[scored] - idle_photons
    low, size, box, scores = _boxes(numbers[scored], score, more_work, paths * idle_work)
    volume, count = size.prod(1), len(low)
    all_work = np.bincount(box, more_work, count) + paths * idle_work * volume

    def scores_of(known):
        return np.bincount(box[half == known], score[half == known], count)

    # --- Each half tries what the other one says ---
    tried = []
    for known in (0, 1):
        chance = _chances(scores_of(known), scores, all_work, volume)
        found = scores_of(1 - known)
        tried.append((found * volume / chance).sum() / found.sum())
    variance = float(np.mean(tried))
    chance = _chances(np.bincount(box, score, count), scores, all_work, volume)
    share = chance / volume
    of_work = float((all_work * share).sum() / all_work.sum())
    if not variance * of_work < _WORTH:
        return None
    left = np.bincount(box, more_photons, count) + paths * idle_photons * volume
    return Learned(low, size, chance, variance, of_work, float((left * share).sum() / left.sum()))


def _chances(score, parent, work, volume):
    """Of boxes. parent: score that each would have if it were like the box it was a half of."""
    trusted = _TRUST * score / score.sum() + (1 - _TRUST) * parent / parent.sum()
    root = volume * np.sqrt(trusted / np.maximum(work, 1e-12 * work.sum()))
    return (1 - _EVEN) * root / root.sum() + _EVEN * volume


def _root(score, work):
    """√(Σq Σc), either of which rounding may have left below 0."""
    return np.sqrt(np.maximum(score, 0) * np.maximum(work, 0))


def _boxes(numbers, score, more_work, idle_work):
    """(low, size, box of each path, score by the box that each was a half of). idle_work: of all
    paths if they were idle; more_work: than that, of each of these."""
    low: np.ndarray = np.zeros((1, 5))
    size: np.ndarray = np.ones((1, 5))
    inherited = np.array([score.sum()])
    box: np.ndarray = np.zeros(len(score), np.int64)
    whole = np.sqrt(score.sum() * (more_work.sum() + idle_work))
    is_open = np.array([True])  # may the box be halved?
    place = numbers.T.copy()  # of each path in its box, 0 to 1
    path = np.arange(len(score))

    def in_boxes(values):
        return np.bincount(box, values, len(low))

    for _ in range(_HALVINGS):
        # --- What halving would gain ---
        sums, works = in_boxes(score), in_boxes(more_work)
        idle = idle_work * size.prod(1)
        effective = sums**2 / np.maximum(in_boxes(score**2), 1e-300)
        upper = place >= 0.5
        of_score, of_work = (
            np.array([in_boxes(values * half) for half in upper]) for values in (score, more_work)
        )
        roots = _root(of_score, of_work + 0.5 * idle)
        roots += _root(sums - of_score, works - of_work + 0.5 * idle)
        best = roots.argmin(0)
        root = _root(sums, works + idle)
        gain = root - roots.min(0)
        chance = _CHANCE * root / np.maximum(effective, 1)
        split = (effective >= _ENOUGH) & (gain > np.maximum(_LEAST_GAIN * whole, chance))

        # --- Halve: the lower half stays in its place, the upper ones come after all ---
        which = np.flatnonzero(is_open & split)
        if not len(which):
            break
        is_open = np.zeros(len(low) + len(which), bool)
        dimension, new = best[which], np.arange(len(low), len(is_open))
        is_open[which] = is_open[new] = True
        size[which, dimension] *= 0.5
        low, size = np.concatenate([low, low[which]]), np.concatenate([size, size[which]])
        low[new, dimension] += size[new, dimension]
        inherited[which] = 0.5 * sums[which]
        inherited = np.concatenate([inherited, inherited[which]])
        target: np.ndarray = np.arange(len(best))
        target[which] = new
        across = best[box]
        above = upper[across, path]
        # Nobody asks any more for places in boxes that are not halved.
        place[across, path] = 2 * place[across, path] - above
        box = np.where(above, target[box], box)
    return low, size, box, inherited
