"""Scenes given as dictionaries: into plain data that can travel, and back.

Transforms, points, vectors, colours, arrays, tensors and bitmaps become NumPy arrays with a mark of
what they were; files get the names that they have in the archive. Objects of Mitsuba that already
live in this process cannot travel and are refused by the place where they stand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from aniso_pm.errors import InputError

from .scene_files import packed_name

# Small types of Mitsuba that dictionaries hold, as they are called.
_SMALL = [
    f"Scalar{kind}"
    for kind in (
        *(f"Point{n}{t}" for n in (2, 3) for t in "fdiu"),
        *(f"Vector{n}{t}" for n in (2, 3) for t in "fdiu"),
        *(f"Color{n}{t}" for n in (1, 3) for t in "fd"),
        *("Normal3f", "Normal3d"),
    )
]
_TRANSFORMS = [
    f"{scalar}{kind}Transform{n}{t}"
    for scalar in ("Scalar", "")
    for kind in ("", "Affine", "Projective")
    for n in (3, 4)
    for t in "fd"
]
_BITMAP = "Bitmap"


@dataclass(frozen=True)
class Marked:
    """What was an object of Mitsuba: name of its type, its numbers, what else it takes."""

    kind: str
    values: np.ndarray
    more: dict[str, Any]


def packed(scene: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, bytes], dict[str, Path]]:
    """(plain dictionary, packed name → content, packed name → where from).

    Raises InputError for a file that is not there and for what cannot travel."""
    files: dict[str, bytes] = {}
    sources: dict[str, Path] = {}
    names: dict[Path, str] = {}

    def go(value, place: str):
        if isinstance(value, Mapping):
            return {
                key: go(item, f"{place}.{key}" if place else key) for key, item in value.items()
            }
        if place.rpartition(".")[2] == "filename" and isinstance(value, str | Path):
            path = _found(Path(value), place)
            if path not in names:
                names[path] = name = packed_name(len(names), path)
                files[name], sources[name] = path.read_bytes(), path
            return Marked("filename", np.empty(0), {"name": names[path]})
        if isinstance(value, str | bool | int | float) or value is None:
            return value
        if isinstance(value, list | tuple):
            return type(value)(go(item, place) for item in value)
        return _marked(value, place)

    return go(scene, ""), files, sources


def unpacked(plain: Any, folder: Path) -> Any:
    """Inverse of :func:`packed`, with the files in ``folder``."""
    if isinstance(plain, Mapping):
        return {key: unpacked(item, folder) for key, item in plain.items()}
    if isinstance(plain, list | tuple):
        return type(plain)(unpacked(item, folder) for item in plain)
    if not isinstance(plain, Marked):
        return plain
    if plain.kind == "filename":
        return str(folder / plain.more["name"])
    if plain.kind == "ndarray":
        return plain.values
    if plain.kind == _BITMAP:
        names, formats = plain.more["channels"], mi.Bitmap.PixelFormat
        bitmap = mi.Bitmap(plain.values, getattr(formats, plain.more["pixel_format"]), names)
        bitmap.set_srgb_gamma(plain.more["srgb_gamma"])
        bitmap.set_premultiplied_alpha(plain.more["premultiplied"])
        return bitmap
    made = getattr(mi, plain.kind)(plain.values)
    if "inverse_transpose" in plain.more:
        made.inverse_transpose = type(made.inverse_transpose)(plain.more["inverse_transpose"])
    return made


def _found(path: Path, place: str) -> Path:
    for folder in (Path.cwd(), *(Path(str(p)) for p in mi.file_resolver())):
        if (folder / path).is_file():
            return (folder / path).resolve()
    raise InputError(f"'{place}' names the file '{path}', which is not there")


def _marked(value, place: str) -> Marked:
    kind = type(value)
    if isinstance(value, np.ndarray | np.generic):
        return Marked("ndarray", np.asarray(value), {})
    if isinstance(value, mi.Bitmap):
        more = {
            "pixel_format": value.pixel_format().name,
            "channels": [field.name for field in value.struct_()],
            "srgb_gamma": value.srgb_gamma(),
            "premultiplied": value.premultiplied_alpha(),
        }
        return Marked(_BITMAP, np.array(value), more)
    for name in _TRANSFORMS:
        if kind is getattr(mi, name, None):
            # The inverse, too: computed anew it would differ in the last digits.
            both = np.array(value.matrix), np.array(value.inverse_transpose)
            # Transforms of one lane each, where they are those of a variant.
            one = [m[..., 0] if m.ndim == 3 else m for m in both]
            return Marked(name, one[0], {"inverse_transpose": one[1]})
    for name in (*_SMALL, "TensorXf", "TensorXd"):
        if kind is getattr(mi, name, None):
            return Marked(name, np.array(value), {})
    raise InputError(
        f"'{place}' is a {kind.__name__}, an object of this process that cannot travel to workers; "
        "describe it by a dictionary"
    )
