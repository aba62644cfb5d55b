"""Camera paths up to the gather point.

A path is traced as Mitsuba's ``path`` does (emitter sampling and BSDF sampling, combined by the
power heuristic) until it meets a receiver. There it still takes the direct light, by both
techniques, and becomes a gather point: everything that reaches the receiver over two path
segments or more is the photon map's. A path that never meets a receiver is path tracing and nothing
else, so the two halves together count every light path exactly once.

Along the way the path remembers the reflection lobe of its last glossy vertex, where that vertex
was anisotropic. Mirrors between the lobe and the gather point reflect the lobe along; refraction
turns it by the angle between the rays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .asg import ASG
from .ndf import asg_from_roughness, read_roughness
from .needs import receiver_reflectance
from .rays import largest_coordinate, spawn_ray
from .warp import warp_to_reflection

# Roughness ratio from which on a lobe counts as anisotropic.
ASPECT_MIN = 1.01


@dataclass
class LobeOnPath:
    """The lobe that the kernel follows: the ASG in world space, the direction r in which the path
    left it, the distance travelled since, and whether there is one."""

    lobe: Any
    r: Any
    distance: Any
    valid: Any


@dataclass
class GatherPoints:
    """Where eye paths ended on receivers, one lane an eye path.

    active    is there a gather point?
    p, n      position; geometric normal of the side that is seen.
    weight    path throughput times BRDF (Spectrum, 1/sr): radiance per irradiance.
    depth     path segments from the camera.
    path      LobeOnPath, or None where the scene has no anisotropic lobes.
    """

    active: Any
    p: Any
    n: Any
    weight: Any
    depth: Any
    path: Any


def take_lanes(value, lanes):
    """The given lanes of a tree of dataclasses and Dr.Jit arrays (constants stay as they are)."""
    if value is None:
        return None
    if is_dataclass(value):
        return type(value)(
            **{f.name: take_lanes(getattr(value, f.name), lanes) for f in fields(value)}
        )
    return value if dr.width(value) == 1 else dr.gather(type(value), value, lanes)


@dr.syntax
def walk(scene, sampler, ray, max_depth, rr_depth, hide_emitters, follow_lobes, deep, active):
    """Trace camera paths to their gather points: (radiance, valid, GatherPoints).

    radiance       emission, direct light and light of paths without a receiver, W/m²/sr.
    valid          did the ray meet anything but null surfaces and, if they are hidden, emitters?
                   (alpha, as in ``path``)
    follow_lobes   keep the anisotropic lobe of the last glossy vertex (``needs.lobes``).
    deep           the scene has surfaces to walk through (``needs.chains``).
    """
    ctx = mi.BSDFContext()
    max_depth, rr_depth = dr.opaque(mi.UInt32, max_depth), dr.opaque(mi.UInt32, rr_depth)
    reach = dr.opaque(mi.Float, largest_coordinate(scene))

    ray = mi.Ray3f(ray)  # Current ray
    depth = mi.UInt32(1)  # Path segments up to the vertex that is looked at
    L = mi.Spectrum(0)  # Radiance so far
    β = mi.Spectrum(1)  # Path throughput
    η = mi.Float(1)  # Relative index of refraction along the path
    active = mi.Bool(active)  # Lanes with a path to follow
    valid = mi.Bool(not hide_emitters and scene.environment() is not None)  # Anything seen?
    gathered = mi.Bool(False)  # The last vertex was a receiver: only its direct light is missing
    si_prev = dr.zeros(mi.Interaction3f)  # Last vertex
    pdf_prev = mi.Float(1)  # Density of the last BSDF sample
    delta_prev = mi.Bool(True)  # Was it a delta distribution (or the camera)?
    points = GatherPoints(
        mi.Bool(False),
        mi.Point3f(0),
        mi.Normal3f(0, 0, 1),
        mi.Spectrum(0),
        mi.UInt32(0),
        no_lobe() if follow_lobes else None,
    )
    path = no_lobe() if follow_lobes else None

    while dr.hint(active, label="eye paths"):
        # --- Find the next vertex ---
        si = scene.ray_intersect(ray, active)
        first = depth == 1
        if dr.hint(hide_emitters, mode="scalar"):
            si = _skip_emitters(scene, ray, si, active & first)

        # --- Emission, weighted against emitter sampling at the last vertex ---
        ds = mi.DirectionSample3f(scene, si, si_prev)
        seen = active & (ds.emitter != None)  # noqa: E711 (a Dr.Jit comparison)
        if dr.hint(hide_emitters, mode="scalar"):
            # As path does: the environment appears once a surface has been seen.
            seen &= valid | si.is_valid()
        pdf_emitter = scene.pdf_emitter_direction(si_prev, ds, seen & ~delta_prev)
        mis = dr.select(delta_prev, 1, _power_heuristic(pdf_prev, pdf_emitter))
        L[seen] = dr.fma(β, mis * ds.emitter.eval(si, seen), L)
        on_surface = active & si.is_valid()
        active &= si.is_valid() & (depth < max_depth) & ~gathered

        # --- Direct light by emitter sampling ---
        bsdf = si.bsdf(ray)
        sample_light = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, sample_light)
        sample_light &= ds.pdf != 0
        wo = si.to_local(ds.d)
        f, pdf = bsdf.eval_pdf(ctx, si, wo, sample_light)
        mis = dr.select(ds.delta, 1, _power_heuristic(ds.pdf, pdf))
        L[sample_light] = dr.fma(β, mis * f * light, L)

        # --- Is this a gather point? ---
        is_receiver, reflectance = receiver_reflectance(bsdf, si, active)
        gathered = active & is_receiver
        here = gathered & (depth + 2 <= max_depth) & (dr.max(reflectance) > 0)
        points.active |= here
        points.p = dr.select(here, si.p, points.p)
        points.n = dr.select(here, dr.mulsign(si.n, dr.dot(-ray.d, si.n)), points.n)
        points.weight = dr.select(here, β * reflectance, points.weight)
        points.depth = dr.select(here, depth, points.depth)
        if dr.hint(follow_lobes, mode="scalar"):
            path.distance += dr.select(active, si.t, 0)
            points.path = dr.select(here, path, points.path)

        # --- Sample the BSDF: one more segment for direct light, or the path goes on ---
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        if dr.hint(follow_lobes, mode="scalar"):
            path = _follow(path, bsdf, si, ray, bs, active & ~gathered)
        valid |= on_surface & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        ray = spawn_ray(si, si.to_world(bs.wo), reach)
        β *= weight
        η *= bs.eta
        si_prev = mi.Interaction3f(si)
        pdf_prev = bs.pdf
        delta_prev = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(β) > 0
        if dr.hint(not deep, mode="scalar"):
            active &= gathered

        # --- Russian roulette ---
        if dr.hint(deep, mode="scalar"):
            survive = dr.minimum(dr.max(β) * η * η, 0.95)
            roulette = (depth >= rr_depth) & ~gathered
            active &= ~roulette | (sampler.next_1d(active) < survive)
            β[roulette] = β * dr.rcp(survive)
        depth += 1

    # A throughput that is not finite makes the whole sample so: it is counted and dropped later.
    L = dr.select(dr.all(dr.isfinite(points.weight)), L, dr.nan)
    return L, valid, points


def no_lobe() -> LobeOnPath:
    """A path that has not met an anisotropic lobe."""
    lobe = ASG(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1), 1, 1)
    return LobeOnPath(lobe, mi.Vector3f(0, 0, 1), mi.Float(0), mi.Bool(False))


def _power_heuristic(a, b):
    """Veach's weight a²/(a² + b²) of a sample drawn with density a."""
    return dr.select(dr.isfinite(a), dr.rcp(1 + dr.square(b / a)), 1)


@dr.syntax
def _skip_emitters(scene, ray, si, active):
    """The first surface behind directly visible area lights (``hide_emitters``)."""
    ray = mi.Ray3f(ray)
    active = active & si.is_valid()
    active &= si.emitter(scene) != None  # noqa: E711
    while active:
        ray = si.spawn_ray(ray.d)
        si[active] = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        active &= si.emitter(scene) != None  # noqa: E711
    return si


def _follow(path: LobeOnPath, bsdf, si, ray, bs, active) -> LobeOnPath:
    """The lobe after scattering at a vertex: a new one at glossy vertices, the old one carried
    along at delta vertices."""
    alpha_u, alpha_v = read_roughness(bsdf, si, active)
    large, small = dr.maximum(alpha_u, alpha_v), dr.minimum(alpha_u, alpha_v)
    glossy = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
    # Lobes of reflection; the transmitted lobe of a rough dielectric has another shape.
    reflected = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) > 0
    anisotropic = glossy & reflected & (small > 0) & (large > ASPECT_MIN * small)

    # The warped lobe on the side that the viewer is on (the NDF is symmetric in z).
    flip = mi.Vector3f(1, 1, dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(si.wi)))
    ndf = asg_from_roughness(dr.select(anisotropic, alpha_u, 1), dr.select(anisotropic, alpha_v, 1))
    warped = warp_to_reflection(ndf, si.wi * flip)
    to_world = lambda w: si.to_world(w * flip)  # noqa: E731
    fresh = ASG(to_world(warped.x), to_world(warped.y), to_world(warped.z), warped.lam, warped.mu)
    r = si.to_world(bs.wo)

    # A mirror's householder reflection, or the smallest rotation between the rays.
    middle = r + ray.d
    normal = r - ray.d
    scale_rotation = dr.rcp(dr.maximum(1 + dr.dot(r, ray.d), 1e-6))
    scale_mirror = 2 * dr.rcp(dr.maximum(dr.squared_norm(normal), 1e-12))

    def carry(w):
        turned = w - middle * (dr.dot(w, middle) * scale_rotation) + r * (2 * dr.dot(w, ray.d))
        mirrored = w - normal * (dr.dot(w, normal) * scale_mirror)
        return dr.select(reflected, mirrored, turned)

    old = path.lobe
    carried = ASG(carry(old.x), carry(old.y), carry(old.z), old.lam, old.mu)
    delta = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    lobe = dr.select(anisotropic, fresh, dr.select(delta, carried, old))
    direction = dr.select(anisotropic, r, dr.select(delta, carry(path.r), path.r))
    distance = dr.select(anisotropic | (active & ~delta), 0, path.distance)
    return LobeOnPath(lobe, direction, distance, dr.select(delta, path.valid, anisotropic))
