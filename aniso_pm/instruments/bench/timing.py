"""Times of tasks that are compared: interleaved, so that all of them see the same machine."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True)
class Times:
    """Seconds of the repetitions of one task."""

    seconds: list[float]

    @property
    def best(self) -> float:
        return min(self.seconds)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    def __str__(self) -> str:
        """The best time, and by how much the median is longer."""
        return f"{1000 * self.best:.4g} ms (median {self.median / self.best - 1:+.0%})"


def run(task: Callable[[], Any]) -> float:
    """Seconds that a task takes, until everything that it returns is computed."""
    dr.sync_thread()
    began = time.perf_counter()
    dr.eval(task())
    dr.sync_thread()
    return time.perf_counter() - began


def interleaved(tasks: Mapping[Any, Callable[[], float]], repetitions: int) -> dict[Any, Times]:
    """Seconds of each task, in rounds: each task once, then each once again.

    A task returns its own seconds (see ``run``). One round before the first is not counted: in it
    kernels are compiled.
    """
    rounds = []
    for _ in range(1 + repetitions):
        gc.collect()
        rounds.append({name: task() for name, task in tasks.items()})
    return {name: Times([seconds[name] for seconds in rounds[1:]]) for name in tasks}
