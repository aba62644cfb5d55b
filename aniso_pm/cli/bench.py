"""``aniso-pm bench``: speed and memory, target beside figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError

from .common import Define, Variant, load, mitsuba_log, parse_defines, set_variant


def bench(
    groups: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[gather|trace|build|pass|memory|startup|kernels|error|large|denoise|all]...",
            help="What to measure; by default all but error, large and denoise, which take long.",
        ),
    ] = None,
    scenes: Annotated[
        list[Path] | None,
        typer.Option(
            "--scene",
            help="Scene that error renders instead of the gallery; it needs a reference (aniso-pm "
            "reference). Can be repeated.",
        ),
    ] = None,
    define: Define = None,
    variant: Variant = "llvm_ad_rgb",
    quick: Annotated[
        bool, typer.Option("--quick", help="Smaller sizes, fewer repetitions; less than a minute.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON list.")] = False,
) -> int:
    """Measure speed and memory and print each target beside the figure.

    Kernels are compiled before anything is timed, and what is compared is measured in turn. "error
    --scene FILE" compares this package as installed with Mitsuba's path on that scene. With
    --json: a list of objects with name, figure (null if it could not be measured), unit, target
    (such as ">= 0.85"; null where the line informs only), met (true, false or null) and note.
    Exit status 0 also where a target is missed.
    """
    from aniso_pm.instruments.bench import GROUPS, LONG
    from aniso_pm.instruments.report import reference

    groups = groups or [group for group in GROUPS if group not in LONG]
    for group in groups:
        if group not in (*GROUPS, "all"):
            raise InputError(
                f"there is nothing to measure by the name '{group}'; there are "
                f"{', '.join(GROUPS)} and all"
            )
    wanted = [group for group in GROUPS if group in groups or "all" in groups]
    if scenes and "error" not in wanted:
        raise InputError("--scene is for the group error: aniso-pm bench error --scene FILE")
    if define and not scenes:
        raise InputError("--define is for scenes that are named by --scene")
    defines = parse_defines(define or [])
    set_variant(variant)
    for file in scenes or []:
        # What is wrong with it is said before anything is rendered.
        world, camera, _ = load(file, defines, 0, needed=False)
        reference.require(file, world, camera)

    from aniso_pm.instruments.bench import measure
    from aniso_pm.instruments.bench.row import HEADER, as_data, line, summary
    from aniso_pm.pictures import output

    if not as_json:
        print(HEADER)
    rows = []
    with mitsuba_log(quiet=False):
        for row in measure(wanted, quick, scenes, defines):
            rows.append(row)
            if not as_json:
                print(line(row), flush=True)
    if as_json:
        print(
            json.dumps(output.plain([as_data(row) for row in rows]), indent=2, ensure_ascii=False)
        )
    else:
        print(summary(rows))
    return 0
