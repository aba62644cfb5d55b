"""``aniso-pm render`` and ``aniso-pm merge``."""

from __future__ import annotations

import json
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer
from aniso_pm.errors import InputError, one_line
from aniso_pm.pictures import output
from aniso_pm.rendering.progress import bar

from .common import (
    INTERRUPTED,
    Camera,
    Define,
    Integrator,
    Layers,
    Parameter,
    Passes,
    Samples,
    SceneFile,
    Seconds,
    Seed,
    TargetError,
    Variant,
    load,
    mitsuba_log,
    parse_defines,
    parse_parameters,
    require_file,
    set_variant,
    stopping_rules,
    telling_what_is_kept,
)
from .pictures import Bits, Denoise, Exposure, Pictures, Png, Tonemap
from .workers import (
    Mixed,
    Scheduler,
    SchedulerFile,
    TaskLimit,
    TaskSeconds,
    TlsCa,
    TlsCert,
    TlsKey,
    Workers,
    rendering_elsewhere,
)

_SAVE_EVERY = 30.0  # seconds


def render(
    scene: SceneFile,
    out: Annotated[Path, typer.Option("--output", "-o", help="Picture to write (.exr).")],
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    spp: Samples = None,
    seed: Seed = 0,
    passes: Passes = None,
    seconds: Seconds = None,
    target_error: TargetError = None,
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
        float | None,
        typer.Option(min=0, help="Seconds between savings of picture and state.  [default: 30]"),
    ] = None,
    sensor: Camera = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    scheduler_file: SchedulerFile = None,
    mixed: Mixed = False,
    task_seconds: TaskSeconds = None,
    task_limit: TaskLimit = None,
    tls_ca_file: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    integrator_name: Integrator = None,
    parameter: Parameter = None,
    layer_names: Layers = None,
    denoise: Denoise = False,
    png: Png = False,
    exposure: Exposure = 0.0,
    tonemap: Tonemap = "srgb",
    bits: Bits = 8,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no warnings.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say on standard output what was done, as JSON.")
    ] = False,
) -> int:
    """Render a scene with the integrator it names, or another one, and write it as OpenEXR.

    The header of the picture records parameters, seed, versions, timings and statistics. With
    several passes the layers "variance" and "standard_error" tell how noisy the picture is.

    --passes, --time and --target-error take the place of all the scene's own stopping rules.
    While passes are rendered, the picture so far and its state (OUT with the suffix .state) are
    saved again and again; --resume goes on from there. Finished pictures lose their state unless
    --resume or --keep-state was given. Passes 8 to 15 of a picture, to be merged with passes 0 to
    7, are --first-pass 8 --passes 8 with the same samples per pass.

    --workers 4 renders the passes in four processes of this machine, --scheduler or
    --scheduler-file on the workers of a Dask cluster, with the same picture. Whoever can reach a
    Dask scheduler can run code on its workers: use TLS, or a network of your own.

    --layers takes albedo, normal, depth, position, direct, caustic, indirect, samples, radius,
    standard_error, denoising (see the integrator's parameter of that name). --denoise leaves the
    picture as it was rendered and adds a layer, denoised; it asks for the layers of denoising.
    """
    # --- Find out what would fail, before anything slow ---
    defines = parse_defines(define or [])
    rules = stopping_rules(passes, seconds, target_error)
    parameters = parse_parameters(parameter, layers=layer_names, **rules)
    pictures = Pictures.checked(out, png, exposure, tonemap, bits, denoise)
    require_file(scene)
    state_file = out.with_suffix(".state")

    set_variant(variant)
    with mitsuba_log(quiet):
        # --- Load the scene ---
        started = time.perf_counter()
        world, camera, integrator = load(scene, defines, sensor, integrator_name, parameters)
        loaded = time.perf_counter()
        pictures.check_film(camera.film())
        kept = _prepare_passes(integrator, rules, first_pass, resume or keep_state, save_every)
        if state_file.exists() and not resume:
            go_on = "--resume goes on with them, or " * hasattr(integrator, "stop_after")
            raise InputError(
                f"{state_file}: passes of an earlier rendering are there; {go_on}"
                "delete the file to start afresh"
            )
        save_every = _SAVE_EVERY if save_every is None else save_every
        if kept is not None:
            output.check_writable(state_file)
        _ask_for_layers(integrator, layer_names, denoise)
        from aniso_pm.rendering.film import pixel_weights

        weights = pixel_weights(camera.film()) if denoise else [1.0]
        made_by = {"scene": scene.name, "variant": variant, "seed": seed, "defines": defines}

        def write() -> dict[str, Any]:
            """Write the picture so far and what made it."""
            record = record_of(integrator, camera) | made_by
            now = time.perf_counter()
            record["seconds"] = {"load": loaded - started, "render": now - loaded}
            variance = getattr(integrator, "variance", None)
            layers = getattr(integrator, "layers", None)
            pictures.write(camera.film(), record, variance, layers, weights)
            return record

        # --- Render ---
        if kept is not None:
            from aniso_pm.rendering.state import Checkpoint

            output.sweep(state_file)
            output.sweep(out)
            integrator.checkpoint = Checkpoint(state_file, save_every, resume, write)
            if resume and not state_file.exists() and not quiet:
                print(f"aniso-pm: no state '{state_file}' yet, starting afresh", file=sys.stderr)
        with telling_what_is_kept(state_file):
            with rendering_elsewhere(
                integrator,
                scene,
                defines,
                sensor,
                workers,
                scheduler,
                scheduler_file,
                {"ca_file": tls_ca_file, "client_cert": tls_cert, "client_key": tls_key},
                mixed=mixed,
                task_seconds=task_seconds,
                task_limit=task_limit,
                # As often as the picture is saved.
                home_every=max(save_every, 1.0),
                passes=_passes(integrator, spp, camera),
            ):
                _render(world, camera, integrator, seed, spp, quiet)
            record = write()
        statistics = record["statistics"]
        if kept is False and not statistics["interrupted"] and not statistics.get("failure"):
            state_file.unlink(missing_ok=True)

    if as_json:
        record |= {"output": str(out), "png": str(pictures.png) if pictures.png else None}
        print(json.dumps(output.plain(record), indent=2, ensure_ascii=False))
    elif not quiet:
        print(_done(record, out, pictures.png))
    if statistics.get("failure"):
        done = f"{statistics['passes']} passes" if statistics["passes"] else "part of a pass"
        print(
            f"aniso-pm: error: {statistics['failure']}; the picture so far ({done}) is written",
            file=sys.stderr,
        )
        return 1
    if statistics.get("interrupted"):
        print("aniso-pm: interrupted, the picture so far is written", file=sys.stderr)
        return INTERRUPTED
    return 0


def merge(
    states: Annotated[list[Path], typer.Argument(help="States (.state), or their pictures.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="Picture to write (.exr).")],
    passes: Annotated[
        int | None, typer.Option(min=1, max=10**7, help="Say which of so many passes are missing.")
    ] = None,
    first_pass: Annotated[
        int, typer.Option(min=0, max=10**7, help="Number of the first of those.")
    ] = 0,
    denoise: Denoise = False,
    png: Png = False,
    exposure: Exposure = 0.0,
    tonemap: Tonemap = "srgb",
    bits: Bits = 8,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say on standard output what was done, as JSON.")
    ] = False,
) -> int:
    """Add up passes of one picture that were rendered apart, with --keep-state.

    Writes the picture and, beside it, the state of all passes, from which it can be merged again
    or resumed. All must have the same scene, parameters, seed and samples per pass, and no pass
    may occur twice. Jobs that still render may be merged, too: with what they have so far. --passes
    tells on standard error which passes are missing from the picture.
    """
    from aniso_pm.rendering import film as films
    from aniso_pm.rendering.state import State, StateError, describe, missing
    from aniso_pm.rendering.state import merge as merged

    pictures = Pictures.checked(out, png, exposure, tonemap, bits, denoise)
    if first_pass and not passes:
        raise InputError("--first-pass: only with --passes")
    try:
        loaded = [
            str(name.with_suffix(".state") if name.suffix.lower() == ".exr" else name)
            for name in states
        ]
        for file in loaded:
            if loaded.count(file) > 1:
                raise InputError(f"{file}: named twice")
        ours = out.with_suffix(".state")
        if ours.resolve() in [Path(file).resolve() for file in loaded]:
            raise InputError(
                f"{out}: its state would take the place of '{ours}', which is one of those to be "
                "merged; give another output"
            )
        total = State.load(Path(loaded[0]))
        for file in loaded[1:]:  # one after the other: there may be thousands of large ones
            total = merged({loaded[0]: total, file: State.load(Path(file))})
    except StateError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}") from error

    set_variant(total.identity["variant"])
    try:
        film = films.from_description(total.film)
    except ValueError as error:
        raise InputError(str(error)) from error
    films.show_array(film, total.arrays["first"])
    record = {
        "merged": loaded,
        "passes": total.passes,
        "missing": missing(total.passes, first_pass, passes) if passes else None,
        "seed": total.identity["seed"],
        "variant": total.identity["variant"],
        "statistics": total.statistics,
        "depends_on": total.identity,
    }
    weights = total.film.get("filter", [1.0])
    pictures.write(film, record, total.variance(), total.layers(), weights)
    total.save(out.with_suffix(".state"))
    if record["missing"]:
        count = sum(end - start for start, end in record["missing"])
        print(
            f"aniso-pm: {count} of {passes} passes are missing: {describe(record['missing'])}",
            file=sys.stderr,
        )
    if as_json:
        record |= {"output": str(out), "png": str(pictures.png) if pictures.png else None}
        print(json.dumps(output.plain(record), indent=2, ensure_ascii=False))
    else:
        print(f"{out}: {total.count} passes of {len(loaded)} states")
    return 0


def _prepare_passes(
    integrator,
    rules: dict[str, Any],
    first_pass: int,
    keep_state: bool,
    save_every: float | None,
) -> bool | None:
    """Set the options that concern passes; an InputError where the integrator has none.

    Returns whether the state shall stay when all is done, and None where there is none to keep:
    a single pass has no state unless it is asked for.
    """
    if not hasattr(integrator, "stop_after"):
        options = [f"--{name.replace('_', '-')}" for name in rules]
        options += ["--first-pass"] if first_pass else []
        options += ["--resume or --keep-state"] if keep_state else []
        options += ["--save-every"] if save_every is not None else []
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
    settings = integrator.settings
    if keep_state or settings.passes > 1 or settings.open_ended:
        return keep_state
    if settings.automatic_passes and save_every is not None:
        return False
    if save_every is not None:
        raise InputError(
            "--save-every: a single pass is saved at its end; give --passes, --time or "
            "--target-error"
        )
    return None


def _passes(integrator, spp: int | None, camera) -> int:
    """That will be rendered, 0 without end."""
    from aniso_pm.rendering.schedule import with_passes

    settings = getattr(integrator, "settings", None)
    return with_passes(settings, spp or 0, camera).passes if settings else 1


def _ask_for_layers(integrator, layers: str | None, denoise: bool) -> None:
    """Set the layers to be kept; an InputError where the integrator has none."""
    if not hasattr(integrator, "settings"):
        if layers:
            raise InputError(f"--layers: {integrator.class_name()} has none; aniso_pm does")
        return
    asked = integrator.settings.layers if layers is None else layers
    if denoise:
        asked += ",denoising"
    try:
        integrator.settings = integrator.settings.with_(layers=asked.strip(","))
    except ValueError as error:
        raise InputError(one_line(error)) from error


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


def _done(record: dict[str, Any], out: Path, picture: Path | None) -> str:
    """What was rendered, in a line."""
    statistics = record["statistics"]
    parts = [f"{record['spp']} samples a pixel"]
    if statistics.get("passes"):
        parts.append(f"{statistics['passes']} pass{'es' * (statistics['passes'] > 1)}")
    if statistics.get("photons_stored"):
        first = statistics["initial_radius"]
        radii = [f"{radius:.3g}" for radius in (first, statistics.get("radius") or first)]
        parts.append(f"kernel radius {' to '.join(dict.fromkeys(radii))}")
    if statistics.get("relative_error"):
        parts.append(f"standard error {statistics['relative_error']:.1%}")
    took, asked = record["seconds"]["render"], record["parameters"].get("time")
    late = asked and statistics.get("passes") == 1 and took > 1.5 * asked
    more = f" (asked for {asked:g} s: a pilot and one pass take more)" if late else ""
    parts.append(f"{took:.1f} s{more}")
    return f"{', '.join(str(path) for path in (out, picture) if path)}: {', '.join(parts)}"


def record_of(integrator, camera) -> dict[str, Any]:
    """What made a picture, for its header."""
    from aniso_pm.instruments.doctor import versions

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
