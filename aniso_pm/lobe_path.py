"""The reflection lobe that an eye path carries from its last glossy vertex to a gather point.

At an anisotropic glossy vertex the lobe is the warped ASG of the surface. If the path has met other
glossy vertices before, their spread arrives with it: a lobe of bandwidths λ, μ is taken as a
spherical Gaussian of ν = √(λμ), and the new lobe is convolved with all of them (variances 1/ν add).
Mirrors reflect the lobe along; refraction turns it by the angle between the rays. A glossy vertex
without readable anisotropy ends it: the kernel is the disc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .asg import ASG
from .ndf import asg_from_roughness, read_roughness
from .warp import warp_to_reflection

# Roughness ratio from which on a lobe counts as anisotropic.
ASPECT_MIN = 1.01
# Variance 1/ν beyond which a lobe tells nothing any more.
_BLUR_MAX = 1e3


@dataclass
class LobeOnPath:
    """The lobe that the kernel follows, one lane an eye path.

    lobe      ASG in world space.
    r         direction in which the path left it.
    distance  travelled since.
    blur      Σ 1/ν of all glossy vertices so far, this one included.
    valid     is there a lobe?
    """

    lobe: Any
    r: Any
    distance: Any
    blur: Any
    valid: Any


def no_lobe() -> LobeOnPath:
    """A path that has not met a glossy vertex."""
    lobe = ASG(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1), 1, 1)
    return LobeOnPath(lobe, mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0), mi.Bool(False))


def follow(path: LobeOnPath, bsdf, si, ray, bs, active) -> LobeOnPath:
    """The lobe after scattering at a vertex: a new one at glossy vertices, the old one carried
    along at delta vertices, none after a diffuse one.

    ray: the one that arrived at si; bs: the BSDF sample that it leaves with.
    """
    alpha_u, alpha_v = read_roughness(bsdf, si, active)
    large, small = dr.maximum(alpha_u, alpha_v), dr.minimum(alpha_u, alpha_v)
    glossy = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
    delta = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # Lobes of reflection; the transmitted lobe of a rough dielectric has another shape.
    reflected = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) > 0
    anisotropic = glossy & reflected & (small > 0) & (large > ASPECT_MIN * small)

    # The warped lobe on the side that the viewer is on (the NDF is symmetric in z).
    flip = mi.Vector3f(1, 1, dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(si.wi)))
    ndf = asg_from_roughness(dr.select(anisotropic, alpha_u, 1), dr.select(anisotropic, alpha_v, 1))
    warped = warp_to_reflection(ndf, si.wi * flip)
    blurred = warped.convolve_sg(dr.rcp(dr.maximum(path.blur, dr.smallest(mi.Float))))
    blurred = dr.select(path.blur > 0, blurred, warped)
    to_world = lambda w: si.to_world(w * flip)  # noqa: E731
    fresh = ASG(to_world(warped.x), to_world(warped.y), to_world(warped.z), blurred.lam, blurred.mu)
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
    lobe = dr.select(anisotropic, fresh, dr.select(delta, carried, old))
    direction = dr.select(anisotropic, r, dr.select(delta, carry(path.r), path.r))
    distance = dr.select(anisotropic | (active & ~delta), 0, path.distance)
    # An isotropic glossy lobe has λ = μ = 1/α² for half-vectors, a quarter of it for directions.
    spread = dr.select(
        anisotropic, dr.rsqrt(warped.lam * warped.mu), dr.square(dr.maximum(alpha_u, alpha_v)) * 4
    )
    blur = path.blur + dr.select(glossy, spread, dr.select(active & ~delta, _BLUR_MAX, 0))
    valid = dr.select(delta, path.valid, anisotropic & (path.blur < _BLUR_MAX))
    return LobeOnPath(lobe, direction, distance, dr.minimum(blur, _BLUR_MAX), valid)
