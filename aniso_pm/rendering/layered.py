"""Sums of layers over the samples of a film, and the layers that they make.

Two arrays, height × width × channels in double precision, which add up over wavefronts and passes:

layers     channels of light and of surfaces and, for the radius, its sum over gather points and
           their number, weighted by the film's reconstruction filter; the weight; and the plain
           number of samples of each pixel.
denoising  colour, albedo and normal weighted by a box filter, and the weight W; then for the colour
           A of whole passes Σ A², Σ A W and Σ W² (see ``accumulate``). Other filters spread the
           noise of a sample over several pixels, which denoisers take for texture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.layers import CHANNELS, LIGHT, SURFACE
from . import film as films
from . import splat
from .accumulate import mean_and_variance

_SEEN = 9  # channels of colour, albedo, normal
# Passes from which on their spread tells pixel by pixel how far to trust the picture.
_PASSES = 8


@dataclass(frozen=True)
class Layered:
    """The layers ``names`` of a film, ``standard_error`` left out."""

    film: Any
    names: tuple[str, ...]

    @staticmethod
    def of(film, names: Sequence[str]) -> Layered | None:
        """None where there is nothing to sum. Raises ValueError for films that have no layers."""
        kept = tuple(name for name in names if name != "standard_error")
        if kept and mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise ValueError(
                f'aniso_pm: parameter "layers" is "{",".join(names)}", but a {film.class_name()} '
                "has no room for layers; take an hdrfilm, or remove the parameter"
            )
        return Layered(film, kept) if kept else None

    @property
    def channels(self) -> int:
        """Of both arrays."""
        return len(_splatted(self.names)) + 2 + 2 * _SEEN * ("denoising" in self.names)

    def wavefront(
        self, position, L, seen, gathered, ray, ray_weight, lanes, finite
    ) -> dict[str, np.ndarray]:
        """The arrays of one wavefront.

        L         radiance of its eye paths as it goes into the film.
        seen      layers.Seen of its eye paths; gathered: density.Gathered of their gather points.
        finite    of each path: samples whose radiance is not count as black.
        """

        def values(name) -> list[Any]:
            if name in LIGHT:
                light = dr.select(finite, getattr(seen.light, name), 0) * ray_weight
                return _rgb(light, ray.wavelengths)
            if name == "albedo":
                albedo = dr.select(finite, seen.surface.albedo, 0)
                if mi.is_spectral:  # a value over the density of its wavelengths, as radiance is
                    albedo *= ray_weight
                return _rgb(albedo, ray.wavelengths)
            if name == "radius":
                return _over_points(gathered, lanes.count)
            value = getattr(seen.surface, name)
            return [value] if name == "depth" else [value.x, value.y, value.z]

        found = {}
        if any(name != "denoising" for name in self.names):
            channels = [v for name in _weighted(self.names) for v in values(name)]
            splatted = _array(splat.image(self.film, lanes, position, [*channels, mi.Float(1)]))
            found["layers"] = np.concatenate([splatted, self._samples(lanes)], axis=2)
        if "denoising" in self.names:
            channels = [*_rgb(L, ray.wavelengths), *values("albedo"), *values("normal")]
            found["denoising"] = _array(
                splat.image(self.film, lanes, position, [*channels, mi.Float(1)], box=True)
            )
        return found

    def _samples(self, lanes) -> np.ndarray:
        """Samples of each pixel of the crop window."""
        width, height = self.film.crop_size()
        wide, _ = films.sampled_size(self.film)
        border = films.border(self.film)
        row = lanes.pixel // wide
        x, y = mi.Int32(lanes.pixel - row * wide) - border, mi.Int32(row) - border
        inside = (x >= 0) & (y >= 0) & (x < int(width)) & (y < int(height))
        count = dr.zeros(mi.UInt32, int(width) * int(height))
        dr.scatter_add(count, mi.UInt32(1), mi.UInt32(y * int(width) + x), inside)
        return count.numpy().reshape(int(height), int(width), 1).astype(np.float64)


def _array(tensor) -> np.ndarray:
    return tensor.numpy().astype(np.float64)


def whole_pass(sums: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a pass out of the sums over its wavefronts."""
    found = dict(sums)
    if "denoising" in found:
        A, W = found["denoising"][..., :3], found["denoising"][..., _SEEN:]
        found["denoising"] = np.concatenate([found["denoising"], A**2, A * W, W**2], axis=2)
    return found


def plus(a: Mapping[str, np.ndarray] | None, b: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The sums of both; ``a`` may be None."""
    return {name: array if a is None else a[name] + array for name, array in b.items()}


def develop(
    names: Sequence[str], sums: Mapping[str, np.ndarray], passes: int, weights: Sequence[float]
) -> dict[str, np.ndarray]:
    """The layers ``names`` out of sums: float32, height × width × channels of the layer; 0 where
    no sample was taken.

    passes   whole ones.
    weights  of the film's filter over whole pixels (``film.pixel_weights``).

    ``denoising`` is four layers, ``denoising_picture``, ``_albedo``, ``_normal`` and, after eight
    passes, ``_error``, and the array ``denoising_filter``, the weights.
    """
    layers: dict[str, np.ndarray] = {}
    if "layers" in sums:
        array, splatted = sums["layers"], _splatted(names)
        for name in _weighted(names):
            where = [k for k, channel in enumerate(splatted) if channel.startswith(f"{name}.")]
            total, norm = array[..., where], array[..., -2:-1]
            if name == "radius":
                total, norm = total[..., :1], total[..., 1:]
            layers[name] = _ratio(total, norm)
        if "samples" in names:
            layers["samples"] = array[..., -1:].astype(np.float32)
    if "denoising" in sums:
        array = sums["denoising"]
        seen = _ratio(array[..., :_SEEN], array[..., _SEEN : _SEEN + 1])
        for k, name in enumerate(("picture", "albedo", "normal")):
            layers[f"denoising_{name}"] = seen[..., 3 * k : 3 * k + 3]
        if passes >= _PASSES:
            W, W2 = array[..., _SEEN : _SEEN + 1], array[..., -1:]
            of_weight = array[..., _SEEN + 1 : _SEEN + 4], array[..., _SEEN + 4 : _SEEN + 7]
            as_sums = {
                "first": np.concatenate([array[..., :3], W], 2),
                "square": np.concatenate([of_weight[0], W2], 2),
                "cross": np.concatenate([of_weight[1], W2], 2),
            }
            variance = mean_and_variance(as_sums, passes)[1]
            layers["denoising_error"] = np.sqrt(variance).astype(np.float32)
        layers["denoising_filter"] = np.asarray(weights, np.float32)
    return layers


def _ratio(total: np.ndarray, norm: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(norm != 0, total / norm, 0).astype(np.float32)


def _weighted(names: Sequence[str]) -> list[str]:
    return [name for name in names if name in (*LIGHT, *SURFACE, "radius")]


def _splatted(names: Sequence[str]) -> list[str]:
    """Names of the weighted channels before the weight, ``layer.channel``."""
    found = []
    for name in _weighted(names):
        channels = ("sum", "count") if name == "radius" else CHANNELS[name]
        found += [f"{name}.{channel}" for channel in channels]
    return found


def _rgb(spectrum, wavelengths) -> list[Any]:
    rgb = films.to_rgb(spectrum, wavelengths)
    return [rgb.x, rgb.y, rgb.z]


def _over_points(gathered, count: int) -> list[Any]:
    """(sum of radii, number of gather points) of each eye path."""
    total, points = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
    for found in gathered:
        dr.scatter_add(total, found.radius, found.lane)
        dr.scatter_add(points, mi.Float(1), found.lane)
    # Now: what is scattered may be lost if a block asks for it inside of its own loop.
    dr.eval(total, points)
    return [total, points]
