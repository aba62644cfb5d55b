"""A picture at one moment with all that is known beside it, and what a screen shows of it."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import InputError
from ..pictures.denoising import denoise
from ..pictures.display import displayed

PICTURE, DENOISED = "picture", "denoised"
# What one request computes the next may have.
_DENOISING = threading.Lock()


@dataclass(frozen=True)
class Snapshot:
    """Version number; linear sRGB, height × width × 3 or 4; layers by name (see ``layered``)."""

    version: int
    picture: np.ndarray
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Of what can be shown."""
        layers = [name for name, layer in self.layers.items() if layer.ndim == 3]
        can_denoise = "denoising_picture" in self.layers
        return [PICTURE, *([DENOISED] if can_denoise else []), *layers]

    @cached_property
    def _denoised(self) -> np.ndarray:
        return denoise(self.picture, self.layers)

    def png(self, name: str, exposure: float, tonemap: str) -> bytes:
        """One of ``names`` as a PNG. Raises InputError for others."""
        if name not in self.names:
            raise InputError(f"there is no layer '{name}'; there are {', '.join(self.names)}")
        if name == PICTURE:
            image = self.picture[..., :3]
        elif name == DENOISED:
            with _DENOISING:
                image = self._denoised
        else:
            image = self.layers[name]
        if name.endswith("normal"):
            shown = np.clip(0.5 * image + 0.5, 0, 1)
        elif image.shape[2] == 1 or name == "position":
            shown = _stretched(image)
        else:
            shown = displayed(image, exposure, tonemap)
        return _encoded(np.broadcast_to(shown, (*shown.shape[:2], 3)))


def _stretched(values: np.ndarray) -> np.ndarray:
    """Numbers of any range, channel by channel, from 0 to 1: all but the outermost 1 %."""
    low, high = np.percentile(values, (1, 99), axis=(0, 1))
    return np.clip((values - low) / np.maximum(high - low, 1e-30), 0, 1)


def _encoded(values: np.ndarray) -> bytes:
    bitmap = mi.Bitmap((255 * values + 0.5).astype(np.uint8))
    bitmap.set_srgb_gamma(True)
    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def status_of(statistics: Mapping[str, Any]) -> dict[str, Any]:
    """What a page tells of the statistics of a rendering."""
    stages = statistics.get("seconds", {})
    return {
        "passes": statistics.get("passes", 0),
        "spp": statistics.get("spp", 0),
        "relative_error": statistics.get("relative_error"),
        "radius": statistics.get("radius"),
        "map": statistics.get("map"),
        "photons": statistics.get("photons_stored"),
        "seconds": sum(spent for stage, spent in stages.items() if stage != "output"),
    }
