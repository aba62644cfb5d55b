"""The kernel that the integrator takes: guarded, capped, in the plane, scaled to an area."""

from __future__ import annotations

# isort: split
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.kernel import RULES, coordinates, disc, guarded_axes, kernel_axes, project_to_plane
from reference import arr, asg, dot, f32, flt, unit, vec

EPSILON = float(np.float32(0.02))


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def lengths(*vectors):
    return [np.linalg.norm(w, axis=-1) for w in vectors]


def basis(n):
    return ref.tangent_basis(unit(n))


def plane_ellipse(u, v, r, n, distance):
    """s sᵀ + t tᵀ of the literal projection in a basis of the plane, double precision."""
    s, t = (distance[:, None] * (w - (dot(w, n) / dot(r, n))[:, None] * r) for w in (u, v))
    return ref.ellipse(s, t, *basis(n))


def lobe_in_plane(lobe, r, n, distance):
    """Twice the covariance of the lobe's footprint."""
    return plane_ellipse(*ref.lobe_axes(lobe, r, 1.0), unit(r), unit(n), distance)


def rule_in_plane(lobe, r, n, distance, rule):
    r = unit(r)
    functions = {"taylor": ref.taylor_axes, "paper": ref.paper_axes, "lobe": ref.lobe_axes}
    u, v, *_ = functions[rule](lobe, r, EPSILON)
    return plane_ellipse(u, v, r, unit(n), distance)


def largest_inside(inner, outer):
    """c·inner with the largest c that leaves outer − c·inner positive semidefinite."""
    values, q = np.linalg.eigh(outer)
    whiten = q / np.sqrt(values)[:, None, :]
    biggest = np.linalg.eigvalsh(np.swapaxes(whiten, 1, 2) @ inner @ whiten)[:, 1]
    return inner / biggest[:, None, None]


def situations(seed, n=5000, low=5, high=2000, grazing=0.15):
    rng = np.random.default_rng(seed)
    lobe = ref.random_lobes(rng, n, low, high)
    r = ref.directions(rng, lobe, rng.uniform(0.2, 2.5, n))
    e, f = ref.tangent_basis(unit(r))
    cosine = rng.uniform(grazing, 1, (n, 1)) * rng.choice([-1, 1], (n, 1))
    phi = rng.uniform(0, 2 * np.pi, (n, 1))
    normal = cosine * r + np.sqrt(1 - cosine**2) * (np.cos(phi) * e + np.sin(phi) * f)
    return lobe, r, f32(unit(normal)), f32(np.exp(rng.uniform(-1, 1, n)))


def guarded(lobe, r, n, distance, radius, rule, **options):
    radius = flt(np.broadcast_to(radius, len(r)))
    return guarded_axes(asg(lobe), vec(r), vec(n), flt(distance), radius, EPSILON, rule, **options)


def area_scaled(m, radius):
    return m * (radius**2 / np.sqrt(np.linalg.det(m)))[:, None, None]


def well_conditioned(lobe, r, rule):
    """Lanes whose κ is far enough from 0 for the rule's ellipse to be known to 1e-4."""
    if rule == "lobe":
        return np.ones(len(r), bool)
    curvature_v = (ref.taylor_axes if rule == "taylor" else ref.paper_axes)(lobe, r, EPSILON)[-1]
    return curvature_v > 0.05 * (lobe.lam + lobe.mu)


@pytest.mark.parametrize("guard", [True, False])
@pytest.mark.parametrize("rule", RULES)
def test_guarded_kernel_has_orthogonal_axes_in_the_plane_and_the_area_of_the_disc(rule, guard):
    lobe, r, n, distance = situations(12, grazing=1e-4)
    radius = f32(np.exp(np.random.default_rng(12).uniform(-5, 1, len(r))))
    kernel = guarded(lobe, r, n, distance, radius, rule, guard=guard)
    s, t = arr(kernel.s), arr(kernel.t)
    length_s, length_t = lengths(s, t)
    assert np.all(length_s >= length_t * (1 - 1e-6))
    assert np.max(np.abs(dot(unit(s), unit(t)))) < 1e-6  # roundings
    assert np.max(np.abs(dot(unit(s), n))) < 1e-6
    assert np.max(np.abs(dot(unit(t), n))) < 1e-6
    np.testing.assert_allclose(length_s * length_t, radius**2, rtol=2e-6)
    assert np.max(length_s / length_t) < 32 * (1 + 1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_guarded_kernel_is_the_fitted_rule_ellipse_plus_the_disc(rule):
    lobe, r, n, distance = situations(13)
    rng = np.random.default_rng(13)
    footprint = lobe_in_plane(lobe, r, n, distance)
    radius = f32(np.linalg.det(footprint) ** 0.25 * np.exp(rng.uniform(-2, 2, len(r))))
    fitted = largest_inside(rule_in_plane(lobe, r, n, distance, rule), footprint)
    # The guard's claim about its own first step.
    gap = np.linalg.eigvalsh(footprint - fitted)[:, 0] / np.linalg.eigvalsh(footprint)[:, 1]
    assert np.max(np.abs(gap)) < 1e-9
    wanted = area_scaled(fitted + radius[:, None, None] ** 2 * np.eye(2), radius)
    kernel = guarded(lobe, r, n, distance, radius, rule, max_aspect=1e3)
    found = ref.ellipse(arr(kernel.s), arr(kernel.t), *basis(n))
    sure = well_conditioned(lobe, r, rule)
    assert np.mean(sure) > 0.3
    # The disc keeps the sum well-conditioned: aspect of the sum at most ~50, roundings of its
    # square 2500·3e-7.
    assert np.max(ref.relative_difference(found, wanted)[sure]) < 2e-3


@pytest.mark.parametrize("rule", RULES)
def test_guarded_kernel_never_reaches_beyond_footprint_plus_disc(rule):
    lobe, r, n, distance = situations(14)
    rng = np.random.default_rng(14)
    footprint = lobe_in_plane(lobe, r, n, distance)
    radius = f32(np.linalg.det(footprint) ** 0.25 * np.exp(rng.uniform(-3, 3, len(r))))
    kernel = guarded(lobe, r, n, distance, radius, rule, max_aspect=1e3)
    found = ref.ellipse(arr(kernel.s), arr(kernel.t), *basis(n))
    bound = footprint + radius[:, None, None] ** 2 * np.eye(2)
    room = np.linalg.eigvalsh(bound - found)[:, 0] / np.linalg.eigvalsh(bound)[:, 1]
    assert np.min(room) > -1e-5  # roundings


@pytest.mark.parametrize("rule", RULES)
def test_guarded_kernel_becomes_a_disc_where_the_footprint_is_small(rule):
    lobe, r, n, distance = situations(15)
    # Largest half axis of the footprint = radius/100: Σ deviates from the disc by 1e-4.
    large = np.sqrt(np.linalg.eigvalsh(lobe_in_plane(lobe, r, n, distance))[:, 1])
    kernel = guarded(lobe, r, n, distance, f32(100 * large), rule)
    length_s, length_t = lengths(arr(kernel.s), arr(kernel.t))
    assert np.max(length_s / length_t - 1) < 1.5e-4


def test_guarded_lobe_kernel_takes_the_footprints_shape_where_it_is_large():
    lobe, r, n, distance = situations(16)
    footprint = lobe_in_plane(lobe, r, n, distance)
    small = np.sqrt(np.linalg.eigvalsh(footprint)[:, 0])
    radius = f32(small / 300)
    kernel = guarded(lobe, r, n, distance, radius, "lobe", max_aspect=1e3)
    found = ref.ellipse(arr(kernel.s), arr(kernel.t), *basis(n))
    # Deviation (radius/small)² = 1e-5 in the short direction, and roundings times aspect² (the
    # short axis is an eigenvalue's difference).
    squared_aspect = np.linalg.cond(footprint)
    error = ref.relative_difference(found, area_scaled(footprint, radius))
    assert np.max(error / (3e-5 + 1e-6 * squared_aspect)) < 1


@pytest.mark.parametrize("rule", RULES)
def test_unguarded_kernel_has_the_literal_shape(rule):
    lobe, r, n, distance = situations(17, grazing=0.3)
    wanted = rule_in_plane(lobe, r, n, distance, rule)
    literal = guarded(lobe, r, n, distance, 1.0, rule, guard=False, size="epsilon", max_aspect=1e4)
    scaled = guarded(lobe, r, n, distance, 0.1, rule, guard=False, max_aspect=1e4)
    tolerance = 1e-3 + 2e-6 * np.linalg.cond(wanted)  # roundings times aspect²
    sure = well_conditioned(lobe, r, rule) & (tolerance < 0.05)
    assert np.mean(sure) > 0.3
    found = ref.ellipse(arr(literal.s), arr(literal.t), *basis(n))
    assert np.max((ref.relative_difference(found, wanted) / tolerance)[sure]) < 1
    found = ref.ellipse(arr(scaled.s), arr(scaled.t), *basis(n))
    wanted = area_scaled(wanted, np.full(len(r), 0.1))
    assert np.max((ref.relative_difference(found, wanted) / tolerance)[sure]) < 1


@pytest.mark.parametrize("rule", ["taylor", "paper"])
def test_guard_cuts_a_literal_size_and_never_enlarges_it(rule):
    lobe, r, n, distance = situations(18, grazing=0.3)
    literal = rule_in_plane(lobe, r, n, distance, rule)
    fitted = largest_inside(literal, lobe_in_plane(lobe, r, n, distance))
    share = np.minimum(np.sqrt(np.linalg.det(fitted) / np.linalg.det(literal)), 1)
    wanted = literal * share[:, None, None]
    kernel = guarded(lobe, r, n, distance, 1.0, rule, size="epsilon", max_aspect=1e4)
    found = ref.ellipse(arr(kernel.s), arr(kernel.t), *basis(n))
    tolerance = 1e-3 + 2e-6 * np.linalg.cond(wanted)
    sure = well_conditioned(lobe, r, rule) & (tolerance < 0.05)
    assert np.mean(sure) > 0.3
    assert np.max((ref.relative_difference(found, wanted) / tolerance)[sure]) < 1


def test_aspect_cap_shortens_the_long_axis_keeps_the_area_and_says_so():
    lobe, r, n, distance = situations(19)
    free = guarded(lobe, r, n, distance, 1e-4, "lobe", max_aspect=1e3)
    capped = guarded(lobe, r, n, distance, 1e-4, "lobe", max_aspect=4)
    aspect, held = (np.divide(*lengths(arr(kernel.s), arr(kernel.t))) for kernel in (free, capped))
    assert np.mean(aspect > 4) > 0.2
    np.testing.assert_allclose(held, np.minimum(aspect, 4), rtol=1e-3)
    clear = np.abs(aspect / 4 - 1) > 1e-3
    np.testing.assert_array_equal(np.array(capped.capped)[clear], (aspect > 4)[clear])
    np.testing.assert_allclose(
        np.linalg.norm(np.cross(arr(capped.s), arr(capped.t)), axis=-1), 1e-8, rtol=1e-5
    )
    parallel = np.abs(dot(unit(arr(free.s)), unit(arr(capped.s))))
    assert np.min(parallel[aspect > 1.1]) > 1 - 1e-4  # the direction stays


@pytest.mark.parametrize("size", ["bandwidth", "epsilon"])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("guard", [True, False])
def test_guarded_kernel_is_finite_for_edge_on_planes_and_degenerate_lobes(rule, guard, size):
    rng = np.random.default_rng(20)
    count = 3000
    lobe = ref.random_lobes(rng, count, 1e-3, 1e8)
    lobe.mu[:500] = lobe.lam[:500]
    lobe.lam[500:510] = lobe.mu[505:515] = 0
    r = f32(unit(rng.normal(size=(count, 3))))
    r[::3] = lobe.z[::3]
    r[1::9] = -lobe.z[1::9]
    e, f = ref.tangent_basis(unit(r))
    n = f32(e)  # edge-on up to rounding
    n[::2] = f32(unit(e + 10.0 ** rng.uniform(-9, 0, (count, 1)) * r))[::2]
    n[:4], r[:4] = [0, 0, 1], [1, 0, 0]  # edge-on exactly
    distance = f32(10.0 ** rng.uniform(-4, 4, count))
    radius = f32(10.0 ** rng.uniform(-5, 1, count))
    kernel = guarded(lobe, r, n, distance, radius, rule, guard=guard, size=size)
    s, t = arr(kernel.s), arr(kernel.t)
    assert np.all(np.isfinite(s)) and np.all(np.isfinite(t))
    assert np.all(np.linalg.norm(t, axis=-1) > 0)
    assert np.all(np.array(kernel.clamped)[:4])
    assert np.max(np.divide(*lengths(s, t))) < 32 * (1 + 1e-5)


def test_disc_is_a_circle_in_the_plane():
    rng = np.random.default_rng(21)
    n = f32(unit(rng.normal(size=(1000, 3))))
    radius = f32(rng.uniform(0.1, 2, 1000))
    kernel = disc(vec(n), flt(radius))
    for w in (arr(kernel.s), arr(kernel.t)):
        np.testing.assert_allclose(np.linalg.norm(w, axis=-1), radius, rtol=5e-7)
        assert np.max(np.abs(dot(w, n))) < 1e-6
    np.testing.assert_allclose(dot(arr(kernel.s), arr(kernel.t)), 0, atol=2e-6)


def test_kernel_weight_integrates_to_one_over_the_plane():
    # World-space quadrature over the plane of w = exp(−a² − b²), cut at a² + b² = 4, divided by
    # π|s × t|(1 − e^(−4)), for a guarded kernel and for a sheared literal one.
    lobe, r, n, distance = situations(22, 1)
    kernel = guarded(lobe, r, n, distance, 0.3, "lobe")
    literal = project_to_plane(
        *kernel_axes(asg(lobe), vec(r), EPSILON, "paper"), vec(r), vec(n), flt(distance)
    )
    e, f = basis(n)
    for s, t in ((arr(kernel.s), arr(kernel.t)), tuple(map(arr, literal))):
        # Bounding box of the cut ellipse in (e, f), 1500² midpoints.
        half = [2.0 * np.hypot(dot(s, axis), dot(t, axis))[0] for axis in (e, f)]
        p, q = (h * (2 * (np.arange(1500) + 0.5) / 1500 - 1) for h in half)
        p, q = (w.reshape(-1, 1) for w in np.meshgrid(p, q))
        a, b = (arr(w) for w in coordinates(vec(p * e + q * f), vec(s), vec(t), vec(n)))
        m = a * a + b * b
        mass = np.sum(np.where(m <= 4, np.exp(-m), 0)) * 4 * half[0] * half[1] / 1500**2
        mass /= np.pi * np.linalg.norm(np.cross(s, t)) * (1 - np.exp(-4))
        # The jump e^(−4) at the rim is resolved to 1/1500 of the box; cells average out.
        assert abs(mass - 1) < 3e-4
        # And its covariance before the cut is (s sᵀ + t tᵀ)/2; the cut makes
        # ∫a²w/∫w = (1 − 5e^(−4))/(2(1 − e^(−4))) of the ½.
        w = np.where(m <= 4, np.exp(-m), 0)
        expected = 0.5 * (1 - 5 * np.exp(-4)) / (1 - np.exp(-4))
        assert abs(np.sum(a * a * w) / np.sum(w) - expected) < 1e-3
        assert abs(np.sum(a * b * w) / np.sum(w)) < 1e-3
