"""Pictures side by side, with heat maps of their errors."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib import image as mpl_image

from . import metrics, regions
from .experiment import Measured
from .results import images

# The crop, as a share of the film in each direction, where the film is larger than this.
_CROP, _SMALL = 0.5, 80
# Relative errors that are black and brightest in the heat maps.
HEAT = 0.5


def panels(measured: Measured, k: int) -> list[dict[str, Any]]:
    """One entry for the reference and each method at budget ``k``: ``name``, ``title``, and the PNG
    files ``whole``, ``crop`` and (but for the reference) ``heat``, all with the first seed."""
    reference = measured.reference.mean
    weight = metrics.weights(measured.reference.halves)
    rows, columns = window(measured)
    exposure = 0.9 / max(np.percentile(reference.mean(-1), 98), 1e-9)
    found = [
        {
            "name": "reference",
            "title": f"reference ({measured.reference.record['integrator']})",
            "whole": _png(srgb(exposure * reference)),
            "crop": _png(srgb(exposure * reference[rows, columns])),
        }
    ]
    for method in measured.methods:
        pictures = images(measured, method.name, k) if method.name in measured.runs else None
        if pictures is None:
            continue
        image = pictures[0].astype(np.float64)
        error = np.sqrt((weight * (image - reference) ** 2).mean(-1))
        found.append(
            {
                "name": method.name,
                "title": method.label,
                "whole": _png(srgb(exposure * image)),
                "crop": _png(srgb(exposure * image[rows, columns])),
                "heat": _png(matplotlib.colormaps["inferno"](np.clip(error / HEAT, 0, 1))),
            }
        )
    return found


def window(measured: Measured) -> tuple[slice, slice]:
    """Rows and columns of the crop: where most pixels of the regions are."""
    width, height = measured.size
    if max(width, height) <= _SMALL:
        return slice(0, height), slice(0, width)
    w, h = round(width * _CROP), round(height * _CROP)
    interest = np.full((height, width), 1e-6)
    for name, mask in measured.masks.items():
        if name != regions.WHOLE:
            interest += mask
    sums = np.pad(interest.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    inside = sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]
    top, left = np.unravel_index(inside.argmax(), inside.shape)
    return slice(top, top + h), slice(left, left + w)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light → sRGB, clipped to 0…1."""
    linear = np.clip(linear, 0, 1)
    bright = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear < 0.0031308, 12.92 * linear, bright)


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    mpl_image.imsave(buffer, (np.asarray(image)[..., :3] * 255).round().astype(np.uint8))
    return buffer.getvalue()
