"""Denoising by Open Image Denoise, which a rendering's own noise estimate keeps in bounds.

The filter takes for texture what neighbouring pixels share. A reconstruction filter wider than a
pixel spreads the noise of each sample over several of them, and then next to nothing is removed.
Therefore pictures are denoised as a box filter gives them (the layers ``denoising_*``), and the
film's filter is applied to the result, by its weights over whole pixels.

Albedo and normal tell edges and textures from noise. Where the standard error σ of a pixel is
known, filtered picture F and rendered picture R are blended: with the squared difference d² of
both, means over a window,

    denoised = R + w (F − R),    w = σ² / max(σ², d²).

Where F differs from R by what noise explains (d² = σ²) the filter has its way; where it differs by
more, it has changed something that was no noise, and its squared bias d² − σ² counts against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import InputError

# Pixels to each side over which squared differences and variances are averaged.
_WINDOW = 4
_PREFIX = "denoising_"


def check_installed() -> Any:
    """The module ``mitsuba_oidn``. Raises InputError, in one line, where it is not installed."""
    try:
        import mitsuba_oidn
    except ImportError as error:
        raise InputError(
            "denoising needs mitsuba-oidn, which is not installed: pip install 'aniso-pm[denoise]'"
        ) from error
    return mitsuba_oidn


def denoise(
    picture: Any, layers: Mapping[str, Any] | None = None, blend: bool = True
) -> np.ndarray:
    """A denoised picture: float32, height × width × 3.

    picture  radiance, linear, height × width × 3 channels or more, of which the first three count.
    layers   what is known beside it, of its size, as the integrator's attribute ``layers`` has it.
             With the layer ``denoising`` everything comes from there. Without it ``albedo``,
             ``normal`` and ``standard_error`` are used as far as they are there, and the picture
             should have been rendered with a box filter. Other layers are ignored.
    blend    keep the rendered picture where it is better than the filtered one, as far as its
             standard error tells.

    Raises InputError where ``mitsuba-oidn`` is not installed, ValueError for sizes that differ.
    """
    oidn = check_installed()
    known = _inputs(picture, layers or {})
    shape = np.shape(picture)
    images = {name: _image(name, value, shape) for name, value in known.items() if name != "filter"}
    colour, error = images.pop("picture"), images.pop("error", None)
    if "albedo" in images:
        images["albedo"] = np.clip(images["albedo"], 0, 1)
    found = np.array(oidn.denoise(colour, hdr=True, **images))
    if blend and error is not None:
        found = _blended(colour, found, error)
    return filtered_by(found, known.get("filter", [1.0]))


def about(layers: Mapping[str, Any], blend: bool = True) -> dict[str, Any]:
    """What :func:`denoise` does with these layers, for a picture's metadata."""
    oidn = check_installed()
    known = _inputs(None, layers)
    return {
        "filter": f"Open Image Denoise {oidn.oidn_version()}",
        "auxiliary": [name for name in ("albedo", "normal") if name in known],
        "without_pixel_filter": "filter" in known,
        "blended_by": "standard error" if blend and "error" in known else None,
    }


def _inputs(picture: Any, layers: Mapping[str, Any]) -> dict[str, Any]:
    """picture, albedo, normal, error and filter, as far as they are known."""
    if _PREFIX + "picture" in layers:
        return {
            name.removeprefix(_PREFIX): layer
            for name, layer in layers.items()
            if name.startswith(_PREFIX)
        }
    names = {"albedo": "albedo", "normal": "normal", "standard_error": "error"}
    return {"picture": picture} | {names[n]: layers[n] for n in names if n in layers}


def _image(name: str, values: Any, shape) -> np.ndarray:
    image = np.asarray(values, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] < 3 or image.shape[:2] != shape[:2]:
        size = " × ".join(str(n) for n in shape[:2]) if len(shape) == 3 else "height × width"
        raise ValueError(f'aniso_pm: "{name}" has the shape {image.shape}; it must be {size} × 3')
    return np.ascontiguousarray(np.nan_to_num(image[..., :3]))


def _blended(rendered, filtered, error) -> np.ndarray:
    variance = _mean_around((error.astype(np.float64) ** 2).mean(2))
    apart = _mean_around(((filtered - rendered).astype(np.float64) ** 2).mean(2))
    weight = np.ones_like(apart)
    np.divide(variance, apart, out=weight, where=apart > variance)
    return (rendered + weight[..., None] * (filtered - rendered)).astype(np.float32)


def _mean_around(values: np.ndarray) -> np.ndarray:
    """Mean over a window around each pixel, smaller at the border."""
    for axis in (0, 1):
        size = values.shape[axis]
        zero = np.zeros_like(np.take(values, [0], axis))
        sums = np.concatenate([zero, values.cumsum(axis)], axis)
        place = np.arange(size)
        low, high = np.maximum(place - _WINDOW, 0), np.minimum(place + _WINDOW + 1, size)
        count = (high - low).reshape((-1, 1) if axis == 0 else (1, -1))
        values = (np.take(sums, high, axis) - np.take(sums, low, axis)) / count
    return values


def filtered_by(image: np.ndarray, weights) -> np.ndarray:
    """``image`` (height × width × channels) with a separable filter, given by its weights over
    whole pixels (``film.pixel_weights``)."""
    reach = len(weights) // 2
    for axis in (0, 1):
        width = [(0, 0)] * 3
        width[axis] = (reach, reach)
        padded = np.pad(image, width, mode="edge")
        size = image.shape[axis]
        parts = (w * np.take(padded, range(k, k + size), axis) for k, w in enumerate(weights))
        image = sum(parts, start=np.zeros_like(image))
    return image.astype(np.float32)
