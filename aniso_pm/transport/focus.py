"""Light from outside begins above what the camera sees.

A sky or a sun lights the whole scene, of bounding sphere (c, R): its rays begin on the disc of
radius R across them. Where the camera sees a small part of the scene, a house on a wide plain,
hardly any would meet it. They are therefore spread over nested discs: the first covers the sphere
(c', ρR) around most of the points where eye paths read the photons, each next one is four times as
wide, and the last is the whole one. With chances a_k, centres q_k and radii ρ_k in units of R, a
point q of the disc has the density p(q) and light there the weight

    p(q) = Σ_k a_k [|q − q_k| <= ρ_k] / (π ρ_k²),    w(q) = 1 / (π p(q)),

which grows with the square of the distance from what is seen, as the chance falls that light from
there comes back: no rare photon is much brighter than those around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# The sphere has so many of the points within it, and so much to spare.
_MOST, _SPARE = 0.8, 1.25
# It pays where it is so much smaller than the scene.
_SMALL = 0.35
# Share of the light paths that begin above it; each next disc is so much wider.
_FIRST, _WIDER = 0.5, 4.0
_FEWEST = 64


@dataclass(frozen=True)
class Focus:
    """A sphere around what the camera sees of the photons, world units."""

    centre: tuple[float, float, float]
    radius: float


def find(points: np.ndarray, radius: float) -> Focus | None:
    """points: where eye paths gather, (n, 3); radius: of the scene. None where it does not pay."""
    if len(points) < _FEWEST:
        return None
    centre = np.median(points, axis=0)
    found = _SPARE * float(np.quantile(np.linalg.norm(points - centre, axis=1), _MOST))
    if not 0 < found < _SMALL * radius:
        return None
    # To a few digits: machines whose arithmetic differs in the last ones agree.
    unit = 10.0 ** (np.floor(np.log10(found)) - 2)
    x, y, z = (float(np.round(c / unit) * unit) for c in centre)
    return Focus((x, y, z), float(np.ceil(found / unit) * unit))


@dataclass(frozen=True)
class Discs:
    """The discs of a scene: centre (world units) and radius of the whole one, offset of the first
    sphere and radii of all but the whole one in units of that."""

    centre: Any
    radius: Any
    offset: Any
    radii: tuple[Any, ...]

    @staticmethod
    def of(focus: Focus, centre, radius) -> Discs:
        offset = (mi.Point3f(*focus.centre) - centre) / radius
        share = focus.radius / float(radius[0])
        radii = []
        while share < 1:
            radii.append(dr.opaque(mi.Float, share))
            share *= _WIDER
        dr.make_opaque(offset)
        return Discs(centre, radius, offset, tuple(radii))

    @property
    def chances(self) -> list[float]:
        return [_FIRST] + len(self.radii) * [(1 - _FIRST) / len(self.radii)]

    @property
    def weight(self) -> float:
        """Of light that begins above what is seen."""
        areas = [float(r[0]) ** 2 for r in self.radii] + [1.0]
        return 1 / sum(a / area for a, area in zip(self.chances, areas, strict=True))

    def sample(self, u, d):
        """(where rays along d begin on the disc across d, as an offset in units of its radius;
        weight). u: uniform in the square."""
        frame = mi.Frame3f(d)
        local = frame.to_local(self.offset)
        seen = mi.Point2f(local.x, local.y)
        discs = [(seen, r) for r in self.radii] + [(mi.Point2f(0), mi.Float(1))]
        first, rest = u.x < _FIRST, (u.x - _FIRST) / (1 - _FIRST) * len(self.radii)
        number = dr.minimum(mi.UInt32(dr.maximum(rest, 0)), len(self.radii) - 1) + 1
        number = dr.select(first, 0, number)
        within = dr.select(first, u.x / _FIRST, rest - mi.Float(number) + 1)
        q = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(within, u.y))
        at, radius = discs[0]
        for k, (c, r) in enumerate(discs[1:], 1):
            at, radius = dr.select(number == k, c, at), dr.select(number == k, r, radius)
        q = mi.Point2f(at + radius * q)
        density = mi.Float(0)
        for k, (chance, (c, r)) in enumerate(zip(self.chances, discs, strict=True)):
            # The own disc counts, however numbers are rounded.
            inside = (number == k) | (dr.norm(q - c) <= r)
            density += dr.select(inside, chance * dr.rcp(dr.square(r)), 0)
        return frame.to_world(mi.Vector3f(q.x, q.y, 0)), dr.select(density > 0, dr.rcp(density), 0)
