"""Half-vector lobe → reflection lobe: the spherical warp of paper step 1.

Reflection about h takes the viewer's direction o to r = 2(o·h)h − o. Near the mirror direction
i = 2c n − o, c = o·n, a small tilt of h moves r by 2 in the plane of incidence and by 2c across
it. With X' = normalize(o × n), Y' = i × X' the quadratic form λ (h·x)² + μ (h·y)² becomes

    M11 = [λ (x·X')² + μ (y·X')²] / (4c²)        across the plane
    M12 = (μ − λ) (x·X')(y·X') / (4c)
    M22 = [μ (x·X')² + λ (y·X')²] / 4            in the plane

(x·X' = cos φ, y·X' = sin φ; in the plane of incidence the tangent is Y with x·Y = −sin φ,
y·Y = cos φ up to a common sign). Eigenvalues and eigenvectors of M are the warped bandwidths and
axes   [XSD*13, Sec. 4.4].
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .asg import ASG

# Cosine of the viewing angle below which the warp is that of this angle.
COS_MIN = 1e-6


def warp_to_reflection(ndf: ASG, o) -> ASG:
    """ASG of the reflected directions r for an NDF lobe of half-vectors and a viewer at o.

    ndf  lobe around the normal n = ndf.z; o: unit, towards the viewer, in the same frame.

    The result is centred at the mirror direction; its amplitude is that of ``ndf``, and 0 where
    o·n <= 0. The Jacobian 1/(4 o·h) of the density is not part of it (paper: part of the smooth M).
    """
    # In double precision: an axis at an aspect of 1e4 moves by 1e-3 of the other one's length when
    # its direction is off by 1e-7. Only the result is rounded.
    wide = dr.float64_array_t(mi.Vector3f)
    o, x, y, n = wide(mi.Vector3f(o)), wide(ndf.x), wide(ndf.y), wide(ndf.z)
    lam, mu = type(o.x)(ndf.lam), type(o.x)(ndf.mu)
    c = dr.dot(o, n)
    visible = c > 0
    c_safe = dr.maximum(dr.abs(c), COS_MIN)
    i = dr.normalize(2 * c * n - o)

    # X' is across the plane of incidence. Within 1e-12 rad of normal incidence any tangent serves;
    # it is made orthogonal to i in either case.
    across = dr.cross(o, n)
    x_ = dr.select(dr.squared_norm(across) > 1e-24, across, x)
    x_ = dr.normalize(x_ - i * dr.dot(x_, i))
    y_ = dr.cross(i, x_)

    cos_phi, sin_phi = dr.dot(x, x_), dr.dot(y, x_)
    cc, ss, cs = cos_phi * cos_phi, sin_phi * sin_phi, cos_phi * sin_phi
    k = 0.5 * dr.rcp(c_safe)
    m11 = (lam * cc + mu * ss) * k * k
    m12 = 0.5 * (mu - lam) * cs * k
    m22 = (mu * cc + lam * ss) * 0.25

    major, minor, cos_t, sin_t = symmetric_eigen(m11, m12, m22)
    # The smaller eigenvalue is a difference; det/major keeps its relative accuracy. The
    # determinant is λμ/(16c²) identically.
    minor = dr.select(major > 0, (lam / major) * mu * (0.25 * k * k), minor)
    return ASG(
        x_ * cos_t + y_ * sin_t,
        y_ * cos_t - x_ * sin_t,
        i,
        major,
        minor,
        dr.select(visible, ndf.amplitude, 0),
    )


def symmetric_eigen(m11, m12, m22):
    """Eigen-decomposition of symmetric 2×2 matrices: (larger, smaller, cos t, sin t), the larger
    eigenvalue's eigenvector being (cos t, sin t). A multiple of the identity gives (1, 0)."""
    mean, half = 0.5 * (m11 + m22), 0.5 * (m11 - m22)
    scale = dr.maximum(dr.abs(half), dr.abs(m12))
    safe = dr.select(scale > 0, scale, 1)
    p, q = half / safe, m12 / safe
    radius = safe * dr.sqrt(p * p + q * q)
    angle = 0.5 * dr.select(scale > 0, dr.atan2(q, p), 0)
    sin_t, cos_t = dr.sincos(angle)
    return mean + radius, mean - radius, cos_t, sin_t
