"""What stands between lamps and what the camera sees, looked at before the first pass.

Emitters are drawn by the light w that they would give were nothing between (see ``direct_light``).
A sun outside of a closed room would take nearly all of the samples and give nothing. So a few
thousand short eye paths ask the groups of emitters, each as often, for the share v_k of these tests
that meets group k. Where p_k is the chance of group k, and V_k its visibility, a sample's second
moment is the mean of Σ V_k w_k²/p_k, least for p_k in proportion to w_k √v_k. v is one number for
the whole picture: shares for each cell of space make single samples better, but not their
sequences, which find shadows evenly anyway (docs/performance.md). Only chances follow from it, so
that light is right whatever is found.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import number
from .direct_light import DirectLight, lit_sides
from .rays import reach_of, spawn_ray

# Segments of the eye paths.
_SEGMENTS = 4


def look(scene, direct: DirectLight, sampler, rays) -> DirectLight:
    """The same emitters, with what is seen of them from where these camera rays lead.

    sampler: of as many lanes.
    """
    tests, seen = (a.numpy().astype(np.float64) for a in _tests(scene, direct, sampler, rays))
    # What was never asked may be seen.
    factors = np.sqrt(np.where(tests > 0, seen / np.maximum(tests, 1), 1))
    groups = [
        replace(group, power=group.power * number(mi.Float, float(factor)))
        for group, factor in zip(direct.groups, factors, strict=True)
    ]
    dr.eval([group.power for group in groups])
    return replace(direct, groups=groups)


@dr.syntax
def _tests(scene, direct: DirectLight, sampler, rays):
    """Of each group, how often it could have given light, and how often that arrives."""
    groups = len(direct.groups)
    tests, seen = dr.zeros(mi.UInt32, groups), dr.zeros(mi.UInt32, groups)
    context, reach = mi.BSDFContext(), dr.opaque(mi.Float, reach_of(scene))
    even = [mi.Float(1 / groups) for _ in direct.groups]
    ray, depth, active = mi.Ray3f(rays), mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="shadows"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf(ray)
        n, through = lit_sides(bsdf, si, ray)
        u = sampler.next_2d(active)
        asked, w = dr.minimum(mi.UInt32(u.x * groups), groups - 1), mi.Float(0)
        for k, group in enumerate(direct.groups):
            w = dr.select(asked == k, group.irradiance(si.p, n, through), w)
        test = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (w > 0)
        ds, light = direct.sample(si, even, u, test)
        free = test & (dr.max(light) > 0) & (through | (dr.dot(n, ds.d) > 0))
        free &= ~scene.ray_test(si.spawn_ray_to(ds.p), free)
        dr.scatter_add(tests, 1, asked, test, mode=dr.ReduceMode.Direct)
        dr.scatter_add(seen, 1, asked, free, mode=dr.ReduceMode.Direct)
        u = sampler.next_1d(active), sampler.next_2d(active)
        bs, weight = bsdf.sample(context, si, *u, active)
        ray = spawn_ray(si, si.to_world(bs.wo), reach)
        depth += 1
        active &= (depth < _SEGMENTS) & (dr.max(weight) > 0)
    return tests, seen
