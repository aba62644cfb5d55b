"""What the modules should compute, written a second time from the formulas in double precision
(numpy, whole arrays).

All inputs are float64 arrays whose values are float32 numbers: the references see what the modules
see, so that a difference is the module's and not the rounding of its inputs.
"""

from __future__ import annotations

from types import SimpleNamespace

import aniso_pm  # before drjit and mitsuba: it chooses their LLVM

# isort: split
import numpy as np

# Conversions, and the references in 50 digits, are those of `aniso-pm stability`.
from aniso_pm.instruments.stability.lanes import arr, f32, flt, unit, vec  # noqa: F401
from aniso_pm.instruments.stability.reference import (  # noqa: F401
    floats,
    mp_cross,
    mp_dot,
    mp_geodesic_differences,
    mp_log_g,
    mp_taylor_axes,
    mp_unit,
    mp_vec,
)

# --- Between numpy, Dr.Jit and mpmath ------------------------------------------------------------


def dot(a, b):
    return np.sum(a * b, axis=-1)


# --- Random lobes and directions -----------------------------------------------------------------


def random_frames(rng, n):
    """n right-handed orthonormal frames (x, y, z), rounded."""
    z = unit(rng.normal(size=(n, 3)))
    x = rng.normal(size=(n, 3))
    x = unit(x - z * dot(x, z)[:, None])
    return f32(x), f32(np.cross(z, x)), f32(z)


def lobes(x, y, z, lam, mu, amplitude=1.0):
    n = len(x)
    lam, mu, amplitude = (f32(np.broadcast_to(a, n)) for a in (lam, mu, amplitude))
    return SimpleNamespace(x=x, y=y, z=z, lam=lam, mu=mu, amplitude=amplitude)


def random_lobes(rng, n, low=1.0, high=1e6):
    """n lobes, each bandwidth log-uniform in [low, high]."""
    lam, mu = np.exp(rng.uniform(np.log(low), np.log(high), (2, n)))
    return lobes(*random_frames(rng, n), lam, mu)


def asg(lobe):
    """The reference's lobes as the module's."""
    return aniso_pm.asg.ASG(
        vec(lobe.x), vec(lobe.y), vec(lobe.z), flt(lobe.lam), flt(lobe.mu), flt(lobe.amplitude)
    )


def one(lobe, i):
    return SimpleNamespace(**{k: v[i : i + 1] for k, v in vars(lobe).items()})


def from_local(lobe, a, b):
    """Unit directions with v·x = a, v·y = b on the lobe's side, rounded."""
    s = np.sqrt(np.maximum(1 - a * a - b * b, 0))
    return f32(unit(lobe.x * a[:, None] + lobe.y * b[:, None] + lobe.z * s[:, None]))


def directions(rng, lobe, sigmas, edge=0.97):
    """Directions `sigmas` standard deviations (1/√2λ, 1/√2μ) from the lobe's centre, in random
    directions, held at v·z > √(1 − edge²)."""
    phi = rng.uniform(0, 2 * np.pi, len(lobe.lam))
    a = sigmas * np.cos(phi) / np.sqrt(2 * lobe.lam)
    b = sigmas * np.sin(phi) / np.sqrt(2 * lobe.mu)
    shrink = edge / np.maximum(np.hypot(a, b), edge)
    return from_local(lobe, a * shrink, b * shrink)


def tangents(rng, v):
    """A random unit tangent at each v, rounded."""
    d = rng.normal(size=v.shape)
    v = unit(v)
    return f32(unit(d - v * dot(d, v)[:, None]))


# --- ln G and its derivatives in double precision ------------------------------------------------


def log_g(lobe, v):
    """ln G at unit v (amplitude left out)."""
    a, b, s = dot(v, lobe.x), dot(v, lobe.y), dot(v, lobe.z)
    return np.log(s) - lobe.lam * a * a - lobe.mu * b * b


def log_gradient(lobe, v):
    v = unit(v)
    a, b, s = (dot(v, axis)[:, None] for axis in (lobe.x, lobe.y, lobe.z))
    g = lobe.z / s - 2 * lobe.lam[:, None] * a * lobe.x - 2 * lobe.mu[:, None] * b * lobe.y
    return g - v * dot(g, v)[:, None]


def log_hessian(lobe, v, d, e):
    """Bilinear form of the geodesic second derivative of ln G, tangents d and e."""
    v = unit(v)
    a, b, s = (dot(v, axis) for axis in (lobe.x, lobe.y, lobe.z))
    along = dot(d, lobe.z) * dot(e, lobe.z) / s**2
    along += 2 * lobe.lam * dot(d, lobe.x) * dot(e, lobe.x)
    along += 2 * lobe.mu * dot(d, lobe.y) * dot(e, lobe.y)
    return -along - dot(d, e) * (1 - 2 * lobe.lam * a * a - 2 * lobe.mu * b * b)


def log_second_derivative(lobe, v, d):
    v = unit(v)
    d = unit(d - v * dot(d, v)[:, None])
    return log_hessian(lobe, v, d, d)


# --- The kernel axes in double precision ---------------------------------------------------------


def tangent_basis(v):
    """An orthonormal basis of the tangent plane at each v (any)."""
    helper = np.where(np.abs(v[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    e = unit(np.cross(v, helper))
    return e, np.cross(unit(v), e)


def taylor_axes(lobe, r, epsilon):
    """The rule "taylor" of design.md, section 1: eigenvectors of g gᵀ/ε² + |H|/(2ε), lengths
    l(d) = 2ε/(|g·d| + √((g·d)² + 2ε|κ(d)|)). Returns u, v and the |κ| along v."""
    r = unit(r)
    e, f = tangent_basis(r)
    g = log_gradient(lobe, r)
    g = np.stack([dot(g, e), dot(g, f)], -1)
    h = np.empty((len(r), 2, 2))
    h[:, 0, 0], h[:, 1, 1] = log_hessian(lobe, r, e, e), log_hessian(lobe, r, f, f)
    h[:, 0, 1] = h[:, 1, 0] = log_hessian(lobe, r, e, f)
    values, q = np.linalg.eigh(h)
    positive = np.einsum("nij,nj,nkj->nik", q, np.abs(values), q)
    _, q = np.linalg.eigh(g[:, :, None] * g[:, None, :] / epsilon**2 + positive / (2 * epsilon))

    def axis(d):
        slope = np.abs(dot(g, d))
        curvature = np.abs(np.einsum("ni,nij,nj->n", d, h, d) + slope**2)
        length = 2 * epsilon / (slope + np.sqrt(slope**2 + 2 * epsilon * curvature))
        return (e * d[:, :1] + f * d[:, 1:]) * length[:, None], curvature

    (u, curvature_u), (v, curvature_v) = axis(q[:, :, 1]), axis(q[:, :, 0])
    return u, v, curvature_u, curvature_v


def paper_axes(lobe, r, epsilon):
    """The rule "paper", as printed: l_u = ε/|g|, l_v = 2ε/|(∂²G/∂v²)/G|."""
    r = unit(r)
    g = log_gradient(lobe, r)
    norm = np.linalg.norm(g, axis=-1, keepdims=True)
    v_d = np.cross(r, g / norm)
    curvature = np.abs(log_hessian(lobe, r, v_d, v_d))  # g·v_d = 0
    return epsilon * g / norm**2, v_d * (2 * epsilon / curvature)[:, None], curvature


def lobe_axes(lobe, r, epsilon):
    """The rule "lobe": √(ε/λ), √(ε/μ) along x, y turned by the smallest rotation z → r."""
    r = unit(r)
    axis = np.cross(lobe.z, r)  # Rodrigues
    cosine = dot(lobe.z, r)[:, None]

    def turn(w):
        return w * cosine + np.cross(axis, w) + axis * dot(axis, w)[:, None] / (1 + cosine)

    return (
        turn(lobe.x) * np.sqrt(epsilon / lobe.lam)[:, None],
        turn(lobe.y) * np.sqrt(epsilon / lobe.mu)[:, None],
    )


def ellipse(u, v, e, f):
    """u uᵀ + v vᵀ in the basis (e, f): (n, 2, 2)."""
    w = np.stack([np.stack([dot(u, e), dot(v, e)], -1), np.stack([dot(u, f), dot(v, f)], -1)], -2)
    return w @ np.swapaxes(w, -1, -2)


def relative_difference(m, reference):
    """Largest |m − reference| along any direction, relative to `reference` in that direction:
    the spectral norm of R^(−1/2) (m − R) R^(−1/2). Sees the short axis as well as the long one."""
    values, q = np.linalg.eigh(reference)
    whiten = q / np.sqrt(values)[..., None, :]
    difference = np.swapaxes(whiten, -1, -2) @ (m - reference) @ whiten
    return np.abs(np.linalg.eigvalsh(0.5 * (difference + np.swapaxes(difference, -1, -2)))).max(-1)
