"""Numerical stability, shown: extreme cases, each with its worst error and its verdict.

``aniso-pm stability`` runs them and writes the table; the tests run the same list. A module of
cases is one idea (warps, lobes, bsdfs, planes, sums, scenes, inputs, gallery, fuzz, soak) and has a
function ``cases()``; ``case`` says what a case is, ``reference`` holds the definitions in 50
digits, ``regions`` the fallbacks, ``page`` makes the table. Needs the packages of the extra
``aniso-pm[stability]``.
"""

from __future__ import annotations

from importlib import import_module

GROUPS = (
    "warps",
    "lobes",
    "bsdfs",
    "planes",
    "sums",
    "scenes",
    "gallery",
    "inputs",
    "fuzz",
    "soak",
)


def all_cases() -> list:
    """Every ``case.Case``, in the order of the table. A Mitsuba variant has to be set."""
    modules = [import_module(f"{__name__}.{group}") for group in GROUPS]
    return [case for module in modules for case in module.cases()]
