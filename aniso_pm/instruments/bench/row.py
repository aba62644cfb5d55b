"""One line of the benchmark: what was measured, the target, and whether it is met."""

from __future__ import annotations

import operator
import textwrap
from dataclasses import dataclass
from typing import Any

_SENSES = {">=": operator.ge, "<=": operator.le, "<": operator.lt}
_WIDTH = 100


@dataclass(frozen=True)
class Row:
    """A figure and what it was meant to be.

    name    "group: what".
    figure  measured value; None where it could not be measured (``note`` says why).
    unit    of figure and bound: "×" is a ratio.
    target  (">=", "<=" or "<", bound), or None for a row that informs only.
    note    sizes, repetitions, spread, absolute speeds.
    """

    name: str
    figure: float | None
    unit: str
    target: tuple[str, float] | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Is the target met? None without target or figure."""
        if self.target is None or self.figure is None:
            return None
        sense, bound = self.target
        return bool(_SENSES[sense](self.figure, bound))


def as_data(row: Row) -> dict[str, Any]:
    """A row in JSON's types: name, figure (number or null), unit, target (text such as ">= 0.85",
    or null), met (true, false, null) and note."""
    return {
        "name": row.name,
        "figure": row.figure,
        "unit": row.unit,
        "target": _target(row),
        "met": row.met,
        "note": row.note,
    }


HEADER = f"{'':6s}  {'figure':>10s} {'unit':10s} {'target':9s} measurement"


def line(row: Row) -> str:
    """One row as text: verdict, figure, unit, target, name; the note below it."""
    verdict = {True: "ok", False: "missed", None: "-"}[row.met]
    figure = "-" if row.figure is None else f"{row.figure:.4g}"
    text = f"{verdict:6s}  {figure:>10s} {row.unit:10s} {_target(row) or '':9s} {row.name}"
    indent = " " * 19
    note = textwrap.fill(row.note, _WIDTH, initial_indent=indent, subsequent_indent=indent)
    return f"{text}\n{note}" if row.note else text


def _target(row: Row) -> str | None:
    return row.target and f"{row.target[0]} {row.target[1]:g}"


def summary(rows: list[Row]) -> str:
    """How many targets were met."""
    judged = [row.met for row in rows if row.met is not None]
    return f"{sum(judged)} of {len(judged)} targets met"
