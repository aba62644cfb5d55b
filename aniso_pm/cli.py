"""The command line program ``aniso-pm``.

Exit status: 0 done; 2 wrong usage or input, said in one line; 1 anything else; 130 interrupted,
with the picture so far written where the integrator can give it. Mitsuba is imported inside the
commands only.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer
from aniso_pm import _llvm, output
from aniso_pm._version import __version__
from aniso_pm.errors import InputError, is_interrupt, one_line
from aniso_pm.progress import bar

INTERRUPTED = 130


class InterruptError(Exception):
    """Ctrl-C before there was a picture (typer would end silently on KeyboardInterrupt itself)."""


app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main(arguments: list[str] | None = None) -> int:
    """Run the program with ``arguments`` (default: ``sys.argv``) and return its exit status."""
    try:
        return app(args=arguments, prog_name="aniso-pm", standalone_mode=False) or 0
    except (InputError, output.OutputError) as error:
        return _fail(2, str(error), error)
    except BrokenPipeError:
        # The reader of our output has left ("| head"): nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except BaseException as error:
        if hasattr(error, "format_message"):  # typer's own: wrong usage
            return _fail(2, f"{error.format_message()} (see aniso-pm --help)", error)
        if isinstance(error, InterruptError | typer.Abort) or is_interrupt(error):
            return _fail(INTERRUPTED, "interrupted, nothing written", error)
        if isinstance(error, SystemExit):
            raise
        return _fail(1, f"{type(error).__name__}: {one_line(error)}", error)


def _fail(status: int, message: str, error: BaseException) -> int:
    if os.environ.get("ANISO_PM_TRACEBACK"):
        import traceback

        traceback.print_exception(error)
    print(f"aniso-pm: error: {one_line(message)}", file=sys.stderr)
    return status


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"aniso-pm {__version__}")
        raise typer.Exit()


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Say which.")
    ] = False,
) -> None:
    """Photon mapping with anisotropic density estimation for Mitsuba 3.

    With ANISO_PM_TRACEBACK=1 in the environment, errors come with their Python traceback.
    """


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(help="Scene in Mitsuba's XML format.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="Picture to write (.exr).")],
    variant: Annotated[str, typer.Option("--variant", "-m", help="Variant.")] = "llvm_ad_rgb",
    define: Annotated[
        list[str] | None,
        typer.Option("--define", "-D", metavar="KEY=VALUE", help="Parameter $KEY of the scene."),
    ] = None,
    spp: Annotated[
        int | None, typer.Option(min=1, max=2**31 - 1, help="Samples per pixel in all.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Random seed.")] = 0,
    passes: Annotated[
        int | None, typer.Option(min=1, max=10**7, help="Stop after so many passes.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--time", min=0.001, help="Stop after so many seconds.")
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(min=1e-6, help="Stop at this relative standard error (0.02: 2 %)."),
    ] = None,
    first_pass: Annotated[
        int, typer.Option(min=0, max=10**7, help="Number of the first pass.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the state beside the picture.")
    ] = False,
    keep_state: Annotated[
        bool, typer.Option("--keep-state", help="Keep the state of a finished picture, to merge.")
    ] = False,
    save_every: Annotated[
        float, typer.Option(min=0, help="Seconds between savings of picture and state.")
    ] = 30.0,
    sensor: Annotated[int, typer.Option("--sensor", "-s", min=0, help="Which camera.")] = 0,
    png: Annotated[bool, typer.Option("--png", help="Also write an sRGB PNG beside it.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no warnings.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say on standard output what was done, as JSON.")
    ] = False,
) -> int:
    """Render a scene with the integrator it names and write the picture as OpenEXR.

    The header of the picture records parameters, seed, versions, timings and statistics. With
    several passes the layers "variance" and "standard_error" tell how noisy the picture is.

    --passes, --time and --target-error take the place of all the scene's own stopping rules.
    While passes are rendered, the picture so far and its state (OUT with the suffix .state) are
    saved again and again; --resume goes on from there. Finished pictures lose their state unless
    --resume or --keep-state was given. Passes 8 to 15 of a picture, to be merged with passes 0 to
    7, are --first-pass 8 --passes 8 with the same samples per pass.
    """
    # --- Find out what would fail, before anything slow ---
    defines = _parse_defines(define or [])
    if out.suffix.lower() != ".exr":
        raise InputError(f"cannot write '{out}': the output's name must end in .exr")
    picture = out.with_suffix(".png") if png else None
    for path in filter(None, [out, picture]):
        output.check_writable(path)
    if not scene.is_file():
        raise InputError(f"{scene}: there is no such file")

    _set_variant(variant)
    with _mitsuba_log(quiet):
        # --- Load the scene ---
        started = time.perf_counter()
        world, camera, integrator = _load(scene, defines, sensor)
        loaded = time.perf_counter()
        rules = {"passes": passes, "time": seconds, "target_error": target_error}
        rules = {name: value for name, value in rules.items() if value is not None}
        kept = _prepare_passes(integrator, rules, first_pass, resume or keep_state)
        made_by = {"scene": scene.name, "variant": variant, "seed": seed, "defines": defines}

        def write() -> dict[str, Any]:
            """Write the picture so far and what made it."""
            record = _record(integrator, camera) | made_by
            now = time.perf_counter()
            record["seconds"] = {"load": loaded - started, "render": now - loaded}
            variance = getattr(integrator, "variance", None)
            output.write_exr(camera.film(), out, record, variance)
            if picture:
                output.write_png(camera.film(), picture)
            return record

        # --- Render ---
        state_file = out.with_suffix(".state")
        if kept is not None:
            from aniso_pm.state import Checkpoint

            output.sweep(state_file)
            output.sweep(out)
            integrator.checkpoint = Checkpoint(state_file, save_every, resume, write)
            if resume and not state_file.exists() and not quiet:
                print(f"aniso-pm: no state '{state_file}' yet, starting afresh", file=sys.stderr)
        _render(world, camera, integrator, seed, spp, quiet)
        record = write()
        statistics = record["statistics"]
        if kept is False and not statistics["interrupted"]:
            state_file.unlink(missing_ok=True)

    if as_json:
        record |= {"output": str(out), "png": str(picture) if picture else None}
        print(json.dumps(output.plain(record), indent=2, ensure_ascii=False))
    if statistics.get("interrupted"):
        print("aniso-pm: interrupted, the picture so far is written", file=sys.stderr)
        return INTERRUPTED
    return 0


@app.command()
def merge(
    states: Annotated[list[Path], typer.Argument(help="States (.state), or their pictures.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="Picture to write (.exr).")],
    png: Annotated[bool, typer.Option("--png", help="Also write an sRGB PNG beside it.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say on standard output what was done, as JSON.")
    ] = False,
) -> int:
    """Add up passes of one picture that were rendered apart, with --keep-state.

    Writes the picture and, beside it, the state of all passes, from which it can be merged again
    or resumed. All must have the same scene, parameters, seed and samples per pass, and no pass
    may occur twice.
    """
    from aniso_pm import film as films
    from aniso_pm.state import State, StateError
    from aniso_pm.state import merge as merged

    if out.suffix.lower() != ".exr":
        raise InputError(f"cannot write '{out}': the output's name must end in .exr")
    picture = out.with_suffix(".png") if png else None
    for path in filter(None, [out, picture]):
        output.check_writable(path)
    try:
        loaded = {}
        for name in states:
            path = name.with_suffix(".state") if name.suffix.lower() == ".exr" else name
            if str(path) in loaded:
                raise InputError(f"{path}: named twice")
            loaded[str(path)] = State.load(path)
        total = merged(loaded)
    except StateError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}") from error

    _set_variant(total.identity["variant"])
    try:
        film = films.from_description(total.film)
    except ValueError as error:
        raise InputError(str(error)) from error
    films.show_array(film, total.arrays["first"])
    record = {
        "merged": list(loaded),
        "passes": total.passes,
        "seed": total.identity["seed"],
        "variant": total.identity["variant"],
        "statistics": total.statistics,
        "depends_on": total.identity,
    }
    output.write_exr(film, out, record, total.variance())
    if picture:
        output.write_png(film, picture)
    total.save(out.with_suffix(".state"))
    if as_json:
        record |= {"output": str(out), "png": str(picture) if picture else None}
        print(json.dumps(output.plain(record), indent=2, ensure_ascii=False))
    return 0


@app.command()
def inspect(
    scene: Annotated[Path, typer.Argument(help="Scene in Mitsuba's XML format.")],
    variant: Annotated[str, typer.Option("--variant", "-m", help="Variant.")] = "llvm_ad_rgb",
    define: Annotated[
        list[str] | None,
        typer.Option("--define", "-D", metavar="KEY=VALUE", help="Parameter $KEY of the scene."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON list.")] = False,
) -> int:
    """Say what a scene needs of the photon mapper, what is left out, and why.

    A scene whose integrator is another one is inspected for aniso_pm with default parameters.
    """
    if not scene.is_file():
        raise InputError(f"{scene}: there is no such file")
    _set_variant(variant)
    with _mitsuba_log(quiet=False):
        world, _, integrator = _load(scene, _parse_defines(define or []), 0)
        from aniso_pm import inspect as inspection
        from aniso_pm.prepared import prepare
        from aniso_pm.settings import Settings

        settings = getattr(integrator, "settings", None) or Settings()
        try:
            findings = inspection.examine(prepare(world, settings, False))
        except ValueError as error:
            raise InputError(one_line(error)) from error
    if as_json:
        print(json.dumps(inspection.as_data(findings), indent=2, ensure_ascii=False))
    else:
        print(inspection.as_text(findings))
    return 0


@app.command()
def stability(
    out: Annotated[Path, typer.Option("--output", "-o", help="Directory to write into.")],
    variant: Annotated[str, typer.Option("--variant", "-m", help="Variant.")] = "llvm_ad_rgb",
    quick: Annotated[bool, typer.Option("--quick", help="Leave out the slow cases.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the record instead of the table.")
    ] = False,
) -> int:
    """Measure extreme cases against 50-digit references and write the table.

    Writes stability.json, stability.html and stability.md. Exit status 1 if a case fails.
    """
    try:
        import jinja2  # noqa: F401
        import mpmath  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"this needs {error.name}, which is not installed: pip install 'aniso-pm[stability]'"
        ) from error
    _make_directory(out)
    _set_variant(variant)

    from aniso_pm.doctor import versions
    from aniso_pm.stability import all_cases, case, page

    rows = []
    with _mitsuba_log(quiet=True):
        for row in case.run(all_cases(), quick):
            rows.append(row)
            if not as_json:
                print(page.line(row), flush=True)
    about = {"versions": versions(), "variant": variant, "quick": quick}
    found = page.record(rows, about)
    paths = page.write(out, found)
    if as_json:
        print(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        print(f"{page.summary(found['counts'])}; written: {', '.join(map(str, paths))}")
    return int(found["counts"][case.FAIL] > 0)


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Say what is installed and whether it works, with the fix for what does not."""
    from aniso_pm import doctor as examination

    checks = examination.examine()
    print(examination.as_json(checks) if as_json else examination.as_text(checks))
    return int(any(check.fix for check in checks))


def _make_directory(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into '{path}': {error.strerror or error}") from error
    output.check_writable(path / "stability.json")


def _parse_defines(pairs: list[str]) -> dict[str, str]:
    defines = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise InputError(f"-D takes KEY=VALUE, not '{pair}'")
        defines[key] = value
    return defines


def _set_variant(variant: str) -> None:
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


def _load(scene: Path, defines: dict[str, str], sensor: int):
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


def _prepare_passes(
    integrator, rules: dict[str, Any], first_pass: int, keep_state: bool
) -> bool | None:
    """Set the options that concern passes; an InputError where the integrator has none.

    Returns whether the state shall stay when all is done, and None where there is none to keep:
    a single pass has no state unless it is asked for.
    """
    if not hasattr(integrator, "stop_after"):
        options = [f"--{name.replace('_', '-')}" for name in rules]
        options += ["--first-pass"] if first_pass else []
        options += ["--resume or --keep-state"] if keep_state else []
        if options:
            kind = integrator.class_name()
            raise InputError(f"{', '.join(options)}: {kind} renders in one pass only")
        return None
    if rules:
        try:
            integrator.stop_after(**rules)
        except ValueError as error:
            raise InputError(one_line(error)) from error
    integrator.first_pass = first_pass
    return keep_state if keep_state or integrator.settings.passes != 1 else None


def _render(world, camera, integrator, seed: int, spp: int | None, quiet: bool) -> None:
    """Leave the picture in the camera's film."""
    visible = not quiet and sys.stderr.isatty() and hasattr(integrator, "progress")
    try:
        with bar(integrator, file=sys.stderr, leave=False) if visible else nullcontext():
            # Not mi.render(): it hides errors inside a differentiable operation.
            integrator.render(world, sensor=camera, seed=seed, spp=spp or 0)
    except ValueError as error:
        # Something the integrator cannot do with this scene or these parameters
        raise InputError(one_line(error)) from error
    except BaseException as error:
        if is_interrupt(error):
            raise InterruptError from error
        raise


def _record(integrator, camera) -> dict[str, Any]:
    from aniso_pm.doctor import versions

    statistics = dict(getattr(integrator, "statistics", None) or {})
    kind = type(integrator)
    in_python = not kind.__module__.startswith("mitsuba")
    return {
        "integrator": kind.__name__ if in_python else integrator.class_name(),
        # Samplers may round what was asked for.
        "spp": statistics.get("spp", camera.sampler().sample_count()),
        "size": [int(pixels) for pixels in camera.film().size()],
        "parameters": integrator.parameters() if hasattr(integrator, "parameters") else {},
        "statistics": statistics,
        "versions": versions(),
    }


@contextmanager
def _mitsuba_log(quiet: bool) -> Iterator[None]:
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


if __name__ == "__main__":
    sys.exit(main())
