"""What several commands share: options, loading, Mitsuba's messages."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm import _llvm, output
from aniso_pm.errors import InputError, is_interrupt, one_line

INTERRUPTED = 130

SceneFile = Annotated[Path, typer.Argument(help="Scene in Mitsuba's XML format.")]
Variant = Annotated[str, typer.Option("--variant", "-m", help="Variant.")]
Define = Annotated[
    list[str] | None,
    typer.Option("--define", "-D", metavar="KEY=VALUE", help="Parameter $KEY of the scene."),
]


class InterruptError(Exception):
    """Ctrl-C before there was a picture (typer would end silently on KeyboardInterrupt itself)."""


def make_directory(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into '{path}': {error.strerror or error}") from error
    output.check_writable(path / "any.json")


def parse_defines(pairs: list[str]) -> dict[str, str]:
    defines = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise InputError(f"-D takes KEY=VALUE, not '{pair}'")
        defines[key] = value
    return defines


def set_variant(variant: str) -> None:
    import mitsuba as mi

    if variant not in mi.variants():
        raise InputError(f"there is no variant '{variant}'; there are {', '.join(mi.variants())}")
    try:
        mi.set_variant(variant)
    except ImportError as error:
        reason = one_line(error)
        if variant.startswith("llvm_"):
            reason = _llvm.explain() or reason
        elif variant.startswith("cuda_"):
            reason = f"Dr.Jit finds no CUDA device or driver on this machine ({reason})"
        raise InputError(f"variant '{variant}' cannot be used: {reason}") from error


def load(scene: Path, defines: dict[str, str], sensor: int):
    """Scene, sensor and integrator; whatever is wrong with them is an InputError."""
    import mitsuba as mi

    try:
        # optimize merges meshes in the order of their addresses: the order of shapes and lights,
        # and with it all random decisions, would be another one in every process.
        world = mi.load_file(str(scene), optimize=False, **defines)
    except BaseException as error:
        if is_interrupt(error):
            raise InterruptError from error
        reason = one_line(error)
        raise InputError(reason if scene.name in reason else f"{scene}: {reason}") from error

    if not isinstance(world, mi.Scene):
        raise InputError(f"{scene}: the file describes a {type(world).__name__}, not a scene")
    sensors, integrator = world.sensors(), world.integrator()
    if integrator is None:
        raise InputError(f"{scene}: the scene names no integrator")
    if not sensors:
        raise InputError(f"{scene}: the scene has no sensor")
    if sensor >= len(sensors):
        raise InputError(f"{scene}: no sensor {sensor}; the scene has {len(sensors)}, from 0")
    if 0 in sensors[sensor].film().size():
        raise InputError(f"{scene}: the film of sensor {sensor} has no pixels")
    return world, sensors[sensor], integrator


@contextmanager
def mitsuba_log(quiet: bool) -> Iterator[None]:
    """Send Mitsuba's warnings to standard error, one line each, instead of standard output."""
    import mitsuba as mi

    class StandardError(mi.Appender):
        def append(self, level, text) -> None:
            if level >= mi.LogLevel.Warn and not quiet:
                message = text.partition(" WARN ")[2] or text
                message = re.sub(
                    r"^\s*(\[[^]]*\]\s*)?\w+\(\): ", "", message
                )  # where it was logged
                print(f"aniso-pm: warning: {one_line(message.strip())}", file=sys.stderr)

        def log_progress(self, *_) -> None:
            pass

    logger = mi.logger()
    before = [logger.appender(index) for index in range(logger.appender_count())]
    logger.clear_appenders()
    logger.add_appender(StandardError())
    try:
        yield
    finally:
        logger.clear_appenders()
        for appender in before:
            logger.add_appender(appender)
