"""Walls that stand on a surface beside a gather point: photons behind them are of another room.

A kernel reaches through a wall, and next to a dark room may be a bright one. Short rays along the
surface, a little above it, look for the nearest wall, and the kernel ends at its plane. The share
of the kernel that lies on the surface (``density``) is then that of its part on this side, so that
an estimate beside a wall, or beside any solid that stands on the surface, loses nothing. Sums over
nodes of the index (``summed``) are taken by the side on which their centroid lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..arrays import number
from ..kernel import PlaneKernel
from .photon_word import NORMAL_COS

# Rays along the surface: every wall nearer than half of what the kernel reaches is met.
RAYS = 3


@dataclass
class Wall:
    """n·d = c, the plane in which a wall stands, for offsets d from the gather point: n points away
    from it, c >= 0. Where there is none, n = 0."""

    n: Any
    c: Any

    def hides(self, d):
        """Is the offset d beyond it?"""
        return dr.dot(self.n, d) > self.c


@dr.syntax
def nearest(scene, seed, points, kernel: PlaneKernel, reach: float, lift, passes=None):
    """Wall of each gather point.

    reach   of the kernel in units of its half axes; lift: height of the rays above the surface,
            world units: lower walls are none.
    passes  a function of (mi.BSDFPtr, active): does light pass? None where none does.
    """
    n = mi.Vector3f(points.n)
    state, sequence = mi.sample_tea_32(points.lane, points.depth + number(mi.UInt32, seed))
    random = mi.PCG32(1, mi.UInt64(sequence), mi.UInt64(state))
    first = random.next_float32()
    found, c, farthest = mi.Vector3f(0), mi.Float(0), mi.Float(1)
    k = mi.UInt32(0)
    while k < RAYS:
        sin_phi, cos_phi = dr.sincos(dr.two_pi * (first + mi.Float(k) / RAYS))
        along = reach * (kernel.s * cos_phi + kernel.t * sin_phi)
        length = dr.norm(along)
        ray = mi.Ray3f(points.p + n * lift, along / length)
        ray.maxt = length * farthest
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, True)
        met = si.is_valid() & (dr.abs(dr.dot(si.n, n)) < NORMAL_COS)
        if dr.hint(passes is not None, mode="scalar"):
            met &= ~passes(si.bsdf(), met)
        away = dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, ray.d))
        found = dr.select(met, away, found)
        c = dr.select(met, dr.maximum(dr.dot(away, si.p - points.p), 0), c)
        farthest = dr.select(met, si.t / length, farthest)
        k += 1
    return Wall(found, c)
