"""``aniso-pm report``: what each second buys."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError, is_interrupt
from aniso_pm.rendering.progress import shown

from .common import (
    INTERRUPTED,
    Define,
    Variant,
    make_directory,
    mitsuba_log,
    parse_defines,
    set_variant,
)


def report(
    scenes: Annotated[list[Path], typer.Argument(help="Scenes in Mitsuba's XML format.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="Directory to write into.")],
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="aniso_pm (as installed), isotropic, lobe, taylor, paper (each at its default and "
            "at its best bandwidth; NAME/default, NAME/best), or an integrator of Mitsuba's: path, "
            "path:max_depth=8.",
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--time", help="Largest budget, seconds (5).")
    ] = None,
    budgets: Annotated[
        int | None, typer.Option(help="Number of budgets, from a hundredth of it on (7).")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Runs of each method (5).")] = None,
    photons: Annotated[
        int | None, typer.Option(help="Light paths of a pass where kernels are compared (250000).")
    ] = None,
    spp: Annotated[int | None, typer.Option(help="Samples per pixel of such a pass (8).")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A look: 1.5 seconds, 3 seeds, 6 methods.")
    ] = False,
    denoise: Annotated[
        bool,
        typer.Option(
            "--denoise",
            help="Measure denoised pictures beside the raw ones. Takes twice the time.",
        ),
    ] = False,
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    sensor: Annotated[int, typer.Option("--sensor", "-s", min=0, help="Which camera.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no warnings.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the results instead of what was found.")
    ] = False,
) -> int:
    """Measure error against run time, and write a page about it.

    Writes index.html (which needs no other file), results.json (results.schema.json describes it),
    figures/ and cells/. Runs kept in cells/ are not repeated: an interrupted report goes on where
    it was. Each scene needs a reference (aniso-pm reference). With -D, all scenes get the
    parameter. Exit status 1 if a run failed.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
        import scipy  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"this needs {error.name}, which is not installed: pip install 'aniso-pm[report]'"
        ) from error
    from aniso_pm.instruments.report import conclusions, make
    from aniso_pm.instruments.report.plan import Plan

    set_variant(variant)
    asked = {
        "methods": tuple(method) if method else None,
        "seconds": seconds,
        "budgets": budgets,
        "seeds": seeds,
        "photons": photons,
        "spp": spp,
    }
    asked = {name: value for name, value in asked.items() if value is not None}
    asked["denoise"] = denoise
    plan = Plan.quickly(**asked) if quick else Plan(**asked)
    make_directory(out)
    visible = not quiet and sys.stderr.isatty()
    with (
        mitsuba_log(quiet),
        shown(unit="s", disable=not visible, file=sys.stderr, leave=False) as show,
    ):
        try:
            made = make.report(scenes, out, plan, parse_defines(define or []), sensor, show)
        except BaseException as error:
            if not is_interrupt(error):
                raise
            print("aniso-pm: interrupted; the same command goes on from here", file=sys.stderr)
            return INTERRUPTED
    if made.stale and not quiet:
        print(
            f"aniso-pm: {len(made.stale)} kept runs were of another scene, plan, version or "
            "machine, and were run again",
            file=sys.stderr,
        )
    if as_json:
        print(json.dumps(made.results, indent=2, ensure_ascii=False))
    else:
        print(conclusions.as_text(made.results))
        print(f"written: {made.page}")
    return int(any(scene["failures"] for scene in made.results["scenes"]))
