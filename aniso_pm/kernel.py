"""From a reflection lobe to an elliptical kernel on a plane   [paper steps 2 to 4].

At the direction r the rule gives two tangent vectors u, v (radians): along u the lobe changes
fastest. They are projected along r to the receiver's tangent plane, giving s, t (world units), and
a photon at offset d = a s + b t weighs exp(−a² − b²), a kernel of integral π |s × t| and of
covariance (s sᵀ + t tᵀ)/2.

Rules, with f = ln G, g its gradient, κ(d) = f''(d) + (g·d)² = (∂²G/∂d²)/G:

``taylor``  the change of G along an axis of length l is ε in the second-order expansion
            |g·d| l + ½|κ(d)| l² = ε, i.e. l = 2ε / (|g·d| + √((g·d)² + 2ε|κ(d)|)). This is the
            paper's first-order length ε/|g| where the gradient rules and √(2ε/|κ|) where it
            vanishes. Axes: eigenvectors of g gᵀ/ε² + |H|/(2ε), which are g/|g| and its
            perpendicular up to terms of order ε and stay defined at the lobe's centre.
``paper``   as printed: u along g, l_u = ε/|g|, l_v = 2ε/|κ(v)| (which is in rad²).
``lobe``    √(ε/λ), √(ε/μ) along the lobe's own axes: the kernel's covariance is proportional to
            the lobe's.

The *guard* (``guarded_axes``): an ellipse must never outgrow the lobe it stands for. With the
radius fixed by the bandwidth, a literal ellipse is far longer than the lobe's footprint wherever
p1 is near p0, and reaches under and around objects. Let Σ_rule be the largest ellipse of the
rule's shape that fits into the lobe's footprint on the plane; then

    Σ_kernel ∝ Σ_rule + (κ r)² I/2,      scaled to the area of the disc of radius r:

lobe-shaped where the footprint is wide against the bandwidth, a disc where it is narrow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .asg import ASG
from .warp import symmetric_eigen

RULES = ("taylor", "paper", "lobe")
# Share of the disc that the guard adds, in units of the bandwidth (κ above).
GUARD_KAPPA = 1.0


def kernel_axes(lobe: ASG, r, epsilon=0.02, rule="taylor"):
    """Minor and major kernel axis (u, v) at the direction r: tangent vectors, length in radians.

    lobe     the warped reflection lobe; r: unit direction from p0 to p1; epsilon > 0: tolerated
             relative change of G. rule: "taylor", "paper" or "lobe".

    The literal rule: no guard and no cap, finite everywhere. Behind the lobe, and where both the
    gradient and the curvature vanish, the axes are as long as the floors below allow. ``lobe``
    returns the axes of x and y in this order; ``taylor`` and ``paper`` return the steep axis first.

    Raises ValueError for an unknown rule.
    """
    if rule not in RULES:
        raise ValueError(f'kernel_axes: rule "{rule}" is not one of {", ".join(RULES)}')
    t = lobe.tangent_derivatives(r)
    epsilon = mi.Float(epsilon)
    if rule == "lobe":
        tiny = 1e-12
        u = t.e1 * dr.sqrt(epsilon / dr.maximum(lobe.lam, tiny))
        v = t.e2 * dr.sqrt(epsilon / dr.maximum(lobe.mu, tiny))
        return u, v

    cos_t, sin_t = _steep_direction(t, epsilon)
    if rule == "paper":
        # Along g itself wherever there is a gradient to speak of.
        norm = dr.hypot(t.g1, t.g2)
        has_gradient = norm > 1e-6 * dr.sqrt(2 * dr.maximum(lobe.lam, lobe.mu) + 1)
        inv = dr.rcp(dr.select(has_gradient, norm, 1))
        cos_t = dr.select(has_gradient, t.g1 * inv, cos_t)
        sin_t = dr.select(has_gradient, t.g2 * inv, sin_t)

    # Floors at the size of single-precision rounding of the two derivatives: they keep the
    # lengths finite and are not reached elsewhere.
    scale = 2 * dr.maximum(lobe.lam, lobe.mu) + 1
    floor_g, floor_k = 1e-7 * dr.sqrt(scale), 1e-7

    def slope_and_curvature(c, s):
        slope = dr.abs(t.g1 * c + t.g2 * s)
        second = t.h11 * c * c + 2 * t.h12 * c * s + t.h22 * s * s
        return slope, dr.abs(second + slope * slope)

    if rule == "paper":
        slope, _ = slope_and_curvature(cos_t, sin_t)
        _, curvature = slope_and_curvature(-sin_t, cos_t)
        length_u = epsilon / dr.maximum(slope, floor_g)
        length_v = 2 * epsilon / dr.maximum(curvature, floor_k)
    else:

        def taylor_length(c, s):
            slope, curvature = slope_and_curvature(c, s)
            curvature = dr.maximum(curvature, floor_k)
            # (g·d)² + 2ε|κ| as a hypotenuse: the squares may leave the single-precision range.
            return 2 * epsilon / (slope + _hypot(slope, dr.sqrt(2 * epsilon) * dr.sqrt(curvature)))

        length_u, length_v = taylor_length(cos_t, sin_t), taylor_length(-sin_t, cos_t)

    u_d = t.e1 * cos_t + t.e2 * sin_t
    v_d = t.e2 * cos_t - t.e1 * sin_t  # r × u_d
    return u_d * length_u, v_d * length_v


def _steep_direction(t, epsilon):
    """(cos, sin) in (e1, e2) of the dominant eigenvector of g gᵀ + ε|H|/2, |H| the Hessian with
    its eigenvalues made positive."""
    high, low, c, s = symmetric_eigen(t.h11, t.h12, t.h22)
    high, low = dr.abs(high), dr.abs(low)
    # All terms scaled by the largest entry, so that no square overflows.
    size = dr.maximum(dr.maximum(dr.abs(t.g1), dr.abs(t.g2)), dr.sqrt(dr.maximum(high, low)))
    inv = dr.rcp(dr.select(size > 0, size, 1))
    g1, g2 = t.g1 * inv, t.g2 * inv
    weight = 0.5 * epsilon * inv
    high, low = high * weight * inv, low * weight * inv
    m11 = g1 * g1 + high * c * c + low * s * s
    m12 = g1 * g2 + (high - low) * c * s
    m22 = g2 * g2 + high * s * s + low * c * c
    _, _, cos_t, sin_t = symmetric_eigen(m11, m12, m22)
    return cos_t, sin_t


def _hypot(a, b):
    big, small = dr.maximum(a, b), dr.minimum(a, b)
    ratio = small / dr.select(big > 0, big, 1)
    return big * dr.sqrt(1 + ratio * ratio)


def project_to_plane(u, v, r, n, distance):
    """Project kernel axes along r to the plane of normal n: (s, t) in world units   [paper step 3].

    u, v: tangent vectors at r, radians; r: from p0 to the receiver; n: its unit normal; distance:
    |p1 − p0|. The literal formula s = τ (u − (u·n / r·n) r), infinite at r·n = 0;
    |s × t| = τ² |u × v| / |r·n|.
    """
    u, v, r, n = (mi.Vector3f(a) for a in (u, v, r, n))
    inv = dr.rcp(dr.dot(r, n))
    s = (u - r * (dr.dot(u, n) * inv)) * distance
    t = (v - r * (dr.dot(v, n) * inv)) * distance
    return s, t


def coordinates(d, s, t, n):
    """Sheared coordinates (a, b) with d = a s + b t + c n   [paper step 4].

    Triple products instead of the paper's Gram determinants: the median error at aspect 30 and a
    cosine of 0.01 is 2e-6 instead of 7e-3.
    """
    d, s, t, n = (mi.Vector3f(a) for a in (d, s, t, n))
    inv = dr.rcp(dr.dot(dr.cross(s, t), n))
    return dr.dot(dr.cross(d, t), n) * inv, dr.dot(dr.cross(s, d), n) * inv


@dataclass
class PlaneKernel:
    """Elliptical Gaussian on a plane: exp(−(d·s)²/|s|⁴ − (d·t)²/|t|⁴) with s ⟂ t.

    s, t     orthogonal half axes, world units, |s| >= |t|.
    bounded  the aspect cap or the grazing clamp acted on this lane.
    """

    s: Any
    t: Any
    bounded: Any


def disc(n, radius) -> PlaneKernel:
    """The isotropic kernel of the same area: |s| = |t| = radius."""
    frame = mi.Frame3f(n)
    return PlaneKernel(frame.s * radius, frame.t * radius, mi.Bool(False))


def guarded_axes(
    lobe: ASG, r, n, distance, radius, epsilon, rule, guard=True, max_aspect=32.0, size="bandwidth"
) -> PlaneKernel:
    """The integrator's kernel: rule, guard, projection, aspect cap and size in one.

    Ellipses are added and bounded as covariance matrices in an orthonormal basis of the plane, so
    that neither a degenerate parallelogram (s ∥ t) nor an edge-on plane needs a case of its own:
    1/|r·n| is clamped at 1e3 and what the clamp or the cap max_aspect changed is reported.

    lobe, r, n in one frame (world); distance, radius in world units. size="bandwidth" scales the
    ellipse to |s × t| = radius²; "epsilon" keeps the literal size of the rule.
    """
    u, v = kernel_axes(lobe, r, epsilon, rule)
    frame = mi.Frame3f(n)

    # The lobe's own half axes at r (covariance (a aᵀ + b bᵀ)/2).
    la, lb = kernel_axes(lobe, r, 1.0, "lobe")
    if guard and rule != "lobe":
        # Largest c with c (u uᵀ + v vᵀ) inside a aᵀ + b bᵀ: 1 / the larger eigenvalue of the
        # rule's ellipse in the lobe's coordinates.
        ua, ub = dr.dot(u, la) / dr.squared_norm(la), dr.dot(u, lb) / dr.squared_norm(lb)
        va, vb = dr.dot(v, la) / dr.squared_norm(la), dr.dot(v, lb) / dr.squared_norm(lb)
        c, _, _, _ = symmetric_eigen(ua * ua + va * va, ua * ub + va * vb, ub * ub + vb * vb)
        fit = dr.rsqrt(dr.maximum(c, 1e-30))
        if size == "epsilon":
            fit = dr.minimum(fit, 1)  # a literal size is cut, never enlarged
        u, v = u * fit, v * fit
    elif guard and size == "bandwidth":
        u, v = la, lb

    # --- Projection along r, in the plane's basis ---
    cos_n = dr.dot(r, n)
    grazing = dr.abs(cos_n) < 1e-3
    inv = dr.mulsign(dr.rcp(dr.maximum(dr.abs(cos_n), 1e-3)), cos_n)
    r1, r2 = dr.dot(r, frame.s), dr.dot(r, frame.t)

    def project(w):
        shear = dr.dot(w, n) * inv
        return distance * (dr.dot(w, frame.s) - shear * r1), distance * (
            dr.dot(w, frame.t) - shear * r2
        )

    (u1, u2), (v1, v2) = project(u), project(v)
    if not (guard or size == "epsilon"):
        # Only the shape counts: scaled by the larger axis before squaring.
        inv_size = dr.rcp(dr.maximum(dr.sqrt(u1 * u1 + u2 * u2 + v1 * v1 + v2 * v2), 1e-30))
        u1, u2, v1, v2 = (w * inv_size for w in (u1, u2, v1, v2))
    m11, m12, m22 = u1 * u1 + v1 * v1, u1 * u2 + v1 * v2, u2 * u2 + v2 * v2
    if guard and size == "bandwidth":
        disc2 = dr.square(GUARD_KAPPA * radius)
        m11, m22 = m11 + disc2, m22 + disc2

    # --- Half axes, aspect and size ---
    long2, short2, cos_t, sin_t = symmetric_eigen(m11, m12, m22)
    # |s × t|² is the determinant, without the cancellation in the smaller eigenvalue.
    capped = short2 * (max_aspect * max_aspect) < long2
    short2 = dr.maximum(short2, long2 / (max_aspect * max_aspect))
    long, short = dr.sqrt(dr.maximum(long2, 1e-30)), dr.sqrt(dr.maximum(short2, 1e-30))
    if size == "bandwidth":
        aspect = dr.sqrt(long / short)
        long, short = radius * aspect, radius / aspect
    s = (frame.s * cos_t + frame.t * sin_t) * long
    t = (frame.t * cos_t - frame.s * sin_t) * short
    return PlaneKernel(s, t, capped | grazing)
