"""From a reflection lobe to an elliptical kernel on a plane   [paper steps 2 to 4].

At the direction r the rule gives two tangent vectors u, v (radians). They are projected along r to
the receiver's tangent plane, giving s, t (world units), and a photon at offset d = a s + b t weighs
exp(−a² − b²), a kernel of integral π |s × t| and of covariance (s sᵀ + t tᵀ)/2.

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
# Smallest |r·n| that a projection divides by.
COS_MIN = 1e-3


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
    # In double precision like the derivatives; only the result is rounded.
    wide = type(t.g1)
    epsilon = wide(mi.Float(epsilon))
    if rule == "lobe":
        lam, mu = (dr.maximum(wide(w), 1e-12) for w in (lobe.lam, lobe.mu))
        u, v = t.e1 * dr.sqrt(epsilon / lam), t.e2 * dr.sqrt(epsilon / mu)
        return mi.Vector3f(u), mi.Vector3f(v)

    # Floors at the size of rounding of the two derivatives: they keep the lengths finite and are
    # not reached elsewhere.
    floor_g = 1e-14 * (2 * wide(dr.maximum(lobe.lam, lobe.mu)) + 1)
    floor_k = 1e-7
    cos_t, sin_t = _steep_direction(t, epsilon)
    if rule == "paper":
        # Along g itself wherever there is a gradient to speak of.
        norm = dr.sqrt(t.g1 * t.g1 + t.g2 * t.g2)
        has_gradient = norm > floor_g
        inv = dr.rcp(dr.select(has_gradient, norm, 1))
        cos_t = dr.select(has_gradient, t.g1 * inv, cos_t)
        sin_t = dr.select(has_gradient, t.g2 * inv, sin_t)

    def curvature(c, s, slope):
        second = t.h11 * c * c + 2 * t.h12 * c * s + t.h22 * s * s
        return dr.maximum(dr.abs(second + slope * slope), floor_k)

    slope_u = dr.abs(t.g1 * cos_t + t.g2 * sin_t)
    if rule == "paper":
        length_u = epsilon / dr.maximum(slope_u, floor_g)
        length_v = 2 * epsilon / curvature(-sin_t, cos_t, 0)
    else:

        def taylor_length(slope, kappa):
            return 2 * epsilon / (slope + dr.sqrt(slope * slope + 2 * epsilon * kappa))

        slope_v = dr.abs(t.g2 * cos_t - t.g1 * sin_t)
        length_u = taylor_length(slope_u, curvature(cos_t, sin_t, slope_u))
        length_v = taylor_length(slope_v, curvature(-sin_t, cos_t, slope_v))

    u = (t.e1 * cos_t + t.e2 * sin_t) * length_u
    v = (t.e2 * cos_t - t.e1 * sin_t) * length_v  # along r × u
    return mi.Vector3f(u), mi.Vector3f(v)


def _steep_direction(t, epsilon):
    """(cos, sin): the dominant eigenvector of g gᵀ + ε|H|/2 in (e1, e2), |H| being the Hessian
    with its eigenvalues made positive."""
    high, low, c, s = symmetric_eigen(t.h11, t.h12, t.h22)
    high, low = (0.5 * epsilon * dr.abs(w) for w in (high, low))
    m11 = t.g1 * t.g1 + high * c * c + low * s * s
    m12 = t.g1 * t.g2 + (high - low) * c * s
    m22 = t.g2 * t.g2 + high * s * s + low * c * c
    _, _, cos_t, sin_t = symmetric_eigen(m11, m12, m22)
    return cos_t, sin_t


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

    For kernels whose axes are not orthogonal; the integrator's own are (``PlaneKernel``) and need
    two dot products only. Triple products instead of the paper's Gram determinants: the median
    error at aspect 30 and a cosine of 0.01 is 2e-6 instead of 7e-3.
    """
    d, s, t, n = (mi.Vector3f(a) for a in (d, s, t, n))
    inv = dr.rcp(dr.dot(dr.cross(s, t), n))
    return dr.dot(dr.cross(d, t), n) * inv, dr.dot(dr.cross(s, d), n) * inv


@dataclass
class PlaneKernel:
    """Elliptical Gaussian on a plane: exp(−(d·s)²/|s|⁴ − (d·t)²/|t|⁴) with s ⟂ t.

    s, t     orthogonal half axes, world units, |s| >= |t|.
    clamped  the plane is seen edge-on: |r·n| < COS_MIN was raised to it.
    capped   the aspect cap shortened the long axis.
    """

    s: Any
    t: Any
    clamped: Any
    capped: Any


def disc(n, radius) -> PlaneKernel:
    """The isotropic kernel of the same area: |s| = |t| = radius."""
    frame = mi.Frame3f(n)
    return PlaneKernel(frame.s * radius, frame.t * radius, mi.Bool(False), mi.Bool(False))


def guarded_axes(
    lobe: ASG, r, n, distance, radius, epsilon, rule, guard=True, max_aspect=24.0, size="bandwidth"
) -> PlaneKernel:
    """The integrator's kernel: rule, guard, projection, aspect cap and size in one.

    Ellipses are added and bounded as covariance matrices in an orthonormal basis of the plane, so
    that neither a degenerate parallelogram (s ∥ t) nor an edge-on plane needs a case of its own:
    |r·n| is clamped at COS_MIN, and where the clamp or the cap max_aspect acted is reported.

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
    clamped = dr.abs(cos_n) < COS_MIN
    inv = dr.mulsign(dr.rcp(dr.maximum(dr.abs(cos_n), COS_MIN)), cos_n)
    r1, r2 = dr.dot(r, frame.s), dr.dot(r, frame.t)

    def project(w):
        shear = dr.dot(w, n) * inv
        return distance * (dr.dot(w, frame.s) - shear * r1), distance * (
            dr.dot(w, frame.t) - shear * r2
        )

    (u1, u2), (v1, v2) = project(u), project(v)
    disc_share = GUARD_KAPPA * radius if guard and size == "bandwidth" else mi.Float(0)
    # Everything in units of the largest length, so that no square leaves the range of numbers.
    unit = dr.maximum(dr.maximum(dr.hypot(u1, u2), dr.hypot(v1, v2)), disc_share)
    unit = dr.maximum(unit, 1e-30)
    u1, u2, v1, v2, disc_share = (w / unit for w in (u1, u2, v1, v2, disc_share))

    # --- Covariances add; half axes ---
    m11, m12, m22 = u1 * u1 + v1 * v1, u1 * u2 + v1 * v2, u2 * u2 + v2 * v2
    added = disc_share * disc_share
    # The determinant from the cross product: the smaller eigenvalue itself is a difference.
    cross = u1 * v2 - u2 * v1
    determinant = cross * cross + added * (m11 + m22) + added * added
    long2, _, cos_t, sin_t = symmetric_eigen(m11 + added, m12, m22 + added)

    # --- Aspect and size: a cap keeps the area ---
    area = dr.maximum(dr.sqrt(determinant), 1e-30)  # |s × t|
    aspect = dr.maximum(long2 / area, 1)
    capped = ~(aspect <= max_aspect)
    mean = radius if size == "bandwidth" else unit * dr.sqrt(area)
    stretch = dr.sqrt(dr.select(capped, max_aspect, aspect))
    long, short = mean * stretch, mean / stretch
    s = (frame.s * cos_t + frame.t * sin_t) * long
    t = (frame.t * cos_t - frame.s * sin_t) * short
    return PlaneKernel(s, t, clamped, capped)
