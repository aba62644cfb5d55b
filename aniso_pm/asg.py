"""The anisotropic spherical Gaussian (ASG) in single precision.

    G(v; [x, y, z], [λ, μ]) = max(v·z, 0) · exp(−λ (v·x)² − μ (v·y)²)      [XSD*13, Eq. 1]

Derivatives are those of f = ln G, so that nothing underflows: G itself is below the smallest
single-precision number 13 standard deviations from its centre, f is just a number. With
s = v·z, a = v·x, b = v·y, a unit tangent d at v (d·v = 0) and the geodesic
v(t) = v cos t + d sin t:

    f        = ln s − λ a² − μ b²
    ∇f · d   = (d·z)/s − 2λ a (d·x) − 2μ b (d·y)
    f''(d)   = −(d·z)²/s² − 2λ (d·x)² − 2μ (d·y)² − (∇f·v),    ∇f·v = 1 − 2λ a² − 2μ b²

(the last term is the curvature of the geodesic: v'' = −v).

Reference: K. Xu, W.-L. Sun, Z. Dong, D.-Y. Zhao, R.-D. Wu, S.-M. Hu: *Anisotropic Spherical
Gaussians*, ACM TOG 32(6):209, 2013 [XSD*13].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

# v·z below which derivatives are those at this height: keeps 1/s² and its products finite.
S_MIN = 1e-9


def accurate_dot(a, b):
    """a·b of 3-vectors to full single precision, cancellation included.

    A plain dot product of unit vectors has an absolute error of 1e-7; an ASG of bandwidth 1e8 has
    a standard deviation of 7e-5 and multiplies that error by 2λ. Error-free transformations
    (Ogita, Rump, Oishi 2005, Dot2) cost a dozen more instructions.
    """
    total, error = a[0] * b[0], None
    error = dr.fma(a[0], b[0], -total)
    for i in (1, 2):
        product = a[i] * b[i]
        error += dr.fma(a[i], b[i], -product)  # what the product rounded away
        sum_ = total + product
        virtual = sum_ - total
        error += (total - (sum_ - virtual)) + (product - virtual)  # what the sum rounded away
        total = sum_
    return total + error


class TangentDerivatives(NamedTuple):
    """First and second derivatives of ln G in a tangent basis (e1, e2) at a direction v.

    e1, e2 are the ASG's axes x, y turned to v by the smallest rotation that takes z to v.
    g1, g2: gradient, 1/rad. h11, h12, h22: Hessian, 1/rad². All in double precision.
    """

    e1: Any
    e2: Any
    g1: Any
    g2: Any
    h11: Any
    h12: Any
    h22: Any


@dataclass
class ASG:
    """One ASG, or as many as the arrays are wide.

    x, y, z    unit, right-handed (z = x × y): tangent, bitangent, lobe direction.
    lam, mu    bandwidths >= 0 of the x and the y axis, 1/rad², in any order of size.
    amplitude  factor of G in ``eval``, ``log_eval`` and ``integral``; not in derivatives and pdf.
    """

    x: Any
    y: Any
    z: Any
    lam: Any
    mu: Any
    amplitude: Any = 1.0

    def __post_init__(self):
        # Types are looked up here, not at import: they change with mi.set_variant().
        self.x, self.y, self.z = mi.Vector3f(self.x), mi.Vector3f(self.y), mi.Vector3f(self.z)
        self.lam, self.mu = mi.Float(self.lam), mi.Float(self.mu)
        self.amplitude = mi.Float(self.amplitude)

    def _local(self, v):
        """(v·x, v·y, v·z)."""
        v = mi.Vector3f(v)
        return accurate_dot(v, self.x), accurate_dot(v, self.y), accurate_dot(v, self.z)

    def eval(self, v):
        """amplitude · G(v); 0 where v·z <= 0. v: unit vectors."""
        a, b, s = self._local(v)
        return self.amplitude * dr.maximum(s, 0) * dr.exp(-self.lam * a * a - self.mu * b * b)

    def log_eval(self, v):
        """ln(amplitude · G(v)); −inf where v·z <= 0. Finite where eval() underflows."""
        a, b, s = self._local(v)
        f = dr.log(dr.maximum(s, 0)) + dr.log(self.amplitude) - self.lam * a * a - self.mu * b * b
        return dr.select(s > 0, f, -dr.inf)

    def tangent_derivatives(self, v) -> TangentDerivatives:
        """Gradient and Hessian of ln G at v in the turned lobe axes, in double precision.

        The curvature of G along the long axis is a difference f'' + (g·d)² of terms as large as
        the squared gradient, 1e10 and more for narrow lobes; single precision loses it where it
        changes sign. Nothing here assumes that the axes are orthogonal to more than rounding.
        Behind the lobe (v·z <= 0) all derivatives are 0; for 0 < v·z < 1e-9 they are those of
        v·z = 1e-9.
        """
        wide = dr.float64_array_t(mi.Vector3f)
        x, y, z = wide(self.x), wide(self.y), wide(self.z)
        lam, mu = 2 * type(x.x)(self.lam), 2 * type(x.x)(self.mu)
        v = dr.normalize(wide(mi.Vector3f(v)))
        a, b, s = dr.dot(v, x), dr.dot(v, y), dr.dot(v, z)
        front = s > 0
        s = dr.maximum(s, S_MIN)
        # The smallest rotation z → v applied to x; e2 is on the side of y, mirrored frames too.
        e1 = x - (z + v) * (a / (1 + s))
        e1 = dr.normalize(e1 - v * dr.dot(e1, v))
        e2 = dr.cross(v, e1)
        e2 = dr.mulsign(e2, dr.dot(e2, y - (z + v) * (b / (1 + s))))

        inv_s = dr.rcp(s)
        p, q = ((dr.dot(e, x), dr.dot(e, y), dr.dot(e, z) * inv_s) for e in (e1, e2))
        bend = 1 - lam * a * a - mu * b * b  # ∇f·v

        def slope(p):
            return dr.select(front, p[2] - lam * a * p[0] - mu * b * p[1], 0)

        def hessian(p, q, bend):
            return dr.select(front, -p[2] * q[2] - lam * p[0] * q[0] - mu * p[1] * q[1] - bend, 0)

        return TangentDerivatives(
            e1, e2, slope(p), slope(q), hessian(p, p, bend), hessian(p, q, 0), hessian(q, q, bend)
        )

    def log_gradient(self, v):
        """Tangential gradient of ln G at v, 1/rad (v · gradient = 0); 0 where v·z <= 0.

        This is g/G of paper step 2, with its misprint (G·r)r read as (∇G·r)r.
        """
        t = self.tangent_derivatives(v)
        return mi.Vector3f(t.e1 * t.g1 + t.e2 * t.g2)

    def log_second_derivative(self, v, d):
        """Second derivative of ln G at v along the geodesic that leaves v in the unit tangent
        direction d, 1/rad²; 0 where v·z <= 0."""
        # Not from the Hessian's entries: near the horizon they cancel in the term (d·z)²/s².
        a, b, s = self._local(v)
        dx, dy, dz = self._local(d)
        radial = dz * dr.rcp(dr.maximum(s, S_MIN))
        bend = 1 - 2 * self.lam * a * a - 2 * self.mu * b * b
        second = -radial * radial - 2 * self.lam * dx * dx - 2 * self.mu * dy * dy - bend
        return dr.select(s > 0, second, 0)

    def integral(self):
        """∫ amplitude · G dω over the sphere, relative error below 1e-5.

        In coordinates (a, b) = (v·x, v·y) the solid angle is da db / s, so that the factor s of G
        cancels and the integral is that of exp(−λa² − μb²) over the unit disc. One direction is
        integrated in closed form, the other by quadrature:
        ∫ exp(−p sin²φ) √(π/q) erf(√q cos φ) cos φ dφ, p = min(λ, μ), q = max(λ, μ).
        """
        p, q = dr.minimum(self.lam, self.mu), dr.maximum(self.lam, self.mu)
        return self.amplitude * _disc_integral(p, q)

    def sample(self, u2):
        """Draw directions v from the lobe: (v, pdf), pdf in 1/sr. u2: uniform in [0, 1)².

        An angle φ is drawn uniformly, then a radius ρ with density ∝ ρ exp(−ρ²) so far that
        a = ρ cos φ/√λ, b = ρ sin φ/√μ stays in the unit disc. For bandwidths above 20, and for
        λ = μ, this is the exact distribution G / ∫G; else the truncation depends on φ. Bandwidths
        below 1 are raised towards the other one, which keeps G / pdf within a factor of e.
        """
        u2 = mi.Point2f(u2)
        lam, mu = self._positive_bandwidths()
        sin_phi, cos_phi = dr.sincos(dr.two_pi * u2.y)
        a1, b1 = cos_phi * dr.rsqrt(lam), sin_phi * dr.rsqrt(mu)  # at ρ = 1
        rho2_max = dr.rcp(a1 * a1 + b1 * b1)
        # Invert (1 − exp(−ρ²)) / (1 − exp(−ρ²max)) = u.
        rho = dr.sqrt(dr.minimum(-_log1p(-u2.x * _one_minus_exp(rho2_max)), rho2_max))
        a, b = rho * a1, rho * b1
        s = dr.safe_sqrt(1 - a * a - b * b)
        return self.x * a + self.y * b + self.z * s, self._pdf(a, b, s, lam, mu)

    def pdf(self, v):
        """Density of ``sample`` at v, 1/sr: √(λμ)/π · G(v) / (1 − exp(−ρ²max(v)))."""
        a, b, s = self._local(v)
        return self._pdf(a, b, s, *self._positive_bandwidths())

    def _positive_bandwidths(self):
        lam = dr.maximum(self.lam, dr.minimum(self.mu, 1))
        mu = dr.maximum(self.mu, dr.minimum(self.lam, 1))
        return dr.maximum(lam, 1e-6), dr.maximum(mu, 1e-6)

    @staticmethod
    def _pdf(a, b, s, lam, mu):
        rho2 = lam * a * a + mu * b * b
        r2 = a * a + b * b
        # At the centre ρ²max depends on the direction of approach; any value between serves.
        rho2_max = dr.select(r2 > 1e-30, rho2 / r2, dr.maximum(lam, mu))
        # √λ·√μ rather than √(λμ): the product leaves the single-precision range first.
        norm = dr.sqrt(lam) * dr.sqrt(mu) * dr.inv_pi / _one_minus_exp(rho2_max)
        return dr.select(s > 0, norm * s * dr.exp(-rho2), 0)

    def convolve_sg(self, nu) -> ASG:
        """Convolution with the spherical Gaussian exp(2ν (v·p − 1)), as an ASG of this frame.

        That SG is exp(−ν |v − p|²): in the flat limit a Gaussian of variance 1/(2ν) an axis, and
        variances add: 1/λ' = 1/λ + 1/ν. The amplitude keeps the product of the flat integrals:
        π/√(λμ) · π/ν = π/√(λ'μ') · A  ⇒  A = π / √((λ + ν)(μ + ν))   [XSD*13, Eq. 8]. ν > 0.
        """
        nu = mi.Float(nu)
        amplitude = dr.pi * dr.rsqrt(self.lam + nu) * dr.rsqrt(self.mu + nu)
        lam, mu = self.lam / (1 + self.lam / nu), self.mu / (1 + self.mu / nu)
        return ASG(self.x, self.y, self.z, lam, mu, self.amplitude * amplitude)


def product(a: ASG, b: ASG) -> ASG:
    """Product of two ASGs as one ASG: exact in the exponent   [XSD*13, Sec. 4.2].

    The exponent −vᵀ(A + B)v with A = λ x xᵀ + μ y yᵀ is a quadratic form; its smallest eigenvalue
    κ has the new lobe direction z as eigenvector, and because |v| = 1 the form splits exactly into
    κ + λ' (v·x')² + μ' (v·y')². The smooth terms max(v·z_a, 0) max(v·z_b, 0) are replaced by
    their value at the new centre times max(v·z, 0), as in the paper.
    """
    # Scaled to trace 1: eigenvalues of bandwidths up to 1e10 stay in single-precision range.
    scale = dr.maximum(a.lam + a.mu + b.lam + b.mu, dr.smallest(mi.Float))
    m = [[mi.Float(0)] * 3 for _ in range(3)]
    for axis, weight in ((a.x, a.lam), (a.y, a.mu), (b.x, b.lam), (b.y, b.mu)):
        for i in range(3):
            for j in range(3):
                m[i][j] = m[i][j] + weight / scale * axis[i] * axis[j]
    values, vectors = _symmetric_eigen(m)

    # The smallest eigenvalue is the lobe; its eigenvector is turned to the two lobes' side.
    middle = a.z + b.z
    order_z, z = values[0], vectors[0]
    lam, x, mu, y = values[1], vectors[1], values[2], vectors[2]
    for k in (1, 2):
        smaller = values[k] < order_z
        if k == 1:
            lam, x = dr.select(smaller, order_z, lam), dr.select(smaller, z, x)
        else:
            mu, y = dr.select(smaller, order_z, mu), dr.select(smaller, z, y)
        order_z, z = dr.select(smaller, values[k], order_z), dr.select(smaller, vectors[k], z)
    z = dr.normalize(dr.mulsign(z, dr.dot(z, middle)))
    x = dr.normalize(x - z * dr.dot(x, z))
    y = dr.cross(z, x)

    smooth = dr.maximum(dr.dot(z, a.z), 0) * dr.maximum(dr.dot(z, b.z), 0)
    # What the exponents say at the new centre, from accurate dot products (κ itself is a
    # difference of large numbers).
    kappa = sum(
        w * accurate_dot(z, axis) ** 2
        for axis, w in ((a.x, a.lam), (a.y, a.mu), (b.x, b.lam), (b.y, b.mu))
    )
    amplitude = a.amplitude * b.amplitude * smooth * dr.exp(-kappa)
    lam, mu = (dr.maximum(v - order_z, 0) * scale for v in (lam, mu))
    return ASG(x, y, z, lam, mu, amplitude)


def _symmetric_eigen(m, sweeps: int = 5):
    """Eigenvalues and eigenvectors of symmetric 3×3 matrices by cyclic Jacobi rotations.

    m: nested list of arrays. Five sweeps reach single precision for any input.
    """
    m = [row[:] for row in m]
    one, zero = dr.full(mi.Float, 1), mi.Float(0)
    v = [[one if i == j else zero for j in range(3)] for i in range(3)]
    for _ in range(sweeps):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            r = 3 - p - q
            apq = m[p][q]
            tau = (m[q][q] - m[p][p]) / (2 * apq)
            t = dr.select(
                apq != 0, dr.mulsign(mi.Float(1), tau) / (dr.abs(tau) + dr.sqrt(1 + tau * tau)), 0
            )
            t = dr.select(dr.isfinite(t), t, 0)
            c = dr.rsqrt(1 + t * t)
            s = t * c
            m[p][p], m[q][q] = m[p][p] - t * apq, m[q][q] + t * apq
            m[p][q] = m[q][p] = zero
            mrp, mrq = m[r][p], m[r][q]
            m[r][p] = m[p][r] = c * mrp - s * mrq
            m[r][q] = m[q][r] = s * mrp + c * mrq
            for k in range(3):
                vkp, vkq = v[k][p], v[k][q]
                v[k][p], v[k][q] = c * vkp - s * vkq, s * vkp + c * vkq
    return [m[i][i] for i in range(3)], [mi.Vector3f(v[0][i], v[1][i], v[2][i]) for i in range(3)]


def _one_minus_exp(t):
    """1 − exp(−t) for t >= 0 without cancellation (three terms of its series below 0.02)."""
    return dr.select(t < 0.02, t * (1 - t * (0.5 - t * (1 / 6))), 1 - dr.exp(-t))


def _log1p(t):
    """ln(1 + t) for −1 <= t <= 0 without cancellation (four terms of its series near 0)."""
    series = t * (1 - t * (0.5 - t * (1 / 3 - t * 0.25)))
    return dr.select(dr.abs(t) < 0.01, series, dr.log(1 + t))


def _disc_integral(p, q, nodes: int = 32):
    """∫ exp(−p a² − q b²) over the unit disc for 0 <= p <= q (see ASG.integral)."""
    # Closed form where the disc's edge is out of reach: exp(−16) < 2e-7.
    flat = dr.pi * dr.rsqrt(p) * dr.rsqrt(q)
    p_near = dr.minimum(p, 20)
    root_q = dr.sqrt(q)
    x, w = np.polynomial.legendre.leggauss(nodes)
    total = mi.Float(0)
    for xi, wi in zip(x[nodes // 2 :], w[nodes // 2 :], strict=True):  # even in φ: half the nodes
        phi = 0.5 * np.pi * xi
        cos_phi, sin_phi = float(np.cos(phi)), float(np.sin(phi))
        reach = root_q * cos_phi
        # √(π/q) erf(√q c) c, with the limit 2c² for small q.
        inner = dr.select(
            reach > 1e-3,
            dr.sqrt(dr.pi) * dr.erf(reach) / dr.maximum(root_q, 1e-12) * cos_phi,
            2 * cos_phi * cos_phi,
        )
        total += float(2 * wi * 0.5 * np.pi) * inner * dr.exp(-p_near * sin_phi**2)
    return dr.select(p > 16, flat, total)
