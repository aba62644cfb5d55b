"""Wall-clock time of the stages of a rendering."""

from __future__ import annotations

import time

import drjit as dr


class Clock:
    """Wall-clock time of each stage; a lap ends when the work handed to Dr.Jit is done."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def go_on_from(self, seconds: dict[str, float]):
        """Count on from an earlier run."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent

    def skip(self):
        """What was done since the last lap is no stage: waiting."""
        self.last = time.perf_counter()

    def lap(self, stage: str):
        """What was done since the last lap was ``stage``."""
        dr.sync_thread()
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now
