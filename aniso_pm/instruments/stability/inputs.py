"""Cases about wrong parameters: every one is refused by name, value and range, or harmless.

The parameters and their types come from ``Settings`` and from the ranges of ``asgconductor``: a new
parameter is a new case.
"""

from __future__ import annotations

import math
from dataclasses import fields
from functools import cache, partial

import mitsuba as mi
import numpy as np
from aniso_pm.errors import one_line
from aniso_pm.plugins import asgconductor
from aniso_pm.rendering.settings import Settings

from .bsdfs import sampled
from .case import Case, Measured
from .worlds import plate, room

_NUMBERS = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e30, -1e30, 1e-30)
WRONG = {
    float: ("text", "4.5", "", True, *_NUMBERS),
    int: ("text", "4", True, 1.5, math.nan, -(2**31), -2, 0, 2**31 - 1, 2**40, 10**18),
    bool: ("text", "true", 1, 0.5),
    str: ("no such name", "", 1, 0.5, True),
}
_RANGE_WORDS = ("must be", "give a ", "raise the sample count")


@cache
def _small_room():
    return mi.load_dict(room(lambda p: {"plate": plate(p)}, size=4))


def _complaint(action) -> str | None:
    """One line that says why ``action`` was refused; None where it was not."""
    try:
        action()
    except Exception as error:
        return one_line(error.__cause__ or error)
    return None


def _unclear(plugin, name, value, make, use) -> str | None:
    """What is wrong with the way in which ``value`` was received; None if nothing is.

    Refused: the line names plugin, parameter, value and what it must be. Accepted: what ``use``
    makes of it (a picture, samples) is finite."""
    made = []
    complaint = _complaint(lambda: made.append(make()))
    if complaint is None:
        complaint = _complaint(lambda: made.append(use(made[0])))
    if complaint is None:
        return None if np.isfinite(made[1]).all() else f"{value!r} makes values that are not finite"
    shown = {
        str(value),
        repr(value),
        f"{value:g}" if isinstance(value, (int, float)) else str(value),
    }
    missing = [word for word in (plugin, f'"{name}"') if word not in complaint]
    if not any(text in complaint for text in shown):
        missing.append("the value")
    if not any(words in complaint for words in _RANGE_WORDS):
        missing.append("the range")
    return f"{value!r}: no {', '.join(missing)} in: {complaint}" if missing else None


def _render(integrator):
    with_photons = getattr(integrator, "settings", None)
    if with_photons and with_photons.photon_count > 10**6:
        return np.zeros(1)  # allowed, but too many to trace here
    return np.array(mi.render(_small_room(), integrator=integrator, spp=2))


def _all_clear(complaints) -> Measured:
    complaints = [c for c in complaints if c]
    return Measured(float(len(complaints)), complaints[0][:200] if complaints else "")


def _integrator(name, kind) -> Measured:
    # Two passes: some stopping rules that are allowed would not stop today.
    small = {"type": "aniso_pm", "photon_count": 1000, "passes": 2}
    return _all_clear(
        _unclear("aniso_pm", name, v, partial(mi.load_dict, small | {name: v}), _render)
        for v in WRONG[kind]
    )


def _bsdf(name) -> Measured:
    other = {"alpha_u": "alpha_v", "alpha_v": "alpha_u", "eta": "k", "k": "eta"}.get(name)
    kind = str if name == "material" else float

    def make(value):
        bsdf = {"type": "asgconductor", name: value}
        if other:
            bsdf[other] = 0.5
        return mi.load_dict(bsdf)

    def use(bsdf):
        return np.concatenate([a.ravel() for a in sampled(bsdf, 0.5, 1000)])

    values = list(WRONG[kind])
    if name in asgconductor.RANGES:
        values.append(asgconductor.RANGES[name][1])  # the largest that is allowed
    complaints = [_unclear("asgconductor", name, v, partial(make, v), use) for v in values]
    if kind is float:
        spectrum = {"type": "uniform", "value": math.nan}
        refused = _complaint(partial(make, spectrum))
        complaints.append(
            None if refused and f'"{name}"' in refused else "a spectrum of NaN passes"
        )
    return _all_clear(complaints)


def cases() -> list[Case]:
    quantity = "values neither refused clearly nor harmless"
    found = [
        Case(
            "wrong input",
            f"aniso_pm, {field.name}",
            quantity,
            0.0,
            partial(_integrator, field.name, type(field.default)),
        )
        for field in fields(Settings)
    ]
    found.append(
        Case(
            "wrong input",
            "aniso_pm, hide_emitters",
            quantity,
            0.0,
            partial(_integrator, "hide_emitters", bool),
        )
    )
    found += [
        Case("wrong input", f"asgconductor, {name}", quantity, 0.0, partial(_bsdf, name))
        for name in ("material", *asgconductor.RANGES)
    ]
    return found
