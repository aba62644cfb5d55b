"""What a screen shows of a picture: exposure, tone curve, PNG files of 8 or 16 bits.

srgb  values above 1 are clipped; the sRGB curve alone.
aces  the tone curve of ACES 2.0 for screens, a filmic one: highlights roll off and lose colour. By
      OpenColorIO (``pip install 'aniso-pm[tonemap]'``).
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .output import OutputError, plain, replacing

TONEMAPS = ("srgb", "aces")


def check_tonemap(name: str) -> None:
    """Raise InputError, in one line, unless the tone curve is there."""
    if name not in TONEMAPS:
        raise InputError(f"there is no tone curve '{name}'; there are {', '.join(TONEMAPS)}")
    if name == "aces":
        _aces()


def displayed(picture: np.ndarray, exposure: float = 0.0, tonemap: str = "srgb") -> np.ndarray:
    """The values from 0 to 1 that a screen gets, float32.

    picture   linear sRGB, height × width × 3, or with alpha as a fourth channel, which stays.
    exposure  stops: the picture times 2^exposure.
    tonemap   one of TONEMAPS. Raises InputError where it is not installed.
    """
    colour = np.nan_to_num(picture[..., :3].astype(np.float32) * np.float32(2.0**exposure))
    if tonemap == "aces":
        shown = np.ascontiguousarray(np.maximum(colour, 0))
        _aces().applyRGB(shown)
    else:
        check_tonemap(tonemap)
        shown = srgb(colour)
    alpha = picture[..., 3:4].astype(np.float32)
    return np.clip(np.concatenate([shown, alpha], axis=2), 0, 1)


def srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve [IEC 61966-2-1] of values clipped to 0 and 1."""
    v = np.clip(linear, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055).astype(np.float32)


@cache
def _aces() -> Any:
    try:
        import PyOpenColorIO
    except ImportError as error:
        raise InputError(
            "the tone curve 'aces' needs OpenColorIO, which is not installed: "
            "pip install 'aniso-pm[tonemap]'"
        ) from error
    config = PyOpenColorIO.Config.CreateFromFile("ocio://default")
    views = list(config.getViews("sRGB - Display"))
    transform = PyOpenColorIO.DisplayViewTransform(
        src="lin_rec709_scene", display="sRGB - Display", view=views[0]
    )
    return config.getProcessor(transform).getDefaultCPUProcessor()


def colours(film) -> np.ndarray | None:
    """Linear sRGB of the film's picture, height × width × 3, or 4 with alpha; None where it has no
    colours (spectral films)."""
    import mitsuba as mi

    found = next((bitmap for name, bitmap in film.bitmap().split() if name == "<root>"), None)
    Format = mi.Bitmap.PixelFormat
    if found is None or found.pixel_format() == Format.MultiChannel:
        return None
    has_alpha = found.pixel_format() in (Format.YA, Format.RGBA, Format.XYZA)
    kind = Format.RGBA if has_alpha else Format.RGB
    return np.array(found.convert(kind, mi.Struct.Type.Float32, srgb_gamma=False))


def write_png(
    picture: np.ndarray,
    path: Path,
    exposure: float = 0.0,
    tonemap: str = "srgb",
    bits: int = 8,
    record: Mapping[str, Any] | None = None,
) -> None:
    """Write linear sRGB (see :func:`displayed`) as a PNG of 8 or 16 bits a channel.

    record  what made it: the file's text ``aniso_pm``, as JSON.
    """
    import mitsuba as mi

    top, kind = {8: (255, np.uint8), 16: (65535, np.uint16)}[bits]
    shown = (displayed(picture, exposure, tonemap) * top + 0.5).astype(kind)
    bitmap = mi.Bitmap(shown)
    bitmap.set_srgb_gamma(True)
    record = plain(record or {}) | {"exposure": exposure, "tonemap": tonemap}
    text = json.dumps(record, ensure_ascii=True, allow_nan=False)
    with replacing(path) as partial:
        try:
            bitmap.write(str(partial))
        except RuntimeError as error:
            raise OutputError(f"cannot write '{path}': {error}") from error
        partial.write_bytes(_with_text(partial.read_bytes(), "aniso_pm", text))


def _with_text(png: bytes, keyword: str, text: str) -> bytes:
    """A PNG with one more text (ASCII) behind its first chunk, IHDR. (Mitsuba would put texts into
    quotation marks.)"""
    body = b"tEXt" + keyword.encode() + b"\0" + text.encode()
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    header = 8 + 8 + 13 + 4  # signature; length and type; data; checksum
    return png[:header] + chunk + png[header:]
