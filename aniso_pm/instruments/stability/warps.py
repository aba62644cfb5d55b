"""Cases about the warp: half-vector lobe → reflection lobe, at every view."""

from __future__ import annotations

from functools import partial

import numpy as np
from aniso_pm.warp import COS_MIN, warp_to_reflection

from . import reference as ref
from .case import Case, Measured, worst_of
from .lanes import arr, asg, ellipse_error, f32, largest_steps, lobes, roughnesses, unit, vec, words

WARP = 1e-3


def _view(theta, phi):
    """The direction at θ degrees from the normal, φ degrees from the tangent."""
    theta, phi = np.radians(theta), np.radians(phi)
    return np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)


_VIEWS = {
    "view at normal incidence": (0, 0, 1),
    "view 1e-7 rad off normal incidence": (1e-7, 0, 1),
    "view 1e-4 rad off normal incidence": (6e-5, 8e-5, 1),
    "view at 60°": _view(60, 40),
    "view at 60° along the tangent": (3**0.5 / 2, 0, 0.5),
    "view at 60° along the bitangent": (0, 3**0.5 / 2, 0.5),
    "view at 89.99°": _view(89.99, 40),
    "view at 89.99° along the tangent": (1, 0, 1.745e-4),
    "view at 89.99° along the bitangent": (0, 1, 1.745e-4),
}


def _warp(o) -> Measured:
    ndf = lobes(roughnesses(), local=True)
    o = np.broadcast_to(f32(unit(np.array(o, float))), ndf.x.shape)
    warped = warp_to_reflection(asg(ndf), vec(o))
    x, y, lam, mu = (arr(a) for a in (warped.x, warped.y, warped.lam, warped.mu))
    errors = []
    for i in range(len(lam)):
        axes, _ = ref.mp_warped_axes(ndf, i, o[i])
        errors.append(ellipse_error([x[i] / lam[i] ** 0.5, y[i] / mu[i] ** 0.5], axes))
    return Measured(*worst_of(errors, words(ndf)))


def _centres() -> Measured:
    """The mirror direction at every view: as good as a single-precision unit vector."""
    ndf = lobes(np.ones((len(_VIEWS), 2)), local=True)
    o = f32(unit(np.array(list(_VIEWS.values()), float)))
    found = arr(warp_to_reflection(asg(ndf), vec(o)).z)
    exact = [ref.floats(ref.mp_warped_axes(ndf, i, o[i])[1]) for i in range(len(o))]
    return Measured(*worst_of(np.linalg.norm(found - exact, axis=1), list(_VIEWS)))


def _warp_edge_on() -> Measured:
    """Views below the smallest cosine: finite, and the mass of the clamped angle."""
    ndf = lobes(roughnesses(), local=True)
    o = np.broadcast_to(f32(unit(np.array([1, 1, 1e-8]))), ndf.x.shape)
    warped = warp_to_reflection(asg(ndf), vec(o))
    # λ'μ' = λμ/(16 c²) with c = 1e-6.
    mass = np.sqrt(arr(warped.lam)) * np.sqrt(arr(warped.mu))
    wanted = np.sqrt(ndf.lam) * np.sqrt(ndf.mu) / 4e-6
    errors = np.abs(mass / wanted - 1)
    finite = np.isfinite(arr(warped.x)).all(1) & np.isfinite(arr(warped.y)).all(1)
    fallback = float(np.mean(unit(o)[:, 2] < COS_MIN))
    return Measured(*worst_of(np.where(finite, errors, np.nan), words(ndf)), fallback)


def _isotropic_warp() -> Measured:
    """λ = μ: the warped lobe does not depend on the tangent that the surface happens to have."""
    alpha = np.repeat(roughnesses(aspects=(1.0,)), 12, 0)
    ndf = lobes(alpha, local=True)
    rng = np.random.default_rng(4)
    o = rng.normal(size=ndf.z.shape)
    o[:, 2] = np.abs(o[:, 2]) + 1e-3
    o = f32(unit(o))
    angle = rng.uniform(0, 2 * np.pi, len(alpha))
    turned = lobes(alpha, local=True)
    turned.x = f32(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1))
    turned.y = f32(np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1))
    axes = []
    for lobe in (ndf, turned):
        warped = warp_to_reflection(asg(lobe), vec(o))
        scale = [1 / np.sqrt(arr(w))[:, None] for w in (warped.lam, warped.mu)]
        axes.append([arr(warped.x) * scale[0], arr(warped.y) * scale[1]])
    errors = [
        ellipse_error([w[i] for w in axes[1]], [w[i] for w in axes[0]]) for i in range(len(alpha))
    ]
    return Measured(*worst_of(errors, words(ndf)))


def _warp_continuity() -> Measured:
    """From normal incidence to 89°, through the take-over of the tangent at 1e-4 rad."""
    grazing = np.pi / 2 - np.geomspace(0.6, 0.017, 2000)
    theta = np.concatenate([np.geomspace(1e-6, 1e-3, 2000), np.linspace(1e-3, 0.97, 2000), grazing])
    ndf = lobes(np.repeat([(0.02, 0.3)], len(theta), 0), local=True)
    o = np.stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)], -1)
    warped = warp_to_reflection(asg(ndf), vec(o))
    axes = [
        arr(w) / np.sqrt(arr(b))[:, None]
        for w, b in ((warped.x, warped.lam), (warped.y, warped.mu))
    ]
    steps = largest_steps(*axes)
    return Measured(*worst_of(steps, [f"θ {t:.3g}" for t in theta]))


def cases() -> list[Case]:
    found = [
        Case("warp", name, "warped ellipse, relative", WARP, partial(_warp, o))
        for name, o in _VIEWS.items()
    ]
    found.append(
        Case(
            "warp",
            "view below 1e-6 rad of grazing",
            "mass, relative",
            WARP,
            _warp_edge_on,
            region="warp",
        )
    )
    found.append(
        Case(
            "warp",
            "isotropic roughness",
            "ellipse after turning the tangent, relative",
            WARP,
            _isotropic_warp,
        )
    )
    found.append(
        Case(
            "warp",
            "from normal incidence to 89°",
            "largest change between neighbours",
            0.05,
            _warp_continuity,
        )
    )
    found.append(Case("warp", "centre of the lobe at all these views", "rad", 1.5e-7, _centres))
    return found
