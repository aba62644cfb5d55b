"""Pictures on disk: the film as OpenEXR with everything that made it (PNG: see ``display``).

Files appear whole or not at all: they are written under another name in the same directory and
renamed. Whether that can work is found out before the render (:func:`check_writable`), not after.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class OutputError(Exception):
    """A picture cannot be written where, or as what, it was asked for."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` that takes its place if the block succeeds, once its
    content is on the disk."""
    partial = _partial(path, os.getpid())
    try:
        yield partial
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _partial(path: Path, process: int | str) -> Path:
    return path.with_name(f".{path.stem}.partial.{process}{path.suffix}")


def sweep(path: Path) -> None:
    """Remove what killed processes have left half-written for ``path``."""
    for partial in path.parent.glob(_partial(path, "*").name):
        process = partial.name.removesuffix(path.suffix).rpartition(".")[2]
        if process.isdigit() and not Path("/proc", process).exists() and Path("/proc").is_dir():
            partial.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Raise :class:`OutputError` unless a file can be put at ``path``, by trying it beside it."""
    partial = _partial(path, os.getpid())
    try:
        if path.is_dir():
            raise OutputError(f"cannot write '{path}': it is a directory")
        if not path.parent.is_dir():
            raise OutputError(f"cannot write '{path}': there is no directory '{path.parent}'")
        partial.touch()
        partial.unlink()
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {error.strerror or error}") from error


def plain(value: Any) -> Any:
    """``value`` in JSON's own types: one-element arrays are numbers, NaN and infinities null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "numpy"):  # Dr.Jit arrays
        value = value.numpy()
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        value = value.tolist()
        return plain(value[0] if isinstance(value, list) and len(value) == 1 else value)
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    return str(value)


def write_exr(
    film,
    path: Path,
    record: Mapping[str, Any],
    variance=None,
    layers: Mapping[str, Any] | None = None,
) -> None:
    """Write ``film`` with all its channels as OpenEXR.

    ``record`` (nested mappings) goes into the header twice: whole, as JSON, in the attribute
    ``aniso_pm``; and flat, one attribute ``aniso_pm.outer.inner`` for each number or text.

    ``variance`` (height × width × channels R, G, B, perhaps A), that of the picture, adds the
    layers ``variance`` and ``standard_error``, its root; ``layers`` (height × width × channels)
    others by name. All channels are float32 then: half precision has no room for a variance of
    1e-8, nor for positions.
    """
    import mitsuba as mi

    bitmap = film.bitmap()
    more = {name: layer for name, layer in (layers or {}).items() if layer.ndim == 3}
    if variance is not None:
        more |= {"variance": variance, "standard_error": variance**0.5}
    if more:
        bitmap = _with_layers(bitmap, more)
    # Only its text tells in which format the film wants to be stored. Pictures with AOVs stay
    # float32: Mitsuba's conversion renames such channels and then fails to find them.
    elif "component_format = float16" in str(film):
        if bitmap.pixel_format() != mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = bitmap.convert(component_format=mi.Struct.Type.Float16, srgb_gamma=False)

    record = plain(record)
    metadata = bitmap.metadata()
    metadata["aniso_pm"] = json.dumps(record, ensure_ascii=False, allow_nan=False)
    for key, value in _flatten("aniso_pm", record):
        metadata[key] = value
    with replacing(path) as partial:
        try:
            bitmap.write(str(partial))
        except RuntimeError as error:
            raise OutputError(f"cannot write '{path}': {error}") from error


def _with_layers(bitmap, layers: Mapping[str, Any]):
    """``bitmap`` with more channels, named ``layer.R`` and so on."""
    import mitsuba as mi
    import numpy as np

    from ..transport.layers import CHANNELS

    pixels = np.array(bitmap, dtype=np.float32)
    parts = [pixels.reshape(*pixels.shape[:2], -1)]
    names = [part.name for part in bitmap.struct_()]
    for layer, values in layers.items():
        with np.errstate(over="ignore"):  # squares of what is above 1e19
            parts.append(np.asarray(values, dtype=np.float32))
        count = values.shape[2]
        # Sums are R, G, B, whatever the film makes of them, unless it is a spectral one.
        own = [name for name in names if "." not in name][:count]
        letters = CHANNELS.get(layer, "RGBA")
        channels = letters[:count] if count <= len(letters) else "RGBA" if count == 4 else own
        names += [f"{layer}.{channel}" for channel in channels]
    pixels = np.concatenate(parts, axis=2)
    return mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, names)


def _flatten(prefix: str, value: Any) -> Iterator[tuple[str, str | int | float]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flatten(f"{prefix}.{key}", item)
    elif isinstance(value, bool):
        yield prefix, int(value)
    elif isinstance(value, int) and not -(2**31) <= value < 2**31:
        yield prefix, float(value)  # the header's integers have 32 bits
    elif isinstance(value, list):
        yield prefix, json.dumps(value, ensure_ascii=False)
    elif value is not None:
        yield prefix, value
