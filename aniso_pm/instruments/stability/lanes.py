"""Lobes and directions to measure at, as single-precision numbers kept in double precision."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
from aniso_pm.asg import ASG

# Roughness of the steeper axis and aspect of the other one; all pairs with alpha <= 1.
ALPHAS = (1e-4, 3e-4, 1e-3, 1e-2, 0.1, 0.3, 1.0)
ASPECTS = (1.0, 1.5, 30.0, 1e3, 1e4)


def f32(a):
    """Round to single precision, keep as double."""
    return np.asarray(a, np.float32).astype(np.float64)


def vec(a):
    """(n, 3) array → mi.Vector3f."""
    return mi.Vector3f(*np.asarray(a, np.float32).reshape(-1, 3).T.copy())


def flt(a):
    return mi.Float(np.asarray(a, np.float32).reshape(-1).copy())


def arr(a):
    """Dr.Jit array → float64 numpy array, vectors as (n, 3)."""
    a = np.array(a, np.float64)
    return a.T if a.ndim == 2 else a


def unit(a):
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def roughnesses(alphas=ALPHAS, aspects=ASPECTS):
    """(alpha_u, alpha_v) of all lanes; the short axis is u in one lane and v in the next."""
    pairs = [(a, a * k) for a in alphas for k in aspects if a * k <= 1]
    return np.array([pair[:: 1 if i % 2 else -1] for i, pair in enumerate(pairs)])


def lobes(alpha, seed=0, local=False):
    """Lobes of bandwidths 1/alpha² in random orthonormal frames (the first one in the axes of
    coordinates, or all of them if ``local``)."""
    n = len(alpha)
    rng = np.random.default_rng(seed)
    z = unit(rng.normal(size=(n, 3)))
    x = rng.normal(size=(n, 3))
    x = unit(x - z * np.sum(x * z, -1, keepdims=True))
    last = n if local else 1
    x[:last], z[:last] = [1, 0, 0], [0, 0, 1]
    x, z, y = f32(x), f32(z), f32(np.cross(z, x))
    lam, mu = f32(1 / f32(alpha[:, 0]) ** 2), f32(1 / f32(alpha[:, 1]) ** 2)
    return SimpleNamespace(x=x, y=y, z=z, lam=lam, mu=mu)


def asg(lobe) -> ASG:
    return ASG(vec(lobe.x), vec(lobe.y), vec(lobe.z), flt(lobe.lam), flt(lobe.mu))


def off_centre(lobe, a, b):
    """Directions with v·x = a, v·y = b in front of the lobe, rounded; held at v·z >= 0.2."""
    a, b = np.broadcast_to(a, lobe.lam.shape), np.broadcast_to(b, lobe.lam.shape)
    shrink = 0.98 / np.maximum(np.hypot(a, b), 0.98)
    a, b = (a * shrink)[:, None], (b * shrink)[:, None]
    s = np.sqrt(np.maximum(1 - a * a - b * b, 0))
    return f32(unit(lobe.x * a + lobe.y * b + lobe.z * s))


def off_by_sigmas(lobe, sigmas_x, sigmas_y):
    """Directions so many standard deviations 1/√(2λ), 1/√(2μ) from the centre."""
    return off_centre(lobe, sigmas_x / np.sqrt(2 * lobe.lam), sigmas_y / np.sqrt(2 * lobe.mu))


def at_height(lobe, height, seed=1):
    """Directions with v·z = height, at random azimuths (every third along x, y, −x)."""
    phi = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(lobe.lam))
    phi[1::4], phi[2::4], phi[3::4] = 0, np.pi / 2, np.pi
    flat = np.sqrt(1 - height * height)
    a, b = (flat * np.cos(phi))[:, None], (flat * np.sin(phi))[:, None]
    return f32(unit(lobe.x * a + lobe.y * b + lobe.z * height))


def words(lobe):
    """What a lane is called in the table."""
    return [f"λ {p:.3g}, μ {q:.3g}" for p, q in zip(lobe.lam, lobe.mu, strict=True)]


def ellipse_error(found, wanted) -> float:
    """Error of the ellipse with half axes ``found`` (two float vectors) against ``wanted`` (two
    orthogonal mpmath or float vectors).

    The largest relative error of a length in any direction: |σ − 1| for the singular values σ of
    the found half axes in coordinates in which the wanted ellipse is the unit circle; the short
    axis counts as much as the long one. A single-precision vector holds a direction to
    1e-7, by which the long axis of an ellipse of aspect A moves the short one by 1e-7·A: above an
    aspect of 1e4 the error is divided by A/1e4.
    """
    wanted = [np.array([float(c) for c in w]) for w in wanted]
    norms = [float(np.linalg.norm(w)) for w in wanted]
    inside = np.array([[f @ w / n**2 for w, n in zip(wanted, norms, strict=True)] for f in found])
    if not np.isfinite(inside).all():
        return float("nan")
    aspect = max(norms) / min(norms)
    stretch = np.linalg.svd(inside, compute_uv=False)
    return float(np.abs(stretch - 1).max()) / max(1.0, aspect / 1e4)


def largest_steps(u, v) -> np.ndarray:
    """Relative change of the ellipse from each lane to the next."""
    return np.array([ellipse_error([u[i + 1], v[i + 1]], [u[i], v[i]]) for i in range(len(u) - 1)])
