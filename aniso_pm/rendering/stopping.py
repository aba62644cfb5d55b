"""When to stop: time or estimated error, whichever comes first (the number of passes is
``progressive.Run.numbers``').

Time is wall-clock time from the call on, without the compilation of kernels, which happens once, in
the pilot and the first pass, and depends on what is cached, and without what callbacks take.
Rendering ends as near to the limit as whole passes allow: one more begins if, by the mean of the
last ones, half of it will lie within. The first pass always does.
"""

from __future__ import annotations

import math
import time
from contextlib import contextmanager

import drjit as dr

from .settings import Settings

# Passes before which an error estimate says too little to stop.
MIN_PASSES = 4
# The error is looked at after passes that are this much apart: the estimate costs time.
_STRIDE = math.log(1.05)
# Passes whose mean duration predicts the next one.
_RECENT = 4


class Stopping:
    """The stopping rules of one rendering, and the time it takes."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self.spent_before = 0.0  # by earlier runs that this one resumes
        self._began = time.perf_counter()
        self._compiling = 0.0
        self._elsewhere = 0.0
        self._durations: list[float] = []
        # A history that the caller keeps is the caller's; then compilation counts as rendering. It
        # is kept to the end: Dr.Jit traces what is frozen anew whenever one of its flags changes.
        self._history = settings.time > 0 and not dr.flag(dr.JitFlag.KernelHistory)
        if self._history:
            dr.kernel_history_clear()
            dr.set_flag(dr.JitFlag.KernelHistory, True)

    @contextmanager
    def measured(self):
        """Around each pass."""
        began, aside = time.perf_counter(), self._compiling + self._elsewhere
        yield
        if self._durations:
            self._forget_history()
        else:
            self.count_compilation()
        took = time.perf_counter() - began - (self._compiling + self._elsewhere - aside)
        self._durations = [*self._durations[-_RECENT + 1 :], took]

    @contextmanager
    def not_counted(self):
        """Around what others do, who may take any time."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self._elsewhere += time.perf_counter() - began

    def close(self):
        """At the end, however it came."""
        self._forget_history()
        if self._history:
            dr.set_flag(dr.JitFlag.KernelHistory, False)

    def count_compilation(self):
        """What has been compiled so far is no rendering."""
        if self._history:
            kernels = [k for k in dr.kernel_history() if "backend_time" in k]
            self._compiling += sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
            self._forget_history()

    def _forget_history(self):
        if self._history:
            dr.kernel_history_clear()

    @property
    def compiling(self) -> float:
        """Seconds of compilation so far."""
        return self._compiling

    def set_aside(self, seconds: float):
        """So many seconds since the beginning were no rendering."""
        self._elsewhere += seconds

    def spent(self) -> float:
        """Seconds spent, earlier runs included, compilation and what others do not."""
        aside = self._compiling + self._elsewhere
        return self.spent_before + time.perf_counter() - self._began - aside

    def error_is_due(self, count: int) -> bool:
        """Is the error estimated after ``count`` passes? After each of the first 20, then at steps
        of 5 %: a function of the count alone, so that a resumed rendering stops at the same one."""
        return count > 1 and int(math.log(count) / _STRIDE) > int(math.log(count - 1) / _STRIDE)

    def reached(self, count: int, error: float | None) -> bool:
        """Is it time to stop, after ``count`` passes with this relative error?"""
        if count == 0:
            return False
        s = self.settings
        if s.time and self.spent() + 0.5 * self._expected_duration() > s.time:
            return True
        enough = count >= MIN_PASSES and error is not None and error <= s.target_error
        return bool(s.target_error) and enough

    def _expected_duration(self) -> float:
        return sum(self._durations) / len(self._durations) if self._durations else 0.0

    def expected_total(self, count: int, error: float | None) -> int | None:
        """Passes in all as far as one can tell; None if nobody knows."""
        s = self.settings
        totals = [s.passes] if s.passes else []
        if s.time and self._durations:
            left = max(0.0, s.time - self.spent()) / self._expected_duration()
            totals.append(count + int(left))
        if s.target_error and error and count:
            # The error falls as 1/√passes.
            totals.append(math.ceil(count * max(1.0, (error / s.target_error) ** 2)))
        return max(1, count, min(totals)) if totals else None
