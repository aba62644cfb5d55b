"""The stage of a pass that takes most of its time: kernels at gather points, what they hold, and
what edges take of it.

One function of arrays and of decisions, so that it can be frozen: traced in Python once and then
replayed, whatever the numbers of photons and of gather points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map import density, walls
from ..map.gather_points import GatherPoints, map_tree
from ..map.receivers import read_cover
from ..transport.gathered_layers import split
from ..transport.uses import Use
from .footprint import TRIED, Footprint

# Kernels of glossy caustics, as a share of those of their pixel, which are right for what the metal
# mirrors and are too wide here (docs/performance.md).
_GLOSSY = 0.7


@dataclass(frozen=True)
class GatherOptions:
    """Decisions for one scene; what is off is not traced.

    kernel      how gather points get their kernels.
    max_depth   the limit that photons are tested against, see ``density.estimate``.
    compensate  what kernels spill over edges.
    receiving   addresses of the BSDFs that gather; None where all do and none lets light pass.
    roughness   smallest alpha that is gathered on; None where all points are on Lambertian
                receivers.
    glossy      gather points are there for glossy caustics.
    tolerance   of sums, see ``density.estimate``.
    use         of the map, and ``unseen``, is there light that only photons find: for layers.
    light       split it by how it came; radius: keep bandwidths.
    """

    kernel: density.KernelOptions
    max_depth: int
    compensate: bool
    receiving: tuple[int, ...] | None
    roughness: float | None
    glossy: bool
    tolerance: float
    use: Use
    unseen: bool
    light: bool = False
    radius: bool = False

    @property
    def cover(self) -> Callable | None:
        """A function as ``receivers.read_cover``, or None."""
        if self.receiving is None:
            return None
        return partial(read_cover, receivers=self.receiving)


def gather(
    scene,
    map_,
    radius,
    seed,
    points: GatherPoints,
    footprint: Footprint | None,
    wavelengths,
    scores,
    options: GatherOptions,
) -> density.Gathered:
    """Reflected radiance at gather points, all of one kind, not yet evaluated.

    map_         PhotonMap, its numbers as arrays (``PhotonMap.numbered``).
    radius       bandwidth of the pass, world units; seed: of random numbers. Both Dr.Jit arrays.
    wavelengths  nm, of the eye paths, in spectral variants.
    scores       see ``density.estimate``.
    """
    o = options
    surface = None
    if o.roughness is not None:
        surface = density.Surface.at(scene, points, o.roughness, o.glossy, wavelengths)
    thick = thickness(points, radius, footprint)
    radius = bandwidth(points, radius, footprint)
    kernel, follows, degenerate = density.kernels(points, radius, o.kernel)
    points = walled(scene, points, kernel, thick, seed, o)
    given = map_, points, kernel, thick, o.max_depth
    L, count = density.estimate(*given, mi.Bool(True), surface, o.tolerance, scores)
    light: Any = None
    if o.light:
        light = split(L, o.use, o.unseen, *given, surface, o.tolerance)
    lost = mi.Bool(False)
    if o.compensate:
        inverse, lost = density.probe_surface(
            scene, seed, points, kernel, thick, count > 0, o.cover
        )
        L *= inverse
        light = map_tree(lambda part: part * inverse, light)
    clamped, capped = follows & kernel.clamped, follows & kernel.capped
    found = density.Gathered(points.lane, L, count, follows, clamped, capped, degenerate, lost)
    return replace(found, light=light, radius=mi.Float(radius) if o.radius else None)


def bandwidth(points: GatherPoints, radius, footprint: Footprint | None):
    """Of each gather point, world units. radius: of the pass."""
    if footprint is None:
        return radius
    radius = radius * footprint.share(points.distance, points.lane)
    return radius if points.glossy is None else radius * dr.select(points.glossy, _GLOSSY, 1)


def thickness(points: GatherPoints, radius, footprint: Footprint | None):
    """Bandwidth by which photons are on the same surface (``density.SLAB``): that of kernels as
    wide as pilots try them, where they are wider. Farther off lies who knows what."""
    if footprint is None:
        return radius
    return radius * footprint.share(points.distance, points.lane, TRIED)


def walled(scene, points: GatherPoints, kernel, thickness, seed, options: GatherOptions):
    """The same points with the walls beside them, where edges are compensated."""
    if not options.compensate:
        return points
    cover = options.cover
    wall = walls.nearest(
        scene,
        seed,
        points,
        kernel,
        math.sqrt(density.CUT2),
        0.5 * density.SLAB * thickness,
        (lambda bsdf, active: cover(bsdf, active)[1]) if cover else None,
    )
    return replace(points, wall=wall)
