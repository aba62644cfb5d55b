"""Cases about density estimation: many photons, few, strong and weak ones, all in one place."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm import kernel
from aniso_pm.map import density, photon_word
from aniso_pm.map import index as spatial
from aniso_pm.map.gather_points import GatherPoints
from aniso_pm.map.photon_map import PhotonMap

from .case import Case, Measured, worst_of

# Asked for: sums that keep 1e-4 with a million photons in a kernel.
SUMS = 1e-4


def photon_map(position, power, emitted=1000) -> PhotonMap:
    """A map of photons at ``position`` (n, 3) of ``power`` (n) on surfaces that face +z."""
    count = len(position)
    word = photon_word.encode_normal(mi.Normal3f(0, 0, 1)) | (2 << 24)
    index, order = spatial.build(_points(position), dr.full(mi.UInt32, int(word[0]), count))
    wide = np.array(power, np.float32)[order.numpy()]
    width = 1 if dr.size_v(mi.Spectrum) == 1 else 4
    return PhotonMap(emitted, count, 0, index, mi.Float(np.repeat(wide, width)), None, None)


def gather_points(position) -> GatherPoints:
    count = len(position)
    return GatherPoints(
        lane=dr.arange(mi.UInt32, count),
        p=_points(position),
        n=mi.Normal3f(0, 0, 1),
        weight=mi.Spectrum(1),
        depth=dr.full(mi.UInt32, 1, count),
        path=None,
        origin=None,
        d=None,
        lambertian=None,
        caustic=None,
    )


def _points(a):
    return mi.Point3f(*np.array(a, np.float32).reshape(-1, 3).T.copy())


def estimate(map_, at, radius):
    """(irradiance, photons in the disc) at the points ``at`` (n, 3) for discs of ``radius``."""
    radius = dr.opaque(mi.Float, radius)
    disc = kernel.disc(mi.Normal3f(0, 0, 1), radius)
    points = gather_points(at)
    active = dr.full(mi.Bool, True, len(at))
    value, count = density.estimate(map_, points, disc, radius, 0, active)
    return np.array(value[0], np.float64), np.array(count)


def exact(position, power, at, radius, emitted=1000) -> np.ndarray:
    """The same sum in double precision, photon by photon."""
    position, power = (np.float32(a).astype(np.float64) for a in (position, power))
    radius = float(np.float32(radius))
    result = []
    for p in np.float32(at).astype(np.float64):
        d = position - p
        rho2 = (d[:, 0] ** 2 + d[:, 1] ** 2) / radius**2
        inside = (rho2 <= density.CUT2) & (np.abs(d[:, 2]) <= density.SLAB * radius)
        total = np.sum(np.where(inside, np.exp(-rho2), 0) * power)
        result.append(total / (np.pi * radius**2 * (1 - np.exp(-4)) * emitted))
    return np.array(result)


def _off_the_rim(position, at, radius):
    """Without the photons that rounding may put on either side of a kernel's rim."""
    keep = np.ones(len(position), bool)
    for p in at:
        d = np.float32(position).astype(float)[:, :2] - np.float32(p)[:2]
        keep &= np.abs(np.sum(d * d, 1) / radius**2 - density.CUT2) > 1e-3
    return keep


def _compare(position, power, at, radius) -> Measured:
    found, _ = estimate(photon_map(position, power), at, radius)
    wanted = exact(position, power, at, radius)
    return Measured(*worst_of(np.abs(found / wanted - 1), [f"point {i}" for i in range(len(at))]))


def _at_the_point(count) -> Measured:
    position = np.tile([[0.3, -0.7, 0.1]], (count, 1))
    return _compare(position, np.full(count, 0.1), position[:1], 0.05)


def _one_kernel(count, powers) -> Measured:
    """All photons in one kernel: equal powers make every rounding go the same way."""
    rng = np.random.default_rng(1)
    position = np.zeros((count, 3))
    position[:, :2] = rng.uniform(-0.9, 0.9, (count, 2))
    power = np.full(count, 0.1) if powers == "equal" else 10 ** rng.uniform(-6, 6, count)
    return _compare(position, power, np.zeros((1, 3)), 1.0)


def _powers_apart() -> Measured:
    """41 heaps of 200 photons, of 1e-20 W to 1e20 W: each is summed as if it were alone."""
    rng = np.random.default_rng(2)
    at = np.zeros((41, 3))
    at[:, 0] = np.arange(41)
    position = np.repeat(at, 200, 0)
    position[:, :2] += rng.uniform(-0.1, 0.1, (len(position), 2))
    power = np.repeat(10.0 ** np.arange(-20, 21), 200)
    return _compare(position, power, at, 0.1)


def _powers_together() -> Measured:
    """The same powers mixed in one kernel."""
    rng = np.random.default_rng(3)
    position = np.zeros((4100, 3))
    position[:, :2] = rng.uniform(-0.1, 0.1, (4100, 2))
    return _compare(position, np.repeat(10.0 ** np.arange(-20, 21), 100), position[:5], 0.2)


def _far_from_the_origin(offset) -> Measured:
    """Photons on a plane at ``offset``: their rounded positions are what counts."""
    rng = np.random.default_rng(4)
    position = np.zeros((20_000, 3)) + offset
    position[:, :2] += rng.uniform(-1, 1, (20_000, 2))
    at = position[:50]
    keep = _off_the_rim(position, at, 0.1)
    return _compare(position[keep], rng.uniform(0.5, 1.5, keep.sum()), at, 0.1)


def _thirty_million() -> Measured:
    """3e7 photons: built, sorted and summed without loss (about 3 GB)."""
    count = 30_000_000
    rng = np.random.default_rng(5)
    position = np.zeros((count, 3), np.float32)
    position[:, :2] = rng.random((count, 2), np.float32)
    power = rng.random(count, np.float32)
    at = position[:4].astype(float)
    radius = 0.003  # 3,400 photons
    map_ = photon_map(position, power)
    found, number = estimate(map_, at, radius)
    errors = []
    for p, value in zip(at, found, strict=True):
        near = np.abs(position[:, 0] - p[0]) < 0.01
        wanted = exact(position[near], power[near], p[None], radius)[0]
        errors.append(abs(value / wanted - 1))
    if not 2500 < number.mean() < 4500:
        errors.append(float("nan"))
    return Measured(*worst_of(errors, [f"point {i}" for i in range(len(errors))]))


def _visits(position, at, radius) -> float:
    """Photons tested per photon found, by discs in the plane z = 0."""
    index, _ = spatial.build(_points(position), dr.zeros(mi.UInt32, len(position)))
    radius = dr.opaque(mi.Float, radius)
    disc = kernel.disc(mi.Normal3f(0, 0, 1), radius)
    ellipses = spatial.Ellipses.from_axes(
        _points(at), disc.s, disc.t, mi.Normal3f(0, 0, 1), density.SLAB * radius
    )

    def visit(total, slot, word, d, rho2, inside):
        return total[0] + 1, total[1] + dr.select(inside, mi.UInt32(1), 0)

    tested, found = spatial.gather(
        index,
        ellipses,
        density.CUT2,
        visit,
        (mi.UInt32(0), mi.UInt32(0)),
        dr.full(mi.Bool, True, len(at)),
    )
    return float(np.array(tested, float).sum() / np.array(found, float).sum())


def _coin_in_a_stadium() -> Measured:
    """100,000 photons on a coin of 2 cm in a stadium of 200 m: the keys must tell them apart.

    Photons tested per photon found, over the same number for the coin alone."""
    rng = np.random.default_rng(6)
    coin = np.zeros((100_000, 3))
    coin[:, :2] = rng.uniform(-0.01, 0.01, (100_000, 2))
    stadium = np.zeros((100_000, 3))
    stadium[:, :2] = rng.uniform(-100, 100, (100_000, 2))
    at, radius = coin[:500], 0.0001
    alone = _visits(coin, at, radius)
    together = _visits(np.concatenate([coin, stadium]), at, radius)
    return Measured(together / alone, f"{together:.1f} tested per photon found, alone {alone:.1f}")


def cases() -> list[Case]:
    group, relative = "density estimation", "irradiance, relative"
    return [
        Case(
            group,
            "one photon, exactly at the gather point",
            relative,
            SUMS,
            partial(_at_the_point, 1),
        ),
        Case(group, "1,000 coincident photons", relative, SUMS, partial(_at_the_point, 1000)),
        Case(group, "1e6 coincident photons", relative, SUMS, partial(_at_the_point, 1_000_000)),
        Case(
            group,
            "1e6 equal photons in a kernel",
            relative,
            SUMS,
            partial(_one_kernel, 1_000_000, "equal"),
        ),
        Case(
            group,
            "1e6 photons of 1e-6 to 1e6 W in a kernel",
            relative,
            SUMS,
            partial(_one_kernel, 1_000_000, "spread"),
        ),
        Case(group, "heaps of 1e-20 to 1e20 W in a map", relative, SUMS, _powers_apart),
        Case(group, "1e-20 to 1e20 W in a kernel", relative, SUMS, _powers_together),
        Case(
            group, "photons 1e3 from the origin", relative, SUMS, partial(_far_from_the_origin, 1e3)
        ),
        Case(
            group, "photons 1e6 from the origin", relative, SUMS, partial(_far_from_the_origin, 1e6)
        ),
        Case(group, "3e7 photons", relative, SUMS, _thirty_million, slow=True),
        Case(
            group,
            "a coin in a stadium",
            "photons tested, over those of the coin alone",
            1.5,
            _coin_in_a_stadium,
        ),
    ]
