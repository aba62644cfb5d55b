"""Sums over whole nodes against sums over photons."""

import dataclasses
import math

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import kernel
from aniso_pm.map import density, photon_word, summed
from aniso_pm.map import index as spatial
from aniso_pm.map.gather_points import GatherPoints
from aniso_pm.map.photon_map import PhotonMap

COUNT, POINTS = 40_000, 200


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def scattered(rng, colours="any", normals=None):
    """A map of photons on the unit square of z = 0."""
    position = np.column_stack([rng.random((COUNT, 2)), np.zeros(COUNT)])
    if normals is None:
        normals = np.tile([0.0, 0, 1], (COUNT, 1))
    segments = rng.integers(2, 6, COUNT)
    word = photon_word.encode_normal(vectors(normals)) | (mi.UInt32(segments) << 24)
    word |= mi.UInt32((position[:, 0] > 0.5).astype(np.uint32)) << 31
    index, order = spatial.build(mi.Point3f(vectors(position)), word)
    flux = rng.random((COUNT, 3)) ** 3
    if colours == "apart":  # every photon has one colour
        flux = np.eye(3)[rng.integers(0, 3, COUNT)]
    packed = np.zeros((COUNT, 4))
    packed[:, :3] = flux
    packed = packed[order.numpy()].astype(np.float32)
    map_ = PhotonMap(1000, COUNT, 0, index, mi.Float(packed.ravel()), None, None)
    return dataclasses.replace(map_, sums=summed.build(map_))


def vectors(a):
    return mi.Vector3f(np.ascontiguousarray(np.asarray(a, np.float32).T))


def gather_points(rng, caustic=None):
    at = np.column_stack([rng.random((POINTS, 2)), np.zeros(POINTS)])
    return GatherPoints(
        lane=dr.arange(mi.UInt32, POINTS),
        p=mi.Point3f(vectors(at)),
        n=mi.Normal3f(0, 0, 1),
        weight=mi.Spectrum(1),
        depth=dr.full(mi.UInt32, 1, POINTS),
        path=None,
        origin=None,
        d=None,
        lambertian=None,
        caustic=caustic,
    )


def ellipse(radius, aspect, angle=0.4):
    c, d = math.cos(angle), math.sin(angle)
    s = mi.Vector3f(c, d, 0) * (radius * aspect**0.5)
    t = mi.Vector3f(-d, c, 0) * (radius / aspect**0.5)
    return kernel.PlaneKernel(s, t, mi.Bool(False), mi.Bool(False))


def estimates(map_, points, shape, radius, tolerance, max_depth=0):
    """(with sums, photon by photon, flux inside on the scale of the estimate), as arrays."""
    options = (shape, radius, max_depth, mi.Bool(True), None)
    fast, fast_count = density.estimate(map_, points, *options, tolerance)
    exact, count = density.estimate(dataclasses.replace(map_, sums=None), points, *options)
    # Nodes on the rim count as a whole or not at all.
    assert abs(fast_count.numpy().sum() / count.numpy().sum() - 1) < 0.01 + 0.1 * tolerance
    inside = photon_flux_inside(map_, points, shape, max_depth)
    area = np.pi * np.linalg.norm(np.cross(*(np.array(v)[:, 0] for v in (shape.s, shape.t))))
    return np.array(fast).T, np.array(exact).T, inside / (area * density.KERNEL_MASS * 1000)


def photon_flux_inside(map_, points, shape, max_depth):
    """Of the photons in a kernel and on its rim."""
    slots = map_.index.points.numpy().reshape(-1, 4)[:COUNT]
    flux = map_.flux.numpy().reshape(-1, 4)[:, :3].astype(float)
    word = slots[:, 3].copy().view(np.uint32)
    keep = np.ones(COUNT, bool) if not max_depth else ((word >> 24) & 127) + 1 <= max_depth
    if points.caustic is not None:
        keep &= (word >> 31) != 0
    s, t = (np.array(v)[:, 0].astype(float) for v in (shape.s, shape.t))
    found = []
    for centre in np.array(points.p).T.astype(float):
        d = slots[:, :3] - centre
        rho2 = (d @ s / (s @ s)) ** 2 + (d @ t / (t @ t)) ** 2
        found.append(flux[(rho2 <= (density.CUT2**0.5 + 0.3) ** 2) & keep].sum(0))
    return np.array(found)


@pytest.mark.parametrize("colours", ["any", "apart"])
@pytest.mark.parametrize("aspect", [1, 8])
@pytest.mark.parametrize("tolerance", [0.01, 0.1, 0.5])
def test_error_is_within_the_tolerance(tolerance, aspect, colours):
    rng = np.random.default_rng(1)
    map_, points = scattered(rng, colours), gather_points(rng)
    fast, exact, inside = estimates(map_, points, ellipse(0.1, aspect), 0.1, tolerance)
    error = np.abs(fast - exact)
    assert np.all(error <= tolerance * inside)
    # Nodes were taken, and what they cost is far below the bound.
    if tolerance >= 0.1:  # else none of the nodes is small enough for a thin ellipse
        assert error.max() > 1e-6 * exact.max()
    assert abs(fast.mean() / exact.mean() - 1) < 0.3 * tolerance


def test_no_tolerance_is_the_exact_sum():
    rng = np.random.default_rng(2)
    fast, exact, _ = estimates(scattered(rng), gather_points(rng), ellipse(0.1, 4), 0.1, 0.0)
    np.testing.assert_allclose(fast, exact, rtol=1e-5)


def test_depth_limits_and_caustics_are_kept():
    """Nodes with photons beyond the limit are opened."""
    rng = np.random.default_rng(3)
    map_ = scattered(rng)
    points = gather_points(rng, caustic=dr.full(mi.Bool, True, POINTS))
    for max_depth in (0, 5, 9):
        shape = ellipse(0.2, 2)
        fast, exact, inside = estimates(map_, points, shape, 0.2, 0.1, max_depth)
        assert np.all(np.abs(fast - exact) <= 0.1 * inside + 1e-6)


def test_normals_that_differ_keep_their_photons_apart():
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    map_, points = scattered(rng, normals=normals), gather_points(rng)
    shape = ellipse(0.1, 1)
    options = (shape, 0.1, 0, mi.Bool(True), None)
    fast, count = density.estimate(map_, points, *options, 0.5)
    exact, count_ = density.estimate(dataclasses.replace(map_, sums=None), points, *options)
    np.testing.assert_array_equal(count.numpy(), count_.numpy())
    np.testing.assert_allclose(np.array(fast), np.array(exact), rtol=1e-5)
