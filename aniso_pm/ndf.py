"""Roughness → ASG of the normal distribution function (NDF)   [paper step 1].

Near its peak a microfacet NDF is a Gaussian in the half-vector h. With
ln G = ln cos θ − λ sin²θ = −(λ + 1/2) θ² + O(θ⁴) along the tangent axis:

    Beckmann  D ∝ exp(−tan²θ/α²) / cos⁴θ       ln D = −(1/α² − 2) θ² + O(θ⁴)
    GGX       D ∝ 1 / (cos⁴θ (1 + tan²θ/α²)²)  ln D = −(2/α² − 2) θ² + O(θ⁴)

``match="peak"``       λ = 1/α²: G has the peak D(z) = 1/(π α_u α_v) and the mass of D.
``match="curvature"``  λ from the θ² terms above: 1/α² − 5/2 and 2/α² − 5/2, which are positive for
                       α < 0.63 and α < 0.89 only. For GGX they differ by a factor of 2 because of
                       its long tails.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from .asg import ASG

# Smallest roughness of Mitsuba's microfacet distributions: bandwidths are at most 1e8.
ALPHA_MIN = 1e-4
_CURVATURE_FACTOR = {"beckmann": 1.0, "ggx": 2.0}


def asg_from_roughness(alpha_u, alpha_v, distribution="beckmann", match="peak") -> ASG:
    """ASG of the NDF of roughness (alpha_u, alpha_v), in the local frame (z = +z).

    alpha_u, alpha_v  Mitsuba's roughness along the tangent and the bitangent, > 0.
    distribution      "beckmann" or "ggx".
    match             "peak" or "curvature", see the module's head.

    D(h) ≈ amplitude · G(h) with amplitude = D(z) = 1/(π alpha_u alpha_v), lam = 1/alpha_u² and
    mu = 1/alpha_v² for ``match="peak"``.

    Raises ValueError for an unknown name, and for ``match="curvature"`` if an alpha is so large
    that no ASG has the NDF's curvature (this evaluates the arrays).
    """
    if distribution not in _CURVATURE_FACTOR:
        raise ValueError(
            f'asg_from_roughness: distribution "{distribution}" is not one of "beckmann", "ggx"'
        )
    if match not in ("peak", "curvature"):
        raise ValueError(f'asg_from_roughness: match "{match}" is not one of "peak", "curvature"')
    alpha_u, alpha_v = mi.Float(alpha_u), mi.Float(alpha_v)
    lam, mu = dr.rcp(dr.square(alpha_u)), dr.rcp(dr.square(alpha_v))
    amplitude = dr.inv_pi / (alpha_u * alpha_v)
    if match == "curvature":
        factor = _CURVATURE_FACTOR[distribution]
        lam, mu = factor * lam - 2.5, factor * mu - 2.5
        if dr.any(dr.minimum(lam, mu) <= 0):
            limit = (factor / 2.5) ** 0.5
            raise ValueError(
                f'asg_from_roughness: match="curvature" needs alpha < {limit:.3f} for '
                f'"{distribution}", got up to {dr.max(dr.maximum(alpha_u, alpha_v))[0]:g}; '
                'use match="peak"'
            )
    x, y, z = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    return ASG(x, y, z, lam, mu, amplitude)


# --- Reading the roughness of a Mitsuba BSDF ---------------------------------------------------


def children(node) -> dict:
    """Name → object or value of everything an object hands to ``mi.traverse``, one level deep."""
    collect = _collector(mi.variant())()
    # Not by a closure: classes live until the garbage collector comes, and would keep the node of a
    # scene that is gone. Dr.Jit would go on calling it.
    collect.node, collect.found = node, {}
    node.traverse(collect)
    return collect.found


@cache
def _collector(variant: str):
    class Collect(mi.TraversalCallback):
        def put(self, name, value, flags, cpptype=None):
            plain = cpptype is not None  # a number inside the object, behind a pointer
            self.found[name] = mi.get_property(value, cpptype, self.node) if plain else value

    return Collect


def nested_bsdfs(found: dict) -> list:
    """The BSDFs among ``children(bsdf)``, in the order of their declaration."""
    return [value for value in found.values() if isinstance(value, mi.BSDF)]


# What own_roughness and clearcoat_roughness read.
ROUGHNESS = (
    "alpha",
    "alpha_u",
    "alpha_v",
    "roughness",
    "anisotropic",
    "clearcoat",
    "clearcoat_gloss",
)


def own_roughness(bsdf):
    """How to read the roughness of a BSDF by itself: a function of (si, active) that returns
    (alpha_u, alpha_v), or None where it has none that can be read (wrappers have none). Roughness
    is at least 1e-4, as in Mitsuba's own distributions."""
    found = children(bsdf)

    def value(name, si, active):
        return _value(found[name], si, active)

    def alpha(name, si, active):
        return dr.maximum(value(name, si, active), ALPHA_MIN)

    if "alpha_u" in found and "alpha_v" in found:
        return lambda si, active: (alpha("alpha_u", si, active), alpha("alpha_v", si, active))
    if "alpha" in found:
        return lambda si, active: (alpha("alpha", si, active),) * 2
    if "roughness" in found and ("spec_tint" in found or "anisotropic" in found):
        # Mitsuba's principled BSDFs, after Burley (2012).
        def principled(si, active):
            r2 = dr.square(value("roughness", si, active))
            strength = value("anisotropic", si, active) if "anisotropic" in found else mi.Float(0)
            aspect = dr.sqrt(1 - 0.9 * strength)
            return dr.maximum(r2 / aspect, 1e-3), dr.maximum(r2 * aspect, 1e-3)

        return principled
    return None


def clearcoat_roughness(bsdf):
    """A function of (si, active): alpha of a principled BSDF's clearcoat, infinite where it has
    none; None for BSDFs without one. After Burley (2012): 0.1 to 0.001 as its gloss rises."""
    found = children(bsdf)
    if "clearcoat" not in found or "clearcoat_gloss" not in found:
        return None

    def alpha(si, active):
        gloss = _value(found["clearcoat_gloss"], si, active)
        coated = _value(found["clearcoat"], si, active) > 0
        return dr.select(coated, dr.lerp(0.1, 0.001, gloss), dr.inf)

    return alpha


def _value(source, si, active):
    return source.eval_1(si, active) if isinstance(source, mi.Texture) else mi.Float(source)


def roughness_source(bsdf):
    """``own_roughness`` through wrappers (``twosided``, ``mask``, ``bumpmap``, ``normalmap``,
    ``blendbsdf``): that of the first nested BSDF that has one; ``twosided`` takes the side seen.
    """
    own = own_roughness(bsdf)
    if own is not None:
        return own
    found = children(bsdf)
    sources = [roughness_source(nested) for nested in nested_bsdfs(found)]
    if bsdf.class_name() == "TwoSidedBRDF" and len(sources) == 2 and all(sources):
        front, back = sources

        def two_sided(si, active):
            on_front = mi.Frame3f.cos_theta(si.wi) > 0
            (fu, fv), (bu, bv) = front(si, active), back(si, active)
            return dr.select(on_front, fu, bu), dr.select(on_front, fv, bv)

        return two_sided
    return next((source for source in sources if source is not None), None)


def read_roughness(bsdf, si, active):
    """(alpha_u, alpha_v) per lane of the BSDFs at the surface interactions si; (0, 0) where there
    is none to be read. bsdf: mi.BSDFPtr. Decided once per BSDF while tracing, not per lane."""

    def read(instance, si, active):
        source = roughness_source(instance) if instance is not None else None
        if source is None:
            return mi.Float(0), mi.Float(0)
        alpha_u, alpha_v = source(si, active)
        return mi.Float(alpha_u), mi.Float(alpha_v)

    return dr.dispatch(bsdf, read, si, active)
