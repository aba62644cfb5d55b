"""Lobe + kernel + index → radiance estimate at the gather points   [paper step 4].

With M light paths and photons of flux Φ_j at offsets d_j, the irradiance at p1 is

    E ≈ Σ_j Φ_j w(d_j) / (M · π |s × t| · (1 − e^−4) · m),    w = exp(−a² − b²), a² + b² <= 4

and the reflected radiance is E times the BRDF of p1; on receivers that are not Lambertian every
photon brings its own direction, and the BRDF goes into the sum. Photons count only if they lie on
the same surface: |d·n| within half a bandwidth (or less, see ``gathering.thickness``), normals
within 41 degrees (cosine 0.75), and (n + n')·d within 5 % of |d|: on every quadric, flat or curved,
it is 0, and between parallel sheets it is twice their distance.

m is the share of the kernel that lies on such a surface. Without it every estimate near an edge
loses what its kernel spills over the edge. Points drawn from the kernel are probed by short rays
along −n, through glass that covers the surface but not through what light does not pass, until the
first one lands; the number of points is geometrically distributed with mean 1/m, so it *is* an
estimate of 1/m, unbiased but for the end after PROBES_MAX points, at the price of one ray wherever
the kernel spills nothing. What lies behind a wall that stands on the surface is no part of the
kernel (``walls``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..arrays import number
from ..kernel import PlaneKernel, disc, guarded_axes
from ..lobe_path import LobeOnPath
from . import index as spatial
from . import summed
from .gather_points import GatherPoints
from .glossy_caustics import by_photons
from .photon_map import PhotonMap, photon_direction, photon_flux
from .photon_word import (
    NORMAL_COS,
    faces,
    is_caustic,
    is_glossy_alone,
    one_sheet,
    segments,
    smooth_between,
)
from .receivers import gathered_part, shining_part
from .spectra import channel_mean

CUT2 = 4.0
KERNEL_MASS = 1 - math.exp(-CUT2)
# A photon on the same surface: offset along the normal in bandwidths.
SLAB = 0.5
# Points after which the probe gives up: 1/m is taken to be at most this.
PROBES_MAX = 32


@dataclass(frozen=True)
class KernelOptions:
    """How a gather point gets its kernel; the integrator's parameters of the same names."""

    anisotropic: bool
    rule: str
    size: str
    epsilon: float
    guard: bool
    max_aspect: float


@dataclass
class Gathered:
    """What density estimation found, one lane a gather point.

    lane        index of the eye path.
    radiance    reflected radiance, W/m²/sr.
    photons     photons inside the kernel.
    follows     the kernel follows a lobe (else it is the disc).
    clamped     it does, and the plane was so far edge-on that |r·n| was clamped.
    capped      it does, and met the aspect cap.
    degenerate  there is a lobe that cannot be followed: the disc.
    lost        no part of the kernel was found to lie on the surface.
    light       radiance by how it came (layers.Light); radius: bandwidth, world units. None where
                nobody asks.
    """

    lane: Any
    radiance: Any
    photons: Any
    follows: Any
    clamped: Any
    capped: Any
    degenerate: Any
    lost: Any
    light: Any = None
    radius: Any = None


def kernels(points: GatherPoints, radius, options: KernelOptions) -> tuple[PlaneKernel, Any, Any]:
    """(kernel, follows a lobe?, lobe that cannot be followed?) of each gather point.

    The disc where there is no lobe to follow, and where it cannot be followed: r is behind the
    lobe (r·z <= 0), or the ellipse is not finite.
    """
    if not options.anisotropic or points.path is None:
        return disc(points.n, radius), mi.Bool(False), mi.Bool(False)
    return kernels_along(points.path.lobe(), points.n, radius, options)


def kernels_along(path: LobeOnPath, n, radius, options: KernelOptions):
    """The same for lobes that are known; n: normals of the receivers."""
    round_ = disc(n, radius)
    shaped = guarded_axes(
        path.lobe,
        path.r,
        n,
        path.distance,
        radius,
        options.epsilon,
        options.rule,
        options.guard,
        options.max_aspect,
        options.size,
    )
    usable = dr.dot(path.r, path.lobe.z) > 0
    usable &= dr.isfinite(dr.sum(shaped.s) + dr.sum(shaped.t))
    usable &= dr.squared_norm(shaped.t) > 0
    follows = path.valid & usable
    return dr.select(follows, shaped, round_), follows, path.valid & ~usable


def estimate(
    photons: PhotonMap,
    points: GatherPoints,
    kernel: PlaneKernel,
    thickness,
    max_depth,
    active,
    surface=None,
    tolerance: float = 0,
    scores=None,
):
    """(reflected radiance, photons inside the kernel) of each gather point, edges not yet
    compensated.

    thickness  of what counts as the same surface: bandwidth, or less, world units.
    max_depth  path segments of camera and light path together, or 0 for no limit (or none that
               the map does not already keep).
    surface    Surface of receivers that are not Lambertian.
    tolerance  of the sum, relative to the flux in the kernel, if the map has sums; see ``summed``.
    scores     None, or (column, weight): what each photon gives to each point, squared, times the
               point's weight, is added to the photon's entry in the column.
    """
    ellipses = spatial.Ellipses.from_axes(points.p, kernel.s, kernel.t, points.n, SLAB * thickness)
    counts = _filter(points, max_depth)

    def visit(total, slot, word, d, rho2, inside):
        reflected, missing, count = total
        inside &= counts(word, d)
        light = photon_flux(photons, slot, inside) * dr.select(inside, dr.exp(-rho2), 0)
        if surface is not None:
            light *= surface.brdf(photons, slot, inside)
        if scores is not None:
            given = channel_mean(light * points.weight) * unit
            score = scores[1] * dr.square(given)
            # Directly: sums of each thread's own would have their size in the code.
            dr.scatter_add(scores[0], score, slot, inside & (score > 0), mode=dr.ReduceMode.Direct)
        # Kahan's sum: what rounding took from the total goes into the next term. A plain sum is
        # off by 1 % after a million equal photons.
        term = light - missing
        sum_ = reflected + term
        return sum_, (sum_ - reflected) - term, count + dr.select(inside, mi.UInt32(1), 0)

    def visit_node(total, node):
        reflected, missing, count = total
        light, inside, taken = summed.weighed(photons.sums, node, ellipses, CUT2, counts, tolerance)
        term = light - missing
        sum_ = reflected + term
        return (
            (sum_, (sum_ - reflected) - term, count + photons.index.points_in(node, inside)),
            taken,
        )

    # Where photons bring directions, a sum over them says nothing.
    whole = None
    if photons.sums is not None and surface is None:
        whole = 0.5 * tolerance, math.exp(-CUT2), visit_node
    total = (mi.Spectrum(0), mi.Spectrum(0), mi.UInt32(0))
    area = dr.pi * dr.sqrt(dr.squared_norm(kernel.s)) * dr.sqrt(dr.squared_norm(kernel.t))
    unit = dr.rcp(area * KERNEL_MASS * number(mi.Float, photons.emitted))
    reflected, _, count = spatial.gather(photons.index, ellipses, CUT2, visit, total, active, whole)
    return points.weight * reflected * unit, count


def _filter(points: GatherPoints, max_depth):
    """A function of a photon's word and offset: does the photon count at these gather points, if it
    is inside the kernel and the cosine of normals is above ``least``?"""
    allowed = dr.opaque(mi.UInt32, max_depth) - points.depth

    def counts(word, d, least=NORMAL_COS):
        yes = same_surface(points, word, d, least)
        if points.glossy is not None:
            yes &= points.glossy | ~is_glossy_alone(word)
        if max_depth:
            yes &= segments(word) <= allowed
        if points.caustic is not None:
            yes &= is_caustic(word) | ~points.caustic
        if points.wall is not None:
            yes &= ~points.wall.hides(d)
        return yes

    return counts


def same_surface(points: GatherPoints, word, d, least=NORMAL_COS):
    """Does the photon at the offset d lie on the surface of a point, the slab left aside?"""
    n = mi.Vector3f(points.n)
    return faces(word, n, least) & one_sheet(word, n, d, _rounding(points.p))


def _rounding(p):
    """By how much offsets between points near p may be wrong, world units."""
    return 2e-6 * dr.maximum(dr.maximum(dr.abs(p.x), dr.abs(p.y)), dr.abs(p.z))


def photons_inside(
    photons: PhotonMap, points: GatherPoints, kernel: PlaneKernel, thickness, max_depth
):
    """Is the photon in each slot of the map one that :func:`estimate` sums up?  (one gather point)

    Returns mi.Bool, as wide as there are photons.
    """
    ellipses = spatial.Ellipses.from_axes(points.p, kernel.s, kernel.t, points.n, SLAB * thickness)
    counts = _filter(points, max_depth)
    found = dr.zeros(mi.Bool, photons.stored)

    def visit(total, slot, word, d, rho2, inside):
        dr.scatter(found, mi.Bool(True), slot, inside & counts(word, d))
        return total

    spatial.gather(photons.index, ellipses, CUT2, visit, mi.UInt32(0), mi.Bool(True))
    return found


@dataclass(frozen=True)
class Surface:
    """The gathered parts of the BSDFs at gather points, or with ``glossy`` all of them, for glossy
    caustics; ``roughness`` as in ``receivers``."""

    bsdf: Any
    si: Any
    roughness: float
    glossy: bool

    @staticmethod
    def at(scene, points: GatherPoints, roughness: float, glossy: bool, wavelengths) -> Surface:
        """Found again by the rays that found it first."""
        ray = mi.Ray3f(points.origin, points.d)
        if wavelengths is not None:
            ray.wavelengths = wavelengths
        si = scene.ray_intersect(ray)
        return Surface(si.bsdf(ray), si, roughness, glossy)

    def brdf(self, photons: PhotonMap, slot, active):
        """BRDF value (1/sr) towards the viewer for the light of the photon in a slot."""
        wo = self.si.to_local(photon_direction(photons, slot, active))
        if self.glossy:
            q = dr.gather(mi.Float, photons.emitter_density, slot, active)
            value, p = shining_part(self.bsdf, self.si, wo, q > 0)
            value *= by_photons(p, q)
        else:
            value = gathered_part(self.bsdf, self.si, wo, self.roughness, active)
        # Bump maps keep their value where this cosine vanishes: no more than a hundredfold.
        return value / dr.maximum(dr.abs(mi.Frame3f.cos_theta(wo)), 0.01)


@dr.syntax
def probe_surface(
    scene, seed, points: GatherPoints, kernel: PlaneKernel, thickness, active, cover=None
):
    """(1/m, nothing found?): the inverse share of each kernel that lies on the surface.

    seed: a number, or mi.UInt32.

    cover: a function of (mi.BSDFPtr, active) as ``receivers.read_cover``; None where every surface
    gathers and none lets light pass.

    1 where none of PROBES_MAX points lay on one, which says more about the surface (finer than
    the slab, or than the resolution of its coordinates) than about its edges.
    """
    n = mi.Vector3f(points.n)
    height, rounding = SLAB * thickness, _rounding(points.p)
    # Random numbers of the eye path and vertex, whatever the order of the points.
    state, sequence = mi.sample_tea_32(points.lane, points.depth + number(mi.UInt32, seed))
    random = mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))
    tries = mi.UInt32(0)
    landed = mi.Bool(False)
    probing, fresh = mi.Bool(active), mi.Bool(True)
    q, depth = mi.Point3f(points.p), mi.Float(0)  # point of the kernel; below the slab's top
    while probing:
        u = mi.Point2f(random.next_float32(), random.next_float32())
        sin_phi, cos_phi = dr.sincos(dr.two_pi * u.y)
        rho = dr.sqrt(-dr.log(1 - u.x * KERNEL_MASS))
        drawn = points.p + kernel.s * (rho * cos_phi) + kernel.t * (rho * sin_phi)
        q, depth = dr.select(fresh, drawn, q), dr.select(fresh, 0, depth)
        tries += dr.select(fresh, mi.UInt32(1), 0)
        probe = mi.Ray3f(q + n * (height - depth), -n)
        probe.maxt = 2 * height - depth
        si = scene.ray_intersect(probe, mi.RayFlags.ShadingFrame, True, probing)
        cosine, d = dr.dot(si.n, n), si.p - points.p
        on_surface = si.is_valid() & (dr.abs(cosine) > NORMAL_COS)
        if dr.hint(points.wall is not None, mode="scalar"):
            on_surface &= ~points.wall.hides(d)
        on_surface &= smooth_between(n, dr.mulsign(mi.Vector3f(si.n), cosine), d, rounding)
        # Backs are passed: light arrives between them and the surface. So is glass; where its back
        # is met on the surface, that is the face below it. Under all else no light arrives. Of
        # mirrored shapes si.n is inside; the back is where BSDFs have it.
        passes = dr.mulsign(cosine, dr.dot(si.n, si.sh_frame.n)) < 0
        if cover is not None:
            gathers, clear = cover(si.bsdf(), probing & si.is_valid())
            on_surface &= gathers | (clear & passes)
            passes |= clear
        landed |= probing & on_surface
        depth += si.t + 1e-3 * height + rounding
        fresh = ~(si.is_valid() & passes) | (depth >= 2 * height)
        probing &= ~on_surface & (~fresh | (tries < PROBES_MAX))
    return dr.select(landed, mi.Float(tries), 1), active & ~landed
