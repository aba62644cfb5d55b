"""Whole passes that are done: what adds up over them, here, elsewhere and in earlier runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from . import state
from .accumulate import NAMES, Sums
from .layered import plus, whole_pass
from .state import COUNTS


class Traced(NamedTuple):
    """A pass, or its wavefronts so far.

    image   as film blocks hold it, not normalised.
    counts  COUNTS.
    layers  sums of layers (see ``layered``); None where nobody asks.
    """

    image: Any
    counts: dict[str, int]
    layers: dict[str, np.ndarray] | None


@dataclass(frozen=True)
class Batch:
    """Passes that were rendered together.

    passes   half-open ranges of their numbers (see ``state.State``).
    arrays   ``Sums.arrays()`` of them, and the sums of their layers.
    counts   what they counted.
    seconds  that each stage took.
    """

    passes: list[list[int]]
    arrays: dict[str, np.ndarray]
    counts: dict[str, int]
    seconds: dict[str, float]


class Done(NamedTuple):
    """Never changed but replaced, by one assignment, so that Ctrl-C finds it consistent.

    sums    None before the first pass.
    passes  half-open ranges of their numbers.
    counts  COUNTS, and "passes".
    layers  sums of layers; None where nobody asks.
    """

    sums: Sums | None
    passes: list[list[int]]
    counts: dict[str, int]
    layers: dict[str, np.ndarray] | None = None

    @staticmethod
    def nothing() -> Done:
        return Done(None, [], dict.fromkeys((*COUNTS, "passes"), 0))

    @staticmethod
    def part(traced: Traced) -> Done:
        """The wavefronts of a first pass that has not been finished."""
        sums = Sums.zeros(traced.image.shape, False).plus(traced.image)
        return Done(sums, [], traced.counts | {"passes": 0}, traced.layers)

    @staticmethod
    def earlier(saved: state.State) -> Done:
        """What an earlier run has saved."""
        counts = {name: saved.statistics[name] for name in (*COUNTS, "passes")}
        return Done(
            Sums.from_arrays(saved.arrays), saved.passes, counts, saved.layer_sums() or None
        )

    def with_pass(self, index: int, traced: Traced, variance: bool) -> Done:
        """And pass ``index``. variance: is its spread kept? (as in all passes before)"""
        sums = self.sums or Sums.zeros(traced.image.shape, variance)
        return Done(
            sums.plus(traced.image),
            state.extended(self.passes, index),
            state.added(self.counts, traced.counts | {"passes": 1}),
            traced.layers and plus(self.layers, whole_pass(traced.layers)),
        )

    def with_batch(self, batch: Batch) -> Done:
        """And passes that were rendered elsewhere."""
        more = Sums.from_arrays(batch.arrays)
        layers = {name: array for name, array in batch.arrays.items() if name not in NAMES}
        return Done(
            more if self.sums is None else self.sums.joined(more),
            state.joined([*self.passes, *batch.passes]),
            state.added(self.counts, batch.counts),
            plus(self.layers, layers) if layers else self.layers,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Sums and layers; there is a pass."""
        assert self.sums is not None
        return self.sums.arrays() | (self.layers or {})
