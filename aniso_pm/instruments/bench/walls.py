"""Test data of the gather: photons and elliptical queries on five walls of the unit box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.map.index import Ellipses

WALLS = 5
# Photons that a kernel holds in the mean of the open wall.
PER_QUERY = 50
# a² + b² at which kernels are cut, as in ``density``.
CUT2 = 4.0
# Uneven: this share of the photons lies in a square of this area (1 % of all) in the
# middle of the first wall.
CROWD, CROWD_AREA = 0.99, 0.01 * WALLS
# Extent along the normal in bandwidths, as in ``density``.
_SLAB = 0.5


@dataclass(frozen=True)
class Places:
    """Points on walls: position and unit normal, float32 arrays (N, 3), and is each in the crowd's
    square?"""

    position: np.ndarray
    normal: np.ndarray
    crowded: np.ndarray

    def points(self):
        return mi.Point3f(np.ascontiguousarray(self.position.T))

    def some(self, count: int) -> Places:
        """The first of them."""
        return Places(self.position[:count], self.normal[:count], self.crowded[:count])


def even(rng, count: int) -> Places:
    """Uniform on all walls."""
    return _on_walls(rng.random((count, 2)), rng.integers(0, WALLS, count))


def uneven(rng, count: int, share: float, margin: float = 0.0) -> Places:
    """That share of the points in the crowd's square, the others uniform, at least ``margin``
    outside it."""
    uv, wall = rng.random((count, 2)), rng.integers(0, WALLS, count)
    crowded = rng.random(count) < share
    while (stray := ~crowded & (wall == 0) & _in_square(uv, margin)).any():
        uv[stray], wall[stray] = rng.random((stray.sum(), 2)), rng.integers(0, WALLS, stray.sum())
    uv[crowded] = 0.5 + CROWD_AREA**0.5 * (uv[crowded] - 0.5)
    wall[crowded] = 0
    return _on_walls(uv, wall)


def _in_square(uv, margin: float = 0.0):
    """In the middle of a wall; or that near to it."""
    return (np.abs(uv - 0.5) < CROWD_AREA**0.5 / 2 + margin).all(1)


def _on_walls(uv, wall) -> Places:
    axis, side = np.array([0, 0, 1, 1, 2])[wall], np.array([0, 1, 0, 1, 0])[wall]
    position = np.empty((len(wall), 3), np.float32)
    normal = np.zeros((len(wall), 3), np.float32)
    for k in range(3):
        here = axis == k
        others = [i for i in range(3) if i != k]
        position[np.ix_(here, others)] = uv[here]
        position[here, k] = side[here]
        normal[here, k] = 1 - 2 * side[here]
    return Places(position, normal, (wall == 0) & _in_square(uv))


def even_radius(photons: int) -> float:
    """Radius of the disc that holds PER_QUERY photons of ``even``: where discs are cut."""
    return _radius(photons / WALLS)


def uneven_radii(photons: int) -> tuple[float, float]:
    """The same of ``uneven``: in the crowd's square, outside it."""
    inside = CROWD * photons / CROWD_AREA
    outside = (1 - CROWD) * photons / (WALLS - CROWD_AREA)
    return _radius(inside), _radius(outside)


def _radius(density: float) -> float:
    return float(np.sqrt(PER_QUERY / (np.pi * density)))


def ellipses(rng, places: Places, cut_radius, aspect: float) -> Ellipses:
    """Ellipses of the cut disc's area and random orientation in the wall, one a place.

    cut_radius  of the disc, world units, a number or one a place. aspect: ratio of the axes.
    """
    radius = mi.Float(np.broadcast_to(cut_radius, len(places.position)).astype(np.float32))
    radius /= CUT2**0.5
    normal = mi.Vector3f(np.ascontiguousarray(places.normal.T))
    frame = mi.Frame3f(normal)
    sin, cos = dr.sincos(mi.Float((2 * np.pi * rng.random(len(places.position))).astype("f4")))
    s = (frame.s * cos + frame.t * sin) * (radius * aspect**0.5)
    t = (frame.t * cos - frame.s * sin) * (radius / aspect**0.5)
    e = Ellipses.from_axes(places.points(), s, t, normal, radius * _SLAB)
    dr.eval(e.center, e.a, e.b, e.c)
    return e


def visitor(flux):
    """What the benchmark folds over photons: (sum of flux · exp(−ρ²), number of photons).

    flux: Float, 4 a photon. Returns (visit, total to start from)."""

    def visit(total: Any, slot, word, d, rho2, inside):
        power, count = total
        packed = dr.gather(mi.Vector4f, flux, slot, inside)
        weight = dr.select(inside, dr.exp(-rho2), 0)
        # Not +=: that would change the zero that the next sum starts from.
        power = power + mi.Color3f(packed.x, packed.y, packed.z) * weight
        return power, count + dr.select(inside, mi.UInt32(1), 0)

    return visit, (mi.Color3f(0), mi.UInt32(0))
