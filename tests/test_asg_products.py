"""Convolution and product of ASGs; the references are in reference.py."""

from __future__ import annotations

# isort: split
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.asg import ASG, product
from reference import arr, asg, dot, f32, flt, vec


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


# --- Convolution ---------------------------------------------------------------------------------


def convolution(lobe, nu, p):
    """∫ G(v) exp(2ν(v·p − 1)) dω by the trapezoidal rule in (v·x, v·y), p one direction."""
    a, b = (np.linspace(-1, 1, 401) * min(0.999, 7 / np.sqrt(2 * k)) for k in (lobe.lam, lobe.mu))
    step = (a[1] - a[0]) * (b[1] - b[0])
    a, b = np.meshgrid(a, b)
    s = np.sqrt(np.maximum(1 - a * a - b * b, 0))
    # G dω = exp(...) da db; v·p − 1 = −|v − p|²/2 without cancellation.
    distance2 = (a - p[0]) ** 2 + (b - p[1]) ** 2 + (s - p[2]) ** 2
    value = np.exp(-lobe.lam * a * a - lobe.mu * b * b - nu * distance2)
    return np.sum(value[a * a + b * b < 1]) * step


@pytest.mark.parametrize(
    "lam, mu, nu",
    [(100, 400, 200), (1e3, 1e3, 200), (5e3, 300, 2e3), (1e5, 1e4, 3e4), (1e6, 3e4, 1e3)],
)
def test_convolution_with_a_spherical_gaussian_agrees_with_quadrature(lam, mu, nu):
    lobe = ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], lam, mu)
    wide = lobe.convolve_sg(nu)
    low = min(wide.lam[0], wide.mu[0])
    peak = wide.eval(mi.Vector3f(0, 0, 1))[0]
    for sigmas_x, sigmas_y in ((0, 0), (1, 0), (0, 1), (1, 1), (-1.5, 0.5)):
        a, b = sigmas_x / np.sqrt(2 * wide.lam[0]), sigmas_y / np.sqrt(2 * wide.mu[0])
        p = np.array([a, b, np.sqrt(1 - a * a - b * b)])
        expected = convolution(ref.SimpleNamespace(lam=lam, mu=mu), nu, p)
        # The flat approximation drops terms of relative order 1/λ' (curvature of the sphere): at
        # most 2/λ' of the peak here. A wrong factor or bandwidth would be of order 1.
        assert abs(wide.eval(vec(f32(p)))[0] - expected) < (2 / low + 1e-5) * peak


def test_convolution_adds_variances_and_multiplies_integrals():
    rng = np.random.default_rng(21)
    lobe = ref.random_lobes(rng, 10_000, 30, 1e6)
    lobe.amplitude = f32(rng.uniform(0.5, 2, 10_000))
    nu = f32(np.exp(rng.uniform(np.log(30), np.log(1e6), 10_000)))
    wide = asg(lobe).convolve_sg(flt(nu))
    # A few roundings.
    np.testing.assert_allclose(1 / arr(wide.lam), 1 / lobe.lam + 1 / nu, rtol=1e-6)
    np.testing.assert_allclose(1 / arr(wide.mu), 1 / lobe.mu + 1 / nu, rtol=1e-6)
    # ∫ exp(2ν(v·p − 1)) dω = π(1 − e^(−4ν))/ν. Where λ' >= 15 both integrals are the flat ones up
    # to exp(−15) < 4e-7.
    mass = np.pi / nu * -np.expm1(-4 * nu)
    np.testing.assert_allclose(arr(wide.integral()), arr(asg(lobe).integral()) * mass, rtol=3e-5)
    np.testing.assert_array_equal(arr(wide.z), lobe.z)


# --- Product -------------------------------------------------------------------------------------


def exponent(lobe, v):
    return lobe.lam * dot(v, lobe.x) ** 2 + lobe.mu * dot(v, lobe.y) ** 2


def from_asg(lobe, n):
    """The module's result as reference lobes."""
    wide = {k: np.broadcast_to(arr(getattr(lobe, k)), (n, 3)) for k in "xyz"}
    lam, mu, amplitude = (np.broadcast_to(arr(a), n) for a in (lobe.lam, lobe.mu, lobe.amplitude))
    return ref.SimpleNamespace(**wide, lam=lam, mu=mu, amplitude=amplitude)


def pair_of_lobes(rng, n, low, high):
    a = ref.random_lobes(rng, n, low, high)
    b = ref.random_lobes(rng, n, low, high)
    side = np.sign(dot(a.z, b.z))[:, None]  # on one side of the sphere, where the product is not 0
    b.z, b.y = b.z * side, b.y * side
    return a, b


def test_product_is_exact_in_the_exponent_over_the_whole_sphere():
    rng = np.random.default_rng(22)
    n = 5000
    a, b = pair_of_lobes(rng, n, 0.1, 1e6)
    c = from_asg(product(asg(a), asg(b)), n)
    largest = np.maximum.reduce([a.lam, a.mu, b.lam, b.mu])
    values = []
    for _ in range(20):
        v = ref.unit(rng.normal(size=(n, 3)))
        values.append(exponent(a, v) + exponent(b, v) - exponent(c, v))
    spread = np.ptp(values, axis=0)
    # Quadratic forms rounded to single precision: a few 1e-7 of the largest bandwidth.
    assert np.max(spread / largest) < 1e-5


def test_product_matches_the_eigenvectors_in_double_precision():
    rng = np.random.default_rng(23)
    n = 5000
    a, b = pair_of_lobes(rng, n, 10, 1e3)
    c = from_asg(product(asg(a), asg(b)), n)
    form = sum(
        w[:, None, None] * axis[:, :, None] * axis[:, None, :]
        for w, axis in ((a.lam, a.x), (a.mu, a.y), (b.lam, b.x), (b.mu, b.y))
    )
    values, q = np.linalg.eigh(form)
    z = q[:, :, 0] * np.sign(dot(q[:, :, 0], a.z + b.z))[:, None]
    gap = values[:, 1] - values[:, 0]
    clear = gap > 0.02 * values[:, 2]  # an eigenvector is known to 1e-7/gap only
    assert clear.mean() > 0.5
    assert np.max(np.linalg.norm(c.z - z, axis=-1)[clear]) < 1e-4
    found = np.sort(np.stack([c.lam, c.mu], -1), axis=-1)
    wanted = values[:, 1:] - values[:, :1]
    assert np.max(np.abs(found - wanted) / values[:, 2:]) < 3e-6  # roundings of the form
    smooth = np.maximum(dot(z, a.z), 0) * np.maximum(dot(z, b.z), 0)
    amplitude = smooth * np.exp(-values[:, 0])
    # The exponent κ (up to several hundred) is evaluated at a centre known to 1e-4, where the form
    # has its minimum: 1e-8·1e3. What counts is an amplitude of some size.
    seen = clear & (amplitude > 1e-20)
    assert seen.sum() > 100
    np.testing.assert_allclose(c.amplitude[seen], amplitude[seen], rtol=5e-3, atol=1e-6)


def test_product_has_a_right_handed_orthonormal_frame():
    rng = np.random.default_rng(24)
    a, b = pair_of_lobes(rng, 20_000, 1e-2, 1e8)
    c = from_asg(product(asg(a), asg(b)), 20_000)
    for axis in (c.x, c.y, c.z):
        assert np.max(np.abs(np.linalg.norm(axis, axis=-1) - 1)) < 1e-6  # roundings
    assert np.max(np.linalg.norm(np.cross(c.x, c.y) - c.z, axis=-1)) < 2e-6
    assert np.all(np.minimum(c.lam, c.mu) >= 0)
    assert np.all(np.isfinite(c.amplitude))
    assert np.all(dot(c.z, a.z + b.z) > -1e-6)


def test_product_does_not_depend_on_the_order_of_its_factors():
    rng = np.random.default_rng(25)
    n = 5000
    a, b = pair_of_lobes(rng, n, 1, 1e4)
    ab, ba = (from_asg(product(p, q), n) for p, q in ((asg(a), asg(b)), (asg(b), asg(a))))
    largest = np.maximum.reduce([a.lam, a.mu, b.lam, b.mu])
    v = ref.unit(rng.normal(size=(n, 3)))
    # Same form, other roundings.
    assert np.max(np.abs(exponent(ab, v) - exponent(ba, v)) / largest) < 1e-5
    np.testing.assert_allclose(ab.amplitude, ba.amplitude, rtol=5e-3, atol=1e-6)


def test_product_is_the_pointwise_product_near_its_centre():
    rng = np.random.default_rng(26)
    n = 3000
    a = ref.random_lobes(rng, n, 50, 1e5)
    a.amplitude = f32(rng.uniform(0.5, 2, n))
    b = ref.random_lobes(rng, n, 50, 1e5)
    # A second lobe about one of its neighbours' standard deviations away.
    b.z = ref.directions(rng, a, rng.uniform(0, 1.5, n))
    b.x = f32(ref.unit(np.cross(b.z, rng.normal(size=(n, 3)))))
    b.y = f32(np.cross(b.z, b.x))
    ab = product(asg(a), asg(b))
    c = from_asg(ab, n)
    v = ref.directions(rng, c, rng.uniform(0, 1, n))
    log_product = ref.log_g(a, v) + ref.log_g(b, v) + np.log(a.amplitude)
    # The smooth factor cos·cos is frozen at the centre but for one cosine: first order in the
    # distance from it, |Δln| <= tan(angle between the lobes)·Δ + Δ²/2.
    distance = np.linalg.norm(v - c.z, axis=-1)
    tilt = np.maximum(*(np.linalg.norm(w - c.z, axis=-1) for w in (a.z, b.z)))
    tolerance = 4 * distance * tilt + 2 * distance**2
    # Rounding: 1e-6·√bandwidth in a, b times 2·(a√λ)... : 1e5 · 1e-7 · σ.
    tolerance += 1e-3
    assert np.all(np.abs(arr(ab.log_eval(vec(v))) - log_product) < tolerance)


def test_product_is_centred_between_two_equal_isotropic_lobes():
    angle = 0.2
    z = np.array([[-np.sin(angle), 0, np.cos(angle)], [np.sin(angle), 0, np.cos(angle)]])
    a, b = (ASG([w[2], 0, -w[0]], [0, 1, 0], [w[0], 0, w[2]], 100, 100) for w in z.tolist())
    c = product(a, b)
    np.testing.assert_allclose(arr(c.z)[0], [0, 0, 1], atol=1e-6)
    # Form 100(2I − z zᵀ − z' z'ᵀ): eigenvalues 200 sin², 200 cos², 200.
    np.testing.assert_allclose(
        sorted([c.lam[0], c.mu[0]]), [200 * np.cos(2 * angle), 200 * np.cos(angle) ** 2], rtol=1e-5
    )
    expected = np.cos(angle) ** 2 * np.exp(-200 * np.sin(angle) ** 2)
    assert abs(c.amplitude[0] / expected - 1) < 1e-5


@pytest.mark.parametrize(
    "axes_a, axes_b",
    [((500, 20), (500, 20)), ((500, 20), (20, 500)), ((80, 80), (500, 20)), ((80, 80), (80, 80))],
)
def test_product_of_lobes_in_one_frame_adds_bandwidths(axes_a, axes_b):
    rng = np.random.default_rng(27)
    frame = ref.random_frames(rng, 1)
    a, b = (ref.lobes(*frame, lam, mu, 2.0) for lam, mu in (axes_a, axes_b))
    c = from_asg(product(asg(a), asg(b)), 1)
    np.testing.assert_allclose(c.z, a.z, atol=1e-6)
    assert abs(c.amplitude[0] / 4 - 1) < 1e-5
    total = (axes_a[0] + axes_b[0]) * a.x[0, :, None] * a.x[0]
    total += (axes_a[1] + axes_b[1]) * a.y[0, :, None] * a.y[0]
    found = c.lam[0] * c.x[0, :, None] * c.x[0] + c.mu[0] * c.y[0, :, None] * c.y[0]
    np.testing.assert_allclose(found, total, atol=1e-6 * total.max() * 5)  # roundings


def test_product_of_opposite_lobes_is_zero():
    a = ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], 50, 5)
    b = ASG([1, 0, 0], [0, -1, 0], [0, 0, -1], 50, 5)
    c = product(a, b)
    assert c.amplitude[0] == 0
    assert np.all(np.isfinite([*arr(c.x)[0], *arr(c.y)[0], *arr(c.z)[0], c.lam[0], c.mu[0]]))
