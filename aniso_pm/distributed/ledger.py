"""The ledger: which passes are still to be rendered, are being rendered, or are counted.

Every pass number is in exactly one of these places. What carries passes (a task, a sum of several)
is entered with the passes that it took; they are counted once, when a carrier's sums arrive, or
given back, when a carrier is lost. A carrier whose passes were given back is no longer known, so
that what it brings late is dropped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

from aniso_pm.rendering.state import joined, numbers

Ranges = list[list[int]]


class Ledger:
    """Passes ``first`` to ``first + count - 1`` (count 0: without end), some of which are counted
    already."""

    def __init__(self, first: int, count: int, counted: Ranges):
        self.first, self.end = first, first + count if count else math.inf
        self.counted: Ranges = joined(counted)
        self.carried: dict[object, Ranges] = {}
        self._back: list[int] = []  # numbers that were given back, and gaps of earlier runs
        top = max((end for _, end in self.counted), default=first)
        done = set(numbers(self.counted))
        self._back += [n for n in range(first, top) if n not in done]
        self._fresh = max(top, first)

    @property
    def left(self) -> float:
        """Passes that nobody has; infinite where there is no end."""
        return len(self._back) + self.end - self._fresh

    @property
    def finished(self) -> bool:
        """Are all passes counted?"""
        return self.left == 0 and not self.carried

    def take(self, carrier: object, count: int) -> Ranges:
        """Up to ``count`` passes for a carrier, those first that were given back; [] if none are
        left."""
        self._back.sort()
        old, self._back = self._back[:count], self._back[count:]
        more = int(min(count - len(old), self.end - self._fresh))
        new = range(self._fresh, self._fresh + more)
        self._fresh += more
        passes = joined([n, n + 1] for n in itertools.chain(old, new))
        if passes:
            self._carry(carrier, passes)
        return passes

    def unite(self, carrier: object, others: Iterable[object]) -> Ranges:
        """One carrier for the passes of several, which are forgotten."""
        passes = joined(r for other in list(others) for r in self.carried.pop(other))
        self._carry(carrier, passes)
        return passes

    def give_back(self, carrier: object) -> None:
        """The carrier is lost: its passes are to be rendered again. Unknown ones lose nothing."""
        self._back += numbers(self.carried.pop(carrier, []))

    def count(self, carrier: object) -> bool:
        """The carrier's sums are here. False: it came late, they are to be dropped."""
        passes = self.carried.pop(carrier, None)
        if passes is None:
            return False
        self.counted = joined([*self.counted, *passes])
        return True

    def _carry(self, carrier: object, passes: Ranges) -> None:
        if carrier in self.carried:
            raise ValueError(f"{carrier} carries passes already")
        self.carried[carrier] = passes
