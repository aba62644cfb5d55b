"""Functions that Python traces once for each kind of arguments, and Dr.Jit then replays."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import drjit as dr


def frozen(function):
    """``function`` frozen (``drjit.freeze``): its arguments, by position, are dataclasses of arrays
    and plain values, arrays, and objects of Mitsuba."""
    # A pilot asks for more kinds of gathers than Dr.Jit finds normal.
    return dr.freeze(function, state_fn=plain_values, warn_after=1000)


def plain_values(*arguments) -> str:
    """The numbers, texts, truth values and Nones of arguments.

    Dr.Jit 1.5 compares an object that it meets again in the same call, as all ``False`` and all
    ``True`` are, by its type alone: options that differ in the second ``False`` would be taken for
    the same.
    """
    return repr([_plain(argument) for argument in arguments])


def _plain(value) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if is_dataclass(value):
        return [_plain(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return type(value).__name__
