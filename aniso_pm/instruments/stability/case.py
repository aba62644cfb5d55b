"""A case: something extreme, a quantity, its error, and what may be called right."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

# Share of lanes (or gather points) from which on a fallback is the answer, not an exception.
RARE = 0.01

PASS, FALLBACK, FAIL, LEFT_OUT = "pass", "fallback", "FAIL", "left out"


@dataclass(frozen=True)
class Measured:
    """What a case found.

    worst     largest error, in the unit that the case's target has; NaN and infinity fail.
    at        where that was, in words.
    fallback  share of lanes or gather points in which a documented fallback acted, 0 to 1.
    """

    worst: float
    at: str = ""
    fallback: float = 0.0


@dataclass(frozen=True)
class Case:
    """One row of the table.

    group, name   what is extreme; together unique.
    quantity      what is measured, and in which unit.
    target        largest error that counts as right.
    measure       does it; raises LeftOut where something it needs is missing.
    region        key of the fallback (see ``regions``) that has to act here, or None.
    slow          takes more than about ten seconds, or much memory.
    """

    group: str
    name: str
    quantity: str
    target: float
    measure: Callable[[], Measured]
    region: str | None = None
    slow: bool = False

    @property
    def title(self) -> str:
        return f"{self.group}: {self.name}: {self.quantity}"


class LeftOut(Exception):
    """The case cannot be measured here; the message says what is missing."""


@dataclass(frozen=True)
class Row:
    """A case and what came of it."""

    case: Case
    verdict: str
    measured: Measured
    seconds: float
    reason: str = field(default="")


def verdict(case: Case, measured: Measured) -> tuple[str, str]:
    """(verdict, reason). A fallback never counts as a pass, nor a pass as a fallback."""
    if not measured.worst <= case.target:
        return FAIL, f"error {measured.worst:.3g} exceeds {case.target:g}"
    if case.region is None and measured.fallback > RARE:
        return FAIL, f"a fallback acted in {measured.fallback:.1%} outside its region"
    if case.region is not None and measured.fallback <= RARE:
        return FAIL, f'the fallback "{case.region}" was to act here and was not counted'
    return (PASS if case.region is None else FALLBACK), ""


def run(cases: Iterable[Case], quick: bool = False) -> Iterator[Row]:
    """Measure one case after the other; ``quick`` leaves out the slow ones. An exception is a row
    that fails, with its text."""
    for case in cases:
        started = time.perf_counter()
        if quick and case.slow:
            yield Row(case, LEFT_OUT, Measured(math.nan), 0.0, "slow")
            continue
        try:
            measured = case.measure()
            outcome, reason = verdict(case, measured)
        except LeftOut as missing:
            measured, outcome, reason = Measured(math.nan), LEFT_OUT, str(missing)
        except Exception as error:
            measured, outcome = Measured(math.nan), FAIL
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
        yield Row(case, outcome, measured, time.perf_counter() - started, reason)


def worst_of(errors, names) -> tuple[float, str]:
    """The largest of ``errors`` and its name; the first that is not a number, if there is one."""
    worst = max(range(len(errors)), key=lambda i: math.inf if errors[i] != errors[i] else errors[i])
    return float(errors[worst]), str(names[worst])
