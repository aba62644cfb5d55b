"""Light from the photon map by how it came, at gather points (see ``layers``).

A photon's word says whether it came over walked parts alone, and how many segments its path has:
one where only photons see the emitter, so that its light is direct. Parts are sums over fewer
photons with the kernel of the whole, so that they share every error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map import density
from ..map.gather_points import GatherPoints
from .layers import Light
from .uses import Use


def split(
    L,
    use: Use,
    unseen: bool,
    photons,
    points: GatherPoints,
    kernel,
    thickness,
    max_depth: int,
    surface,
    tolerance: float,
) -> Light:
    """``L``, which ``density.estimate`` has found with the other arguments, in parts.

    use     of the map, see ``uses``.
    unseen  does the map hold light that came straight from an emitter?
    """
    later: Any = mi.Bool(False) if points.later is None else points.later

    def part(some, depth):
        estimate = density.estimate
        return estimate(photons, some, kernel, thickness, depth, ~later, surface, tolerance)[0]

    # What paths read that have left a gathered part before is indirect, whatever photons it was.
    over_walked = L
    if use == "global":
        over_walked = part(replace(points, caustic=mi.Bool(True)), max_depth)
    direct = mi.Spectrum(0)
    if unseen:
        direct = part(replace(points, depth=mi.UInt32(0)), 1)
    over_walked, direct = (dr.select(later, 0, x) for x in (over_walked, direct))
    if points.glossy is not None:  # has met no gathered part
        over_walked, direct = (dr.select(points.glossy, L, x) for x in (over_walked, direct))
    return Light(direct, over_walked - direct, L - over_walked)
