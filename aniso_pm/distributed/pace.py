"""How fast passes are, and what follows: passes of a task, and how long a task may take."""

from __future__ import annotations

import math
import statistics
from collections import deque

# Tasks whose median tells how long a pass takes.
_RECENT = 64
# A task that takes so many times as long as expected is given up, but none before so many seconds.
_TOO_LONG, _AT_LEAST = 10.0, 300.0
# The same where another worker has nothing to do.
_TOO_LONG_IDLE, _AT_LEAST_IDLE = 3.0, 60.0
# Seconds for a task of which nothing is known: it compiles kernels, too.
_UNKNOWN = 600.0


class Pace:
    """Durations of passes on the workers.

    task_seconds  that a task should take.
    task_limit    seconds after which a task is given up; None: as above, by what others took.
    """

    def __init__(self, task_seconds: float, task_limit: float | None):
        self.task_seconds, self.task_limit = task_seconds, task_limit
        self._first: deque[float] = deque(maxlen=_RECENT)
        self._later: deque[float] = deque(maxlen=_RECENT)
        self._slack = 1.0

    def seen(self, seconds: float, passes: int, first: bool) -> None:
        """A task has ended. first: of its worker, where much happens for the first time."""
        (self._first if first else self._later).append(seconds / passes)

    @property
    def each(self) -> float | None:
        """Seconds of a pass; None as long as nobody knows."""
        known = self._later or self._first
        return statistics.median(known) if known else None

    def passes(self, left: float, workers: int, seconds: float = math.inf) -> int:
        """Of the next task.

        left     passes that nobody has.
        workers  that share them.
        seconds  until rendering has to end: fewer than half a pass are none.
        """
        if not self.each:
            return int(min(left, seconds > 0))
        count = max(1, round(self.task_seconds / self.each))
        if left < math.inf:  # towards the end smaller ones, so that all workers end together
            count = min(count, math.ceil(left / (2 * workers)))
        if seconds < math.inf:
            count = min(count, max(0, round(seconds / self.each)))
        return int(min(count, left))

    def limit(self, passes: int, idle: bool = False) -> float:
        """Seconds that a task may take. idle: is there a worker with nothing to do?"""
        if self.task_limit:
            return self.task_limit
        each = self.each
        if each is None or not self._later:
            return _UNKNOWN
        times, least = (_TOO_LONG_IDLE, _AT_LEAST_IDLE) if idle else (_TOO_LONG, _AT_LEAST)
        return self._slack * max(least, times * passes * each)

    def too_long(self) -> None:
        """A task was given up. Should it have been in vain, the next one has twice the time."""
        self._slack *= 2
