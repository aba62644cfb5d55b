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
from .warp import COS_MIN, warp_to_reflection

# Roughness ratio from which on a lobe counts as anisotropic.
ASPECT_MIN = 1.01
# Variance 1/ν beyond which a lobe tells nothing any more.
_BLUR_MAX = 1e3


@dataclass
class LobeOnPath:
    """The lobe that the kernel follows, one lane a gather point.

    lobe      ASG in world space.
    r         direction in which the path left it.
    distance  travelled since.
    valid     is there a lobe?
    """

    lobe: Any
    r: Any
    distance: Any
    valid: Any


@dataclass
class GlossyVertex:
    """What an eye path keeps of its last anisotropic vertex, one lane an eye path. The lobe itself
    is worked out where it is needed: far fewer paths gather than are followed.

    x, y, z   the surface's frame, z on the viewer's side, as it appears over the mirrors since.
    wi, wo    towards the viewer and onwards, in that frame.
    alpha_u, alpha_v  roughness.
    distance  travelled since.
    earlier   Σ 1/ν of all glossy vertices before; blur: this one and later ones included.
    valid     is there such a vertex, and can its lobe be followed?
    """

    x: Any
    y: Any
    z: Any
    wi: Any
    wo: Any
    alpha_u: Any
    alpha_v: Any
    distance: Any
    earlier: Any
    blur: Any
    valid: Any

    def lobe(self) -> LobeOnPath:
        """Its warped lobe, widened by earlier vertices."""
        alpha_u, alpha_v = (dr.select(self.valid, a, 1) for a in (self.alpha_u, self.alpha_v))
        warped = warp_to_reflection(asg_from_roughness(alpha_u, alpha_v), self.wi)
        blurred = warped.convolve_sg(dr.rcp(dr.maximum(self.earlier, dr.smallest(mi.Float))))
        blurred = dr.select(self.earlier > 0, blurred, warped)
        x, y, z, r = (self._to_world(w) for w in (warped.x, warped.y, warped.z, self.wo))
        return LobeOnPath(ASG(x, y, z, blurred.lam, blurred.mu), r, self.distance, self.valid)

    def _to_world(self, w):
        return self.x * w.x + self.y * w.y + self.z * w.z


def no_lobe() -> GlossyVertex:
    """A path that has not met a glossy vertex."""
    x, y, z = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    zero = mi.Float(0)
    return GlossyVertex(
        x, y, z, mi.Vector3f(z), mi.Vector3f(z), zero, zero, zero, zero, zero, mi.Bool(False)
    )


def follow(path: GlossyVertex, bsdf, si, ray, bs, active) -> GlossyVertex:
    """The vertex to keep after scattering at one: a new one where it is anisotropic, the old one
    carried along at delta vertices, none after a diffuse one.

    ray: the one that arrived at si; bs: the BSDF sample that it leaves with.
    """
    alpha_u, alpha_v = read_roughness(bsdf, si, active)
    large, small = dr.maximum(alpha_u, alpha_v), dr.minimum(alpha_u, alpha_v)
    glossy = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
    delta = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # Lobes of reflection; the transmitted lobe of a rough dielectric has another shape.
    cos_i = mi.Frame3f.cos_theta(si.wi)
    reflected = cos_i * mi.Frame3f.cos_theta(bs.wo) > 0
    anisotropic = glossy & reflected & (small > 0) & (large > ASPECT_MIN * small)

    # A mirror's householder reflection, or the smallest rotation between the rays.
    r = si.to_world(bs.wo)
    middle = r + ray.d
    normal = r - ray.d
    scale_rotation = dr.rcp(dr.maximum(1 + dr.dot(r, ray.d), 1e-6))
    scale_mirror = 2 * dr.rcp(dr.maximum(dr.squared_norm(normal), 1e-12))

    def carry(w):
        turned = w - middle * (dr.dot(w, middle) * scale_rotation) + r * (2 * dr.dot(w, ray.d))
        mirrored = w - normal * (dr.dot(w, normal) * scale_mirror)
        return dr.select(delta, dr.select(reflected, mirrored, turned), w)

    # The frame on the side that the viewer is on (the NDF is symmetric in z).
    flip = mi.Vector3f(1, 1, dr.mulsign(mi.Float(1), cos_i))
    frame, keep = si.sh_frame, lambda new, old: dr.select(anisotropic, new, old)
    # 1/√(λμ) of the warped lobe. An isotropic one has λ = μ = 1/α² for half-vectors, a quarter of
    # it for directions.
    cosine = dr.maximum(dr.abs(cos_i), COS_MIN)
    spread = 4 * dr.select(anisotropic, cosine * alpha_u * alpha_v, dr.square(large))
    blur = path.blur + dr.select(glossy, spread, dr.select(active & ~delta, _BLUR_MAX, 0))
    return GlossyVertex(
        x=keep(frame.s, carry(path.x)),
        y=keep(frame.t, carry(path.y)),
        z=keep(frame.n * flip.z, carry(path.z)),
        wi=keep(si.wi * flip, path.wi),
        wo=keep(bs.wo * flip, path.wo),
        alpha_u=keep(alpha_u, path.alpha_u),
        alpha_v=keep(alpha_v, path.alpha_v),
        distance=dr.select(anisotropic | (active & ~delta), 0, path.distance),
        earlier=keep(path.blur, path.earlier),
        blur=dr.minimum(blur, _BLUR_MAX),
        valid=dr.select(delta, path.valid, anisotropic & (path.blur < _BLUR_MAX)),
    )
