"""Camera paths up to their gather points: wavefronts of walks (see ``walk``), and the columns of
gather points that they leave."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .. import arrays
from ..map.gather_points import GatherPoints, map_tree, take
from ..map.index import curve_order
from .walk import Vertex, WalkOptions, first_lobe, walk


def trace(scene, sampler, ray, options: WalkOptions, expected: int = 0, launch=None):
    """Trace camera paths: (radiance, valid, GatherPoints or None).

    radiance  W/m²/sr: emission, direct light, and whatever the map does not stand for. NaN where
              the throughput at a gather point is not finite. survey_parts.Parts where use is
              "survey", layers.Seen where somebody asks for layers.
    valid     did the ray meet anything but null surfaces and, if they are hidden, emitters?
              (alpha, as in ``path``)
    expected  gather points to make room for; with too few the same paths are traced again.
    launch    ``eye_paths``, or that function frozen.
    """
    if not options.gathers:
        launch = launch or eye_paths
        L, valid, _, _ = launch(scene, sampler.clone(), ray, options, None, None, None)
        dr.eval(L, valid)
        return L, valid, None
    capacity = _room_at_first(options, dr.width(ray), expected)
    while True:
        rows, room = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, capacity)
        points = map_tree(lambda v: arrays.room(type(v), capacity), _blank(options))  # noqa: B023
        L, valid, rows, points = (launch or eye_paths)(
            scene, sampler.clone(), ray, options, rows, points, room
        )
        dr.eval(L, valid, rows, points)
        found = int(rows[0])
        if found <= capacity:
            break
        capacity = found + found // 16
    if not found:
        return L, valid, None
    # Neighbours will look up the same photons.
    position = dr.gather(mi.Point3f, points.p, dr.arange(mi.UInt32, found))
    return L, valid, take(points, curve_order(position))


def _room_at_first(options: WalkOptions, paths: int, expected: int) -> int:
    """Entries of the columns of gather points."""
    # Without mixed receivers a path ends where it leaves its first gather point.
    single = options.use == "global" and not options.general and options.glossy is None
    return paths if single else max(2 * paths, expected + expected // 8)


def eye_paths(scene, sampler, ray, options: WalkOptions, rows, points, room, see=None):
    """One wavefront of eye paths, gather points into their columns: (radiance, valid, rows used,
    columns). see: as for ``walk``."""

    def leave(vertex, active):
        slot = dr.scatter_inc(rows, mi.UInt32(0), active)
        active = active & (slot < room)

        def put(column, value):
            dr.scatter(column, value, slot, active)
            return column

        map_tree(put, points, _point(options, vertex))

    L, valid = walk(scene, sampler, ray, options, leave, see)
    return L, valid, rows, points


def _point(o: WalkOptions, v: Vertex) -> GatherPoints:
    """A gather point with the fields that the scene needs."""
    return GatherPoints(
        lane=v.lane,
        p=v.si.p,
        n=dr.mulsign(v.si.n, dr.dot(-v.ray.d, v.si.n)),
        weight=v.weight,
        depth=v.depth,
        path=v.path,
        origin=v.ray.o if o.general or o.glossy else None,
        d=v.ray.d if o.general or o.glossy else None,
        lambertian=v.lambertian if o.general or o.glossy else None,
        glossy=v.glossy if o.glossy else None,
        caustic=~v.scattered if o.use == "final_gather" else None,
        distance=v.distance if o.measure else None,
        later=v.scattered if o.use == "survey" or (o.light and o.use != "global") else None,
    )


def _blank(o: WalkOptions) -> GatherPoints:
    si, ray = dr.zeros(mi.SurfaceInteraction3f), dr.zeros(mi.Ray3f)
    no, zero = mi.Bool(False), mi.UInt32(0)
    lobe = first_lobe(o)
    return _point(o, Vertex(zero, si, ray, mi.Spectrum(0), zero, lobe, no, no, no, mi.Float(0)))
