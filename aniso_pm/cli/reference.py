"""``aniso-pm reference``: what the report compares with."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError, is_interrupt
from aniso_pm.pictures import output
from aniso_pm.rendering.progress import shown

from .common import (
    INTERRUPTED,
    Define,
    SceneFile,
    Variant,
    load,
    make_directory,
    mitsuba_log,
    parse_defines,
    require_file,
    set_variant,
)

SAVE_EVERY = 30.0


def reference(
    scene: SceneFile,
    seconds: Annotated[
        float | None, typer.Option("--time", min=0.001, help="Add samples for so many seconds.")
    ] = None,
    spp: Annotated[
        int | None,
        typer.Option(min=2, max=2**31 - 1, help="End at so many samples per pixel in all."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write (.exr); default: a cache.")
    ] = None,
    integrator: Annotated[str, typer.Option("--integrator", help="Mitsuba's name of it.")] = "path",
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Random seed.")] = 0,
    sensor: Annotated[int, typer.Option("--sensor", "-s", min=0, help="Which camera.")] = 0,
    compact: Annotated[
        bool, typer.Option("--compact", help="Half precision, compressed with loss.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no warnings.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say on standard output what was done, as JSON.")
    ] = False,
) -> int:
    """Render a reference with an independent, unbiased integrator, or make one better.

    Two pictures with different random numbers, whose difference tells the reference's own error.
    If the file is there already, samples are added to it: it must be of the same scene, camera and
    film, by the same integrator, from the same seed. The scene's own integrator matters only with
    its max_depth and hide_emitters. --time, --spp or both say when to end.

    Reports find references in the directory "references" beside the scene (NAME*.exr for NAME.xml,
    one for each size of film, for example), then in the cache (aniso_pm/references in
    $XDG_CACHE_HOME or ~/.cache).
    """
    from aniso_pm.instruments.report import reference as references

    if seconds is None and spp is None:
        raise InputError("say when to end: --time SECONDS, --spp N or both")
    if out and out.suffix.lower() != ".exr":
        raise InputError(f"cannot write '{out}': the output's name must end in .exr")
    if out:
        output.check_writable(out)
    require_file(scene)
    defines = parse_defines(define or [])
    set_variant(variant)
    with mitsuba_log(quiet):
        world, camera, _ = load(scene, defines, sensor, needed=False)
        path = out or references.cache_path(scene, references.depends_on(world, camera))
        if not out:
            make_directory(path.parent)
        start = references.read(path) if path.exists() else None
        made, saved, interrupted = start, time.perf_counter(), False
        visible = not quiet and sys.stderr.isatty()
        unit = "s" if seconds else "spp"
        with shown(unit=unit, disable=not visible, file=sys.stderr, leave=False) as show:
            try:
                for made in references.grow(world, camera, integrator, seconds, spp, seed, start):
                    show(*references.state_of(made, seconds, spp, start))
                    if time.perf_counter() - saved > SAVE_EVERY:
                        references.write(path, made, compact)
                        saved = time.perf_counter()
            except BaseException as error:
                if not is_interrupt(error) or made is None:
                    raise
                interrupted = True
        assert made is not None  # grow() has yielded, or raised
        made.record.update(scene=scene.name, defines=defines)
        references.write(path, made, compact)
    record = made.record | {"output": str(path), "own_error": made.own_error}
    if as_json:
        print(json.dumps(output.plain(record), indent=2, ensure_ascii=False))
    else:
        print(
            f"{path}: {record['spp']} samples per pixel in {record['seconds']:.0f} s, "
            f"own relative error {made.own_error:.2%}"
        )
    if interrupted:
        print("aniso-pm: interrupted, the reference so far is written", file=sys.stderr)
        return INTERRUPTED
    return 0
