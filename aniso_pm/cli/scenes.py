"""``aniso-pm scenes``: the gallery, to look at and to start from."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import fill
from typing import Annotated

import typer
from aniso_pm.errors import InputError
from aniso_pm.instruments import gallery


def scenes(
    target: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="Directory to copy the scenes into.")
    ] = None,
    show: Annotated[bool, typer.Option("--list", help="Say what there is; copy nothing.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite what is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Copy the gallery: scenes with meshes, textures and references, to render and to change."""
    if (target is None) != show:
        raise InputError("name a directory to copy the scenes into, or say --list")
    copied = gallery.copy(target, force) if target else []
    found = gallery.scenes()
    if as_json:
        listed = [
            {
                "name": scene.name,
                "about": scene.about,
                "file": str(target / scene.file.name if target else scene.file),
            }
            for scene in found
        ]
        print(json.dumps({"scenes": listed, "files": [str(path) for path in copied]}, indent=2))
    elif show:
        for scene in found:
            print(fill(f"{scene.name}: {scene.about}", 100, subsequent_indent="    "))
    elif target:
        first = target / "brushed_wall.xml"
        print(
            f"{len(found)} scenes in {target}; try\n"
            f"  aniso-pm render {first} -o brushed_wall.exr --png\n"
            f"  aniso-pm inspect {first}\n"
            f"  aniso-pm report {first} --quick -o report"
        )
    return 0
