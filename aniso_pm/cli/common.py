"""What several commands share: options, loading, Mitsuba's messages."""

from __future__ import annotations

import difflib
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from aniso_pm import _llvm
from aniso_pm.errors import InputError, is_interrupt, one_line
from aniso_pm.pictures import output

INTERRUPTED = 130

SceneFile = Annotated[Path, typer.Argument(help="Scene in Mitsuba's XML format.")]
Variant = Annotated[str, typer.Option("--variant", "-m", help="Variant.")]
Define = Annotated[
    list[str] | None,
    typer.Option("--define", "-D", metavar="KEY=VALUE", help="Parameter $KEY of the scene."),
]
Integrator = Annotated[
    str | None,
    typer.Option(
        "--integrator", metavar="NAME", help="Integrator to take instead of the scene's own."
    ),
]
Parameter = Annotated[
    list[str] | None,
    typer.Option("-p", metavar="NAME=VALUE", help="Parameter of the integrator."),
]
Samples = Annotated[
    int | None, typer.Option(min=1, max=2**31 - 1, help="Samples per pixel in all.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Random seed.")]
Passes = Annotated[int | None, typer.Option(min=1, max=10**7, help="Stop after so many passes.")]
Seconds = Annotated[
    float | None, typer.Option("--time", min=0.001, help="Stop after so many seconds.")
]
TargetError = Annotated[
    float | None,
    typer.Option(min=1e-6, help="Stop at this relative standard error (0.02: 2 %)."),
]
Camera = Annotated[int, typer.Option("--sensor", "-s", min=0, help="Which camera.")]
Layers = Annotated[
    str | None,
    typer.Option("--layers", metavar="NAMES", help="Layers to write as well: direct,albedo,…"),
]


class InterruptError(Exception):
    """Ctrl-C before there was a picture (typer would end silently on KeyboardInterrupt itself).
    The message says what there is."""

    def __init__(self, message: str = "interrupted, nothing written"):
        super().__init__(message)


def interruptible(command: Callable[..., int]) -> Callable[..., int]:
    """``command``, where Ctrl-C, however Mitsuba and Dr.Jit wrapped it, is an InterruptError,
    unless what it made impossible is told instead."""

    @wraps(command)
    def run(*args: Any, **options: Any) -> int:
        try:
            return command(*args, **options)
        except BaseException as error:
            if _is_only_interrupt(error):
                raise InterruptError from error
            raise

    return run


def _is_only_interrupt(error: BaseException) -> bool:
    told = isinstance(error, output.OutputError | InterruptError)
    return is_interrupt(error) and not told


@contextmanager
def telling_what_is_kept(state: Path) -> Iterator[None]:
    """Ctrl-C says so where there is a state to go on from."""
    try:
        yield
    except BaseException as error:
        if _is_only_interrupt(error) and state.exists():
            raise InterruptError(
                f"interrupted; '{state}' holds the passes so far, --resume goes on with them"
            ) from error
        raise


def require_file(scene: Path) -> None:
    if scene.is_dir():
        raise InputError(f"{scene}: this is a directory, not a scene")
    if not scene.is_file():
        raise InputError(f"{scene}: there is no such file")


def make_directory(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into '{path}': {error.strerror or error}") from error
    output.check_writable(path / "any.json")


def parse_defines(pairs: list[str], option: str = "-D takes KEY=VALUE") -> dict[str, str]:
    defines = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise InputError(f"{option}, not '{pair}'")
        defines[key] = value
    return defines


def parse_parameters(pairs: list[str] | None, **options: Any) -> dict[str, Any]:
    """Parameters of an integrator, NAME=VALUE: numbers, true or false, text.

    options  of the command, None where not given, that set the parameter of their name: given both
             ways is an InputError.
    """
    texts = parse_defines(pairs or [], "-p takes NAME=VALUE")
    for name in (name for name, value in options.items() if value is not None and name in texts):
        option = f"--{name.replace('_', '-')}"
        raise InputError(f"{option} and -p {name}={texts[name]}: give one of them")
    return {name: _value(text) for name, text in texts.items()}


def stopping_rules(
    passes: int | None, seconds: float | None, target_error: float | None
) -> dict[str, Any]:
    """Those that are given, by the names of their parameters."""
    rules = {"passes": passes, "time": seconds, "target_error": target_error}
    return {name: value for name, value in rules.items() if value is not None}


def _value(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    try:
        return int(text)
    except ValueError:
        pass
    try:
        value = float(text)
    except ValueError:
        return text
    # 1e6 is a number of photons as well.
    return int(value) if value.is_integer() and "." not in text else value


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


def load(
    scene: Path,
    defines: dict[str, str],
    sensor: int,
    integrator_name: str | None = None,
    parameters: dict[str, Any] | None = None,
    needed: bool = True,
):
    """Scene, sensor and integrator; whatever is wrong with them is an InputError.

    integrator_name  plugin to take instead of the scene's own integrator.
    parameters       of that plugin, or to change those of an ``aniso_pm`` in the scene.
    needed           else it is ``aniso_pm`` where the scene names none.
    """
    import mitsuba as mi

    try:
        # optimize merges meshes in the order of their addresses: the order of shapes and lights,
        # and with it all random decisions, would be another one in every process.
        world = mi.load_file(str(scene), optimize=False, **defines)
    except BaseException as error:
        if is_interrupt(error):
            raise
        reason = one_line(error)
        raise InputError(reason if scene.name in reason else f"{scene}: {reason}") from error

    if not isinstance(world, mi.Scene):
        raise InputError(f"{scene}: the file describes a {type(world).__name__}, not a scene")
    sensors = world.sensors()
    if not needed and world.integrator() is None:
        integrator_name = "aniso_pm"
    integrator = _integrator(scene, world.integrator(), integrator_name, parameters or {})
    if not sensors:
        raise InputError(f"{scene}: the scene has no sensor")
    if sensor >= len(sensors):
        raise InputError(f"{scene}: no sensor {sensor}; the scene has {len(sensors)}, from 0")
    if 0 in sensors[sensor].film().size():
        raise InputError(f"{scene}: the film of sensor {sensor} has no pixels")
    return world, sensors[sensor], integrator


def _integrator(scene: Path, own, name: str | None, parameters: dict[str, Any]):
    """The integrator to render with: ``own``, another one, or ``own`` with other parameters."""
    import mitsuba as mi

    if name is None and own is None:
        raise InputError(f"{scene}: the scene names no integrator; give one, --integrator aniso_pm")
    if name is None and not parameters:
        return own
    label = f"--integrator {name}" if name else "-p"
    if name is None:
        if not hasattr(own, "settings"):
            raise InputError(
                f"-p: the scene's integrator is {own.class_name()}; parameters of an integrator "
                "that is not aniso_pm are given together with --integrator"
            )
        before = own.parameters()
        if {"time", "target_error"} & parameters.keys():
            del before["passes"]  # another rule takes its place, as in a scene
        name, parameters = "aniso_pm", before | parameters
    if name == "aniso_pm":
        _check_names(label, parameters)
    try:
        found = mi.load_dict({"type": name, **parameters})
    except Exception as error:
        reason = re.sub(r"^.*failed to instantiate .*? of type \"\w+\": ", "", one_line(error))
        raise InputError(f"{label}: {reason}") from error
    if not isinstance(found, mi.Integrator):
        raise InputError(f"{label}: this plugin is no integrator")
    return found


def _check_names(label: str, parameters: dict[str, Any]) -> None:
    """An InputError for the first name that is no parameter of aniso_pm."""
    import mitsuba as mi

    known = list(mi.load_dict({"type": "aniso_pm"}).parameters())
    for name in [name for name in parameters if name not in known]:
        close = difflib.get_close_matches(name, known, 1)
        there = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
        raise InputError(f"{label}: aniso_pm has no parameter '{name}'; {there}")


@contextmanager
def mitsuba_log(quiet: bool) -> Iterator[None]:
    """Send Mitsuba's warnings to standard error, one line each and each once, instead of standard
    output; how many came again is said at the end."""
    import mitsuba as mi

    said: Counter[str] = Counter()

    class StandardError(mi.Appender):
        def append(self, level, text) -> None:
            if level >= mi.LogLevel.Warn and not quiet:
                message = text.partition(" WARN ")[2] or text
                message = re.sub(
                    r"^\s*(\[[^]]*\]\s*)?\w+\(\): ", "", message
                )  # where it was logged
                message = one_line(message.strip()).removeprefix("aniso_pm: ")
                said[message] += 1
                if said[message] == 1:
                    print(f"aniso-pm: warning: {message}", file=sys.stderr)

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
        again = said.total() - len(said)
        if again:
            came = "warning came again and is" if again == 1 else "warnings came again and are"
            print(f"aniso-pm: {again} {came} not repeated", file=sys.stderr)
