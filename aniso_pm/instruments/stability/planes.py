"""Cases about planes: projection, the integrator's kernel, its mass and its coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import mitsuba as mi
import numpy as np
from aniso_pm import kernel
from aniso_pm.map import density
from aniso_pm.map.index import Ellipses

from . import reference as ref
from .case import Case, Measured, worst_of
from .lanes import (
    arr,
    asg,
    ellipse_error,
    f32,
    flt,
    lobes,
    off_by_sigmas,
    roughnesses,
    unit,
    vec,
    words,
)

EPSILON = 0.02
# |r·n| below which the region "clamp" begins.
COS_MIN = 1e-3


@dataclass(frozen=True)
class Situation:
    """A plane seen along r, as the integrator meets it.

    cosine, distance  r·n and |p1 − p0| (world units).
    radius            bandwidth in units of the footprint √(τ² |u×v| / |r·n|) of a lobe of α 0.1.
    alphas, aspects   of the lobes (see ``lanes.roughnesses``).
    """

    cosine: float = 0.5
    distance: float = 3.0
    radius: float = 0.3
    alphas: tuple[float, ...] = (1e-3, 1e-2, 0.1, 0.3)
    aspects: tuple[float, ...] = (1.0, 1.5, 5.0)
    rule: str = "lobe"
    size: str = "bandwidth"
    guard: bool = True
    max_aspect: float = 32.0
    epsilon: float = EPSILON
    region: str | None = None


@dataclass(frozen=True)
class Lanes:
    lobe: object
    r: np.ndarray
    n: np.ndarray
    distance: np.ndarray
    radius: np.ndarray


def _lanes(situation: Situation) -> Lanes:
    lobe = lobes(roughnesses(situation.alphas, situation.aspects), seed=11)
    r = off_by_sigmas(lobe, 0.5, 1.1)
    count = len(r)
    # Normals at the wanted cosine, exactly rounded ones: n = c r + √(1 − c²) e, e ⟂ r.
    e = np.random.default_rng(12).normal(size=(count, 3))
    exact = unit(r)
    e = unit(e - exact * np.sum(e * exact, -1, keepdims=True))
    c = situation.cosine
    n = f32(unit(c * exact + np.sqrt(1 - c * c) * e))
    distance = np.full(count, f32(situation.distance))
    footprint = situation.distance * 0.1 / np.sqrt(max(abs(c), COS_MIN))
    return Lanes(lobe, r, n, distance, np.full(count, f32(situation.radius * footprint)))


def _kernel(s: Situation, lanes: Lanes):
    return kernel.guarded_axes(
        asg(lanes.lobe),
        vec(lanes.r),
        vec(lanes.n),
        flt(lanes.distance),
        flt(lanes.radius),
        s.epsilon,
        s.rule,
        s.guard,
        s.max_aspect,
        s.size,
    )


def _fallback(situation, found, count) -> float:
    """Share of lanes in which the situation's fallback acted; any, where none is to act."""
    clamped, capped = np.array(found.clamped), np.array(found.capped)
    acted = {"clamp": clamped, "cap": capped, None: clamped | capped}[situation.region]
    return float(np.broadcast_to(acted, count).mean())


def _shape(situation: Situation) -> Measured:
    """The integrator's kernel against its definition."""
    lanes = _lanes(situation)
    found = _kernel(situation, lanes)
    s, t = arr(found.s), arr(found.t)
    errors = []
    for i in range(len(s)):
        wanted, _, _ = ref.mp_kernel(
            lanes.lobe,
            i,
            lanes.r[i],
            lanes.n[i],
            lanes.distance[i],
            lanes.radius[i],
            situation.epsilon,
            situation.rule,
            situation.guard,
            situation.max_aspect,
            situation.size,
            COS_MIN,
        )
        errors.append(ellipse_error([s[i], t[i]], wanted))
    return Measured(*worst_of(errors, words(lanes.lobe)), _fallback(situation, found, len(s)))


def quadrature(nodes: int = 24, angles: int = 48):
    """Nodes (a, b) and weights for ∫ f(a, b) da db over a² + b² <= 2.5², in polar coordinates,
    Gauss–Legendre on both sides of the rim a² + b² = 4."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    rho, weight = [], []
    for low, high in ((0.0, 2.0), (2.0, 2.5)):
        rho.append(low + (high - low) * (x + 1) / 2)
        weight.append(w * (high - low) / 2)
    rho, weight = np.concatenate(rho), np.concatenate(weight)
    phi = 2 * np.pi * (np.arange(angles) + 0.5) / angles
    a, b = np.outer(rho, np.cos(phi)).ravel(), np.outer(rho, np.sin(phi)).ravel()
    return a, b, np.repeat(weight * rho * 2 * np.pi / angles, angles)


def kernel_mass(s, t, n, radius) -> np.ndarray:
    """∫ of the normalised kernel over its plane, as the gather weighs photons.

    Σ w / (π |s| |t| (1 − e⁻⁴)) over quadrature nodes on the exact plane, each weighed by the
    library. s, t, n: (count, 3)."""
    a, b, weight = quadrature()
    count = len(a)
    n = unit(n)
    total = []
    for s_, t_, n_, radius_ in zip(s, t, n, radius, strict=True):
        on_plane = np.outer(a, s_) + np.outer(b, t_)
        on_plane -= np.outer(on_plane @ n_, n_)
        wide = lambda v: mi.Vector3f(*map(float, v))  # noqa: E731
        e = Ellipses.from_axes(
            mi.Point3f(0), wide(s_), wide(t_), wide(n_), density.SLAB * float(radius_)
        )
        d = vec(on_plane)
        rho2 = (arr(mi.Float(mi.Vector3f(e.a).x * d.x + e.a.y * d.y + e.a.z * d.z))) ** 2
        rho2 = rho2 + arr(e.b.x * d.x + e.b.y * d.y + e.b.z * d.z) ** 2
        thick = np.abs(arr(e.c.x * d.x + e.c.y * d.y + e.c.z * d.z)) <= 1
        w = np.where((rho2 <= density.CUT2) & thick, np.exp(-rho2), 0).reshape(count)
        jacobian = np.linalg.norm(np.cross(s_, t_))
        area = np.pi * np.linalg.norm(s_) * np.linalg.norm(t_)
        total.append(float(np.sum(w * weight)) * jacobian / (area * density.KERNEL_MASS))
    return np.array(total)


def _mass(situation: Situation) -> Measured:
    lanes = _lanes(situation)
    found = _kernel(situation, lanes)
    s, t = arr(found.s), arr(found.t)
    mass = kernel_mass(s, t, lanes.n, lanes.radius)
    return Measured(
        *worst_of(np.abs(mass - 1), words(lanes.lobe)), fallback=_fallback(situation, found, len(s))
    )


def _area(situation: Situation) -> Measured:
    """|s × t| = radius² with size="bandwidth", clamped, capped or not."""
    lanes = _lanes(situation)
    found = _kernel(situation, lanes)
    area = np.linalg.norm(np.cross(arr(found.s), arr(found.t)), axis=1)
    errors = np.abs(area / lanes.radius**2 - 1)
    return Measured(*worst_of(errors, words(lanes.lobe)), _fallback(situation, found, len(area)))


def _offsets(s, t):
    """Offsets d = a s + b t on a grid of (a, b) in [−1.4, 1.4]², rounded: (lanes, 25, 3)."""
    g = np.linspace(-1.4, 1.4, 5)
    a, b = (w.ravel() for w in np.meshgrid(g, g))
    return f32(a[:, None] * s[:, None, :] + b[:, None] * t[:, None, :])


def _coordinates(situation: Situation) -> Measured:
    """(a, b) of photons as the gather computes them, after all clamps, against the 3×3 system
    solved in 50 digits with the same s, t, n and offset; in units of max(1, aspect/|r·n|)."""
    lanes = _lanes(situation)
    found = _kernel(situation, lanes)
    s, t = arr(found.s), arr(found.t)
    e = Ellipses.from_axes(mi.Point3f(0), found.s, found.t, vec(lanes.n), 1.0)
    covectors = arr(e.a), arr(e.b)
    d = _offsets(s, t)
    cosine = np.abs(np.sum(unit(lanes.r) * unit(lanes.n), -1))
    errors = []
    for i in range(len(s)):
        aspect = np.linalg.norm(s[i]) / np.linalg.norm(t[i])
        wide = [mi.Vector3f(*map(float, c[i])) for c in covectors]
        a, b = (arr(c.x * p.x + c.y * p.y + c.z * p.z) for c in wide for p in (vec(d[i]),))
        sure = max(1.0, aspect / max(cosine[i], COS_MIN))
        errors.append(_against_solution(a, b, d[i], s[i], t[i], lanes.n[i]) / sure)
    return Measured(*worst_of(errors, words(lanes.lobe)), _fallback(situation, found, len(s)))


def _literal_coordinates(situation: Situation) -> Measured:
    """The public pair project_to_plane and coordinates, literal and unclamped, from rounded u, v;
    in units of max(1, aspect/|r·n|)."""
    lanes = _lanes(situation)
    u, v = (f32(arr(w)) for w in kernel.kernel_axes(asg(lanes.lobe), vec(lanes.r), EPSILON, "lobe"))
    s, t = kernel.project_to_plane(vec(u), vec(v), vec(lanes.r), vec(lanes.n), flt(lanes.distance))
    d = _offsets(arr(s), arr(t))
    cosine = np.abs(np.sum(unit(lanes.r) * unit(lanes.n), -1))
    errors = []
    for i in range(len(u)):
        pick = lambda w: mi.Vector3f(*(float(c) for c in arr(w)[i]))  # noqa: E731, B023
        n = mi.Vector3f(*map(float, lanes.n[i]))
        a, b = (arr(w) for w in kernel.coordinates(vec(d[i]), pick(s), pick(t), n))
        lengths = np.linalg.norm(u[i]), np.linalg.norm(v[i])
        sure = max(1.0, max(lengths) / min(lengths) / cosine[i])
        errors.append(_against_solution(a, b, d[i], arr(s)[i], arr(t)[i], lanes.n[i]) / sure)
    return Measured(*worst_of(errors, words(lanes.lobe)))


def _against_solution(a, b, d, s, t, n) -> float:
    s, t = ref.mp_vec(s), ref.mp_vec(t)
    worst = 0.0
    for i in range(0, len(d), 4):
        exact = ref.mp_coordinates(ref.mp_vec(d[i]), s, t, n)
        error = max(abs(float(a[i]) - float(exact[0])), abs(float(b[i]) - float(exact[1])))
        worst = error if error != error else max(worst, error)
    return worst


def _literal_projection(situation: Situation) -> Measured:
    """project_to_plane against the literal formula, relative, in units of max(1, 1/|r·n|)²: the
    rounding of n alone changes r·n by 1e-7."""
    lanes = _lanes(situation)
    u, v = (f32(arr(w)) for w in kernel.kernel_axes(asg(lanes.lobe), vec(lanes.r), EPSILON, "lobe"))
    s, t = kernel.project_to_plane(vec(u), vec(v), vec(lanes.r), vec(lanes.n), flt(lanes.distance))
    errors = []
    for i in range(len(u)):
        exact = ref.mp_project(
            ref.mp_vec(u[i]), ref.mp_vec(v[i]), lanes.r[i], lanes.n[i], lanes.distance[i]
        )
        wanted = [ref.floats(w) for w in exact]
        errors.append(
            max(
                np.linalg.norm(arr(f)[i] - w) / np.linalg.norm(w)
                for f, w in zip((s, t), wanted, strict=True)
            )
            / max(1.0, 1 / abs(situation.cosine))
        )
    return Measured(*worst_of(errors, words(lanes.lobe)))


_GRAZING = dict(radius=3.0)  # a disc's share large enough that the cap stays out of it
SITUATIONS = {
    "r·n = 1": Situation(cosine=1.0),
    "r·n = 0.5": Situation(cosine=0.5),
    "r·n = 0.01": Situation(cosine=0.01, **_GRAZING),
    "r·n = 1.1e-3, just above the clamp": Situation(cosine=1.1e-3, radius=30.0),
    "r·n = 1e-4": Situation(cosine=1e-4, region="clamp", **_GRAZING),
    "r·n = 1e-6": Situation(cosine=1e-6, region="clamp", **_GRAZING),
    "r·n = 0": Situation(cosine=0.0, region="clamp", **_GRAZING),
    "r·n = −0.5": Situation(cosine=-0.5),
    "r·n = −1e-6": Situation(cosine=-1e-6, region="clamp", **_GRAZING),
    "distance 1e-6": Situation(distance=1e-6),
    "distance 1e6": Situation(distance=1e6),
    "bandwidth 1e-6 of the footprint, lobes round": Situation(radius=1e-6, aspects=(1.0, 1.5, 5.0)),
    "bandwidth 1e4 times the footprint": Situation(radius=1e4),
    "aspect 1e3 and 1e4 below a wide kernel": Situation(
        radius=30.0, alphas=(1e-4, 1e-3), aspects=(1e3, 1e4)
    ),
    "aspect 1e3 and 1e4, cap active": Situation(
        radius=1e-3, alphas=(1e-4, 1e-3), aspects=(1e3, 1e4), region="cap"
    ),
    "aspect 30, cap at 1e4 inactive": Situation(
        radius=1e-3, cosine=0.9, aspects=(30.0,), alphas=(1e-3, 1e-2), max_aspect=1e4
    ),
    "degenerate parallelogram: aspect 1e4 at r·n = 2e-3": Situation(
        radius=1e-4, cosine=2e-3, alphas=(1e-4,), aspects=(1e4,), region="cap"
    ),
    "cap 1: every kernel round": Situation(max_aspect=1.0, aspects=(2.0, 5.0), region="cap"),
    "taylor with guard": Situation(rule="taylor"),
    "taylor without guard": Situation(rule="taylor", guard=False, max_aspect=1e4),
    "paper with guard": Situation(rule="paper"),
    "paper, literal size": Situation(
        rule="paper", size="epsilon", guard=False, max_aspect=1e4, aspects=(1.0, 1.5)
    ),
    "taylor, literal size cut by the guard": Situation(
        rule="taylor", size="epsilon", max_aspect=1e4, epsilon=10.0
    ),
}


def cases() -> list[Case]:
    found = []
    quantities: list[tuple[str, float, Callable]] = [
        ("kernel ellipse, relative", 1e-3, _shape),
        ("kernel mass − 1", 1e-3, _mass),
        ("coordinates over max(1, aspect/|r·n|)", 1e-6, _coordinates),
    ]
    for name, situation in SITUATIONS.items():
        for quantity, target, measure in quantities:
            found.append(
                Case(
                    "projection",
                    name,
                    quantity,
                    target,
                    partial(measure, situation),
                    situation.region,
                )
            )
        if situation.region and situation.size == "bandwidth":
            found.append(
                Case(
                    "projection",
                    name,
                    "area over radius², − 1",
                    1e-4,
                    partial(_area, situation),
                    situation.region,
                )
            )
    for cosine in (1.0, 0.1, 0.01, 1e-3, 1e-6, -0.5):
        situation = Situation(cosine=cosine)
        name = f"literal formulas, r·n = {cosine:g}"
        found += [
            Case(
                "projection",
                name,
                "s and t, relative, over max(1, 1/|r·n|)",
                1e-6,
                partial(_literal_projection, situation),
            ),
            Case(
                "projection",
                name,
                "coordinates over max(1, aspect/|r·n|)",
                1e-6,
                partial(_literal_coordinates, situation),
            ),
        ]
    return found
