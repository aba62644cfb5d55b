"""Denoising by Open Image Denoise, which a rendering's own noise estimate keeps in bounds.

Albedo and normal tell the filter edges and textures from noise. Where the standard error σ of a
pixel is known, filtered and rendered picture are blended: with the squared difference d² of both,
means over a small window,

    denoised = R + w (F − R),    w = σ² / max(σ², d²).

Where F differs from R by what noise explains (d² = σ²) the filter has its way; where it differs by
more, it has changed something that was no noise, and its squared bias d² − σ² counts against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import InputError

AUXILIARY = ("albedo", "normal")
# Pixels to each side over which squared differences and variances are averaged.
_WINDOW = 2


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
    layers   what is known beside it, of its size: ``albedo``, ``normal`` (3 channels each) and
             ``standard_error``, each as the integrator's attribute ``layers`` has them; others are
             ignored. The better, the more there are.
    blend    keep the rendered picture where it is better than the filtered one, as far as
             ``standard_error`` tells.

    Raises InputError where ``mitsuba-oidn`` is not installed, ValueError for sizes that differ.
    """
    oidn = check_installed()
    colour = _image("picture", picture)
    known = {
        name: _image(name, layers[name], colour.shape)
        for name in (*AUXILIARY, "standard_error")
        if layers and name in layers
    }
    auxiliary = {name: known[name] for name in AUXILIARY if name in known}
    if "albedo" in auxiliary:
        auxiliary["albedo"] = np.clip(auxiliary["albedo"], 0, 1)
    filtered = np.array(oidn.denoise(colour, hdr=True, **auxiliary))
    if not blend or "standard_error" not in known:
        return filtered
    return _blended(colour, filtered, known["standard_error"])


def about(layers: Mapping[str, Any], blend: bool = True) -> dict[str, Any]:
    """What :func:`denoise` does with these layers, for a picture's metadata."""
    oidn = check_installed()
    return {
        "filter": f"Open Image Denoise {oidn.oidn_version()}",
        "auxiliary": [name for name in AUXILIARY if name in layers],
        "blended_by": "standard_error" if blend and "standard_error" in layers else None,
    }


def _image(name: str, values: Any, shape=None) -> np.ndarray:
    image = np.asarray(values, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] < 3 or (shape and image.shape[:2] != shape[:2]):
        wanted = " × ".join(map(str, shape)) if shape else "height × width × 3"
        raise ValueError(f'aniso_pm: "{name}" has the shape {image.shape}; it must be {wanted}')
    return np.ascontiguousarray(np.nan_to_num(image[..., :3]))


def _blended(rendered, filtered, error) -> np.ndarray:
    variance = _mean_around((error.astype(np.float64) ** 2).mean(2))
    apart = _mean_around(((filtered - rendered).astype(np.float64) ** 2).mean(2))
    weight = np.divide(
        variance, np.maximum(variance, apart), where=apart > 0, out=np.ones_like(apart)
    )
    return (rendered + weight[..., None] * (filtered - rendered)).astype(np.float32)


def _mean_around(values: np.ndarray) -> np.ndarray:
    """Mean over a window around each pixel, smaller at the border."""
    height, width = values.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = values.cumsum(0).cumsum(1)
    y, x = np.arange(height), np.arange(width)
    top, bottom = np.maximum(y - _WINDOW, 0), np.minimum(y + _WINDOW + 1, height)
    left, right = np.maximum(x - _WINDOW, 0), np.minimum(x + _WINDOW + 1, width)
    box = sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    return box / ((bottom - top)[:, None] * (right - left))
