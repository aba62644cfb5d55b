"""Speed and memory, target beside figure (``aniso-pm bench``).

Speeds are ratios within one run wherever that is possible: the machine they were measured on is
then of little importance. A module of measurements is one idea and has a function
``measure(quick)`` that yields rows (``errors`` another one for large pictures): ``gathering`` and
its data (``walls``) and rivals (``grid``), ``building``, ``tracing``, ``passes``, ``memory``,
``startup``, ``kernels``, ``errors``, ``denoising``. ``row`` says what a row is and prints it,
``timing`` takes the time, ``rooms`` has the scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from aniso_pm.errors import InputError

from .row import Row

# What `aniso-pm bench` calls each group: module and function.
GROUPS = {
    "gather": ("gathering", "measure"),
    "trace": ("tracing", "measure"),
    "build": ("building", "measure"),
    "pass": ("passes", "measure"),
    "memory": ("memory", "measure"),
    "startup": ("startup", "measure"),
    "kernels": ("kernels", "measure"),
    "error": ("errors", "measure"),
    "large": ("errors", "measure_large"),
    "denoise": ("denoising", "measure"),
}
# Those that render the gallery, which takes a quarter of an hour and more each.
LONG = ("error", "large", "denoise")


def measure(
    groups: list[str],
    quick: bool,
    scenes: list[Path] | None = None,
    defines: dict[str, str] | None = None,
) -> Iterator[Row]:
    """The rows of the named groups, as they are measured. A Mitsuba variant has to be set.

    quick   smaller sizes, fewer repetitions, no slow row: less than a minute for all but ``LONG``,
            but too small for some of the targets.
    scenes  that "error" renders instead of the gallery, with the parameters ``defines``.
    """
    for group in groups:
        module, function = GROUPS[group]
        more: dict[str, Any] = {}
        if group == "error":
            more = {"files": scenes, "defines": defines}
        try:
            yield from getattr(import_module(f"{__name__}.{module}"), function)(quick, **more)
        except InputError as error:
            yield Row(group, None, "×", None, str(error))
        except ModuleNotFoundError as error:
            missing = f"{error.name} is not installed: pip install 'aniso-pm[report]'"
            yield Row(group, None, "×", None, missing)
