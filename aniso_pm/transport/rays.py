"""Rays that leave a surface, at any scale.

A ray starts a little above the surface that it leaves, or it would meet it again. Mitsuba's
``spawn_ray`` takes 1500 ulps of 1 + |p| (9e-5 of a world unit at least): in a room of two
millimetres, or in one of two metres that stands a kilometre from the origin, that is 4.5 % of the
room, and the light that arrives is off by 2 %. What rounding needs is far less: points and
intersections are off by a few ulps of the largest coordinate about.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_ULP = 2.0**-24
# Rays of a million that meet the sphere, disc, cylinder or mesh that they leave: 6e4 with 4 ulps,
# 10 (at a cylinder's open ends) with 16 and more.
_ULPS = 64
# Mitsuba's own distance of rays from the surface that they leave, relative to 1 + |p|.
MITSUBA_OFFSET = 1500 * _ULP


def reach_of(scene) -> float:
    """Largest |coordinate| of the scene's bounding box, world units: ``spawn_ray`` asks for it.

    Infinite without shapes, and where there are curves, so that rays leave surfaces as far off as
    Mitsuba's do: those that begin closer to a curve make its intersection routine (Mitsuba 3.9.1
    with Embree) return what ends the process.
    """
    box = scene.bbox()
    curves = int(mi.ShapeType.BSplineCurve) | int(mi.ShapeType.LinearCurve)
    if not box.valid() or scene.shape_types() & curves:
        return float("inf")
    return max(*map(abs, box.min), *map(abs, box.max))


def spawn_ray(si, d, reach):
    """The ray from the surface interaction ``si`` in the direction d (world), started 64 ulps of
    |p| + reach off the surface, and never further off than Mitsuba would.

    reach: ``reach_of`` of the scene, as a Dr.Jit array.
    """
    size = dr.max(dr.abs(si.p))
    offset = dr.minimum(MITSUBA_OFFSET * (1 + size), _ULPS * _ULP * (size + reach))
    offset = dr.mulsign(offset, dr.dot(si.n, d))
    return mi.Ray3f(dr.fma(offset, mi.Vector3f(si.n), si.p), d, si.time, si.wavelengths)
