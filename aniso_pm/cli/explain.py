"""``aniso-pm explain``: one pixel, its eye path, its kernel."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError, one_line
from aniso_pm.pictures import output

from .common import (
    Define,
    Samples,
    SceneFile,
    Variant,
    load,
    mitsuba_log,
    parse_defines,
    require_file,
    set_variant,
)

_SUFFIXES = (".png", ".svg")


def explain(
    scene: SceneFile,
    pixel: Annotated[
        str, typer.Option("--pixel", metavar="X,Y", help="Pixel, from the top left of the film.")
    ],
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="Picture to write (.png or .svg).")
    ] = None,
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    spp: Samples = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Random seed.")] = 0,
    pass_index: Annotated[
        int, typer.Option("--pass", min=0, max=10**7, help="Photons of this pass.")
    ] = 0,
    sample: Annotated[
        int | None,
        typer.Option(min=0, max=63, help="Which of 64 eye paths to show; default: a typical one."),
    ] = None,
    sensor: Annotated[int, typer.Option("--sensor", "-s", min=0, help="Which camera.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Explain a pixel: its eye path, the reflection lobe, the kernel, the photons inside.

    The picture shows the lobe with the kernel on it, and the photons around the place where the
    eye path reads the photon map, with the kernel over them. A pixel that reads no photon map is
    told in a sentence, and no picture is written.
    """
    place = _parse_pixel(pixel)
    if out is not None:
        _check_picture(out)
    require_file(scene)
    set_variant(variant)
    with mitsuba_log(quiet=False):
        world, camera, integrator = load(scene, parse_defines(define or []), sensor, needed=False)
        from aniso_pm.instruments import explain as explanation

        try:
            found = explanation.explain(
                world, place, integrator, camera, seed, pass_index, sample=sample, spp=spp or 0
            )
        except ValueError as error:
            raise InputError(one_line(error)) from error
    if out is not None and found.kernel is None:
        print(f"aniso-pm: '{out}' is not written, there is no kernel to draw", file=sys.stderr)
    elif out is not None:
        with output.replacing(out) as partial:
            kind = out.suffix.lower()[1:]
            found.plot().savefig(partial, format=kind, dpi=144, bbox_inches="tight")
    if as_json:
        print(json.dumps(output.plain(found.data()), indent=2, ensure_ascii=False))
    else:
        print(found)
    return 0


def _parse_pixel(text: str) -> tuple[int, int]:
    x, _, y = text.partition(",")
    try:
        return int(x), int(y)
    except ValueError:
        raise InputError(f"--pixel takes two whole numbers X,Y, not '{text}'") from None


def _check_picture(out: Path) -> None:
    if out.suffix.lower() not in _SUFFIXES:
        raise InputError(f"cannot write '{out}': the picture's name must end in .png or .svg")
    output.check_writable(out)
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise InputError(
            "this needs matplotlib, which is not installed: pip install 'aniso-pm[report]'"
        ) from error
