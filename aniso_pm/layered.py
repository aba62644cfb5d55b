"""Sums of layers over the samples of a film, and the layers that they make.

One array holds all: height × width × channels in double precision. The channels of light and of
surfaces and, for the radius, its sum over gather points and their number are weighted by the film's
reconstruction filter, the weight comes last of these, and then the plain number of samples of each
pixel. Arrays of passes add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import film as films
from .layers import CHANNELS, LIGHT, SURFACE


@dataclass(frozen=True)
class Layered:
    """The layers ``names`` of a film."""

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
        """Of the array, filter weight and number of samples included."""
        return len(_splatted(self.names)) + 2

    def wavefront(
        self, position, seen, gathered, ray, ray_weight, lanes, finite, spp
    ) -> np.ndarray:
        """The array of one wavefront.

        seen      layers.Seen of its eye paths; gathered: density.Gathered of their gather points.
        finite    of each path: samples whose radiance is not count as black.
        spp       samples of a pixel that lie next to each other, in the mean.
        """
        values = []
        for name in self.names:
            if name in LIGHT:
                light = dr.select(finite, getattr(seen.light, name), 0) * ray_weight
                values += _rgb(light, ray.wavelengths)
            elif name == "albedo":
                values += _rgb(dr.select(finite, seen.surface.albedo, 0), ray.wavelengths)
            elif name in SURFACE:
                value = getattr(seen.surface, name)
                values += [value] if name == "depth" else [value.x, value.y, value.z]
            elif name == "radius":
                values += _over_points(gathered, lanes.count)
        splatted = films.splat_channels(self.film, position, values, spp, lanes.weight)
        return np.concatenate([splatted, self._samples(lanes)], axis=2)

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


def _splatted(names: Sequence[str]) -> list[str]:
    """Names of the weighted channels before the weight, ``layer.channel``."""
    found = []
    for name in names:
        if name == "radius":
            found += ["radius.sum", "radius.count"]
        elif name in (*LIGHT, *SURFACE):
            found += [f"{name}.{channel}" for channel in CHANNELS[name]]
    return found


def develop(names: Sequence[str], array: np.ndarray) -> dict[str, np.ndarray]:
    """The layers ``names`` out of an array of sums: float32, height × width × channels of the
    layer; 0 where no sample was taken."""
    splatted = _splatted(names)
    weight, samples = array[..., -2:-1], array[..., -1:]
    layers = {}
    for name in names:
        if name == "samples":
            layers[name] = samples.astype(np.float32)
            continue
        if name == "standard_error":
            continue
        where = [k for k, channel in enumerate(splatted) if channel.startswith(f"{name}.")]
        total, norm = array[..., where], weight
        if name == "radius":
            total, norm = total[..., :1], total[..., 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            layers[name] = np.where(norm != 0, total / norm, 0).astype(np.float32)
    return layers


def _rgb(spectrum, wavelengths) -> list[Any]:
    rgb = films.to_rgb(spectrum, wavelengths)
    return [rgb.x, rgb.y, rgb.z]


def _over_points(gathered, count: int) -> list[Any]:
    """(sum of radii, number of gather points) of each eye path."""
    total, points = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
    for found in gathered:
        dr.scatter_add(total, found.radius, found.lane)
        dr.scatter_add(points, mi.Float(1), found.lane)
    dr.eval(total, points)
    return [total, points]
