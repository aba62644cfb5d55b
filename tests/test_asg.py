"""Claims about aniso_pm.asg; the references are in reference.py."""

from __future__ import annotations

import aniso_pm  # before drjit and mitsuba: it chooses their LLVM

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.asg import ASG, product
from aniso_pm.instruments.stability.reference import mp, mpf
from reference import arr, asg, dot, f32, flt, vec
from scipy import integrate, special, stats


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def grid_of_lobes():
    """Bandwidths from 1 to 1e8 in both orders, a random frame each."""
    lam, mu = (a.ravel() for a in np.meshgrid(10.0 ** np.arange(0, 9), 10.0 ** np.arange(0, 9)))
    return ref.lobes(*ref.random_frames(np.random.default_rng(1), len(lam)), lam, mu)


# --- The double-precision reference itself -------------------------------------------------------


def test_reference_derivatives_agree_with_mpmath_geodesic_differences():
    rng = np.random.default_rng(2)
    lobe = ref.random_lobes(rng, 100, 1, 1e8)
    v = ref.directions(rng, lobe, rng.uniform(0, 12, 100))
    d = ref.tangents(rng, v)
    slope, curvature = dot(ref.log_gradient(lobe, v), d), ref.log_second_derivative(lobe, v, d)
    for i in range(100):
        size = np.sqrt(2 * max(lobe.lam[i], lobe.mu[i]))
        first, second = ref.mp_geodesic_differences(
            ref.mp_log_g(lobe, i), ref.mp_vec(v[i]), ref.mp_vec(d[i]), 1e-9 / size
        )
        # d is rounded and so off the tangent by 6e-8, which the difference removes and the product
        # g·d does not see (g is tangential); what remains is |d| = 1 ± 6e-8.
        assert abs(slope[i] - first) <= 2e-7 * max(np.abs(first), size)
        assert abs(curvature[i] - second) <= 1e-10 * max(abs(second), size**2)


# --- Value ---------------------------------------------------------------------------------------


def test_log_eval_agrees_with_mpmath_out_to_twelve_sigma_and_bandwidth_1e8():
    rng = np.random.default_rng(3)
    lobe = ref.random_lobes(rng, 300, 1, 1e8)
    lobe.amplitude = f32(rng.uniform(0.1, 1e4, 300))
    v = ref.directions(rng, lobe, rng.uniform(0, 12, 300))
    log_value, value = arr(asg(lobe).log_eval(vec(v))), arr(asg(lobe).eval(vec(v)))
    for i in range(300):
        # No normalisation of v here: this is a plain function of the given numbers.
        expected = ref.mp_log_g(lobe, i)(ref.mp_vec(v[i])) + mp.log(float(lobe.amplitude[i]))
        # |exponent| <= 72, and a few roundings of 6e-8 of its largest term.
        tolerance = 4e-7 * (10 + abs(float(expected)))
        assert abs(log_value[i] - expected) <= tolerance
        # exp turns the absolute error of the exponent into a relative one; below 1e-37 the number
        # is denormal or 0.
        assert abs(value[i] - mp.exp(expected)) <= tolerance * mp.exp(expected) + 1e-37


def test_value_is_zero_and_logarithm_minus_infinity_behind_the_lobe():
    rng = np.random.default_rng(4)
    lobe = ref.random_lobes(rng, 1000)
    v = -ref.directions(rng, lobe, rng.uniform(0, 6, 1000))
    assert np.all(arr(asg(lobe).eval(vec(v))) == 0)
    assert np.all(arr(asg(lobe).log_eval(vec(v))) == -np.inf)
    equator = ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], 5, 7)
    assert equator.eval(mi.Vector3f(1, 0, 0))[0] == 0
    assert equator.log_eval(mi.Vector3f(0, 1, 0))[0] == -np.inf


def test_amplitude_scales_the_value_and_nothing_else():
    rng = np.random.default_rng(5)
    lobe = ref.random_lobes(rng, 200, 1, 1e4)
    v = vec(ref.directions(rng, lobe, rng.uniform(0, 3, 200)))
    d = mi.Vector3f(vec(ref.tangents(rng, arr(v))))
    plain = asg(lobe)
    lobe.amplitude = np.full(200, 3.0)
    scaled = asg(lobe)
    # One rounding each.
    np.testing.assert_allclose(arr(scaled.eval(v)), 3 * arr(plain.eval(v)), rtol=3e-7)
    np.testing.assert_allclose(arr(scaled.integral()), 3 * arr(plain.integral()), rtol=3e-7)
    np.testing.assert_array_equal(arr(scaled.log_gradient(v)), arr(plain.log_gradient(v)))
    np.testing.assert_array_equal(arr(scaled.pdf(v)), arr(plain.pdf(v)))
    np.testing.assert_array_equal(
        arr(scaled.log_second_derivative(v, d)), arr(plain.log_second_derivative(v, d))
    )


# --- Derivatives ---------------------------------------------------------------------------------


def test_derivatives_agree_with_mpmath_geodesic_differences_up_to_bandwidth_1e8():
    lobe = grid_of_lobes()
    n = len(lobe.lam)
    rng = np.random.default_rng(6)
    for sigmas in (0.0, 0.01, 1.0, 6.0, 12.0):
        v = ref.directions(rng, lobe, np.full(n, sigmas))
        d = ref.tangents(rng, v)
        g = arr(asg(lobe).log_gradient(vec(v)))
        curvature = arr(asg(lobe).log_second_derivative(vec(v), vec(d)))
        for i in range(n):
            size = np.sqrt(2 * max(lobe.lam[i], lobe.mu[i]))
            first, second = ref.mp_geodesic_differences(
                ref.mp_log_g(lobe, i), ref.mp_vec(v[i]), ref.mp_vec(d[i]), 1e-9 / size
            )
            # Roundings of a, b, s and of the turned axes: measured 1e-6 and 2e-6 at most.
            assert abs(dot(g[i], d[i]) - first) <= 1e-5 * max(abs(first), size)
            assert abs(curvature[i] - second) <= 2e-5 * max(abs(second), size**2 / 2)


def test_log_gradient_agrees_with_the_reference_for_1e5_lobes_out_to_six_sigma():
    rng = np.random.default_rng(7)
    lobe = ref.random_lobes(rng, 100_000)
    v = ref.directions(rng, lobe, rng.uniform(0, 6, 100_000))
    g, expected = arr(asg(lobe).log_gradient(vec(v))), ref.log_gradient(lobe, v)
    size = np.maximum(np.linalg.norm(expected, axis=-1), np.sqrt(2 * np.maximum(lobe.lam, lobe.mu)))
    # Asked: 2e-4. Rounding alone gives 3e-6; ten times that still sees any wrong term.
    assert np.max(np.linalg.norm(g - expected, axis=-1) / size) < 3e-5


def test_log_gradient_is_tangential():
    rng = np.random.default_rng(8)
    lobe = ref.random_lobes(rng, 100_000)
    v = ref.directions(rng, lobe, rng.uniform(0, 6, 100_000))
    g = arr(asg(lobe).log_gradient(vec(v)))
    # Rounding of v's and g's components: 6e-8 each, three of them.
    assert np.max(np.abs(dot(g, v)) / np.maximum(np.linalg.norm(g, axis=-1), 1e-3)) < 1e-6


def test_log_second_derivative_agrees_with_the_reference_for_1e5_lobes_out_to_six_sigma():
    rng = np.random.default_rng(9)
    lobe = ref.random_lobes(rng, 100_000)
    v = ref.directions(rng, lobe, rng.uniform(0, 6, 100_000))
    d = ref.tangents(rng, v)
    second = arr(asg(lobe).log_second_derivative(vec(v), vec(d)))
    expected = ref.log_second_derivative(lobe, v, d)
    size = np.maximum.reduce([np.abs(expected), lobe.lam, lobe.mu])
    # Asked: 1e-3. Rounding gives about 2e-6.
    assert np.max(np.abs(second - expected) / size) < 3e-5


def test_derivatives_are_right_at_twelve_sigma_where_the_value_underflows():
    rng = np.random.default_rng(10)
    lobe = ref.random_lobes(rng, 2000, 200, 1e6)
    v = ref.directions(rng, lobe, np.full(2000, 14.0))
    d = ref.tangents(rng, v)
    assert np.mean(arr(asg(lobe).eval(vec(v))) == 0) > 0.9  # exp(−98)
    expected = ref.log_gradient(lobe, v)
    error = np.linalg.norm(arr(asg(lobe).log_gradient(vec(v))) - expected, axis=-1)
    assert np.max(error / np.linalg.norm(expected, axis=-1)) < 3e-5  # rounding, as above
    expected = ref.log_second_derivative(lobe, v, d)
    error = np.abs(arr(asg(lobe).log_second_derivative(vec(v), vec(d))) - expected)
    assert np.max(error / np.maximum.reduce([np.abs(expected), lobe.lam, lobe.mu])) < 3e-5


@pytest.mark.parametrize("height", [1e-1, 1e-3, 1e-5, 1e-7])
def test_derivatives_at_the_horizon_are_those_of_the_given_numbers(height):
    rng = np.random.default_rng(11)
    lobe = ref.random_lobes(rng, 2000, 0.1, 1e3)
    phi = rng.uniform(0, 2 * np.pi, 2000)
    rim = np.sqrt(1 - height**2)
    v = ref.from_local(lobe, rim * np.cos(phi), rim * np.sin(phi))
    v = v[(keep := dot(v, lobe.z) > 0.1 * height)]
    lobe = ref.SimpleNamespace(**{k: a[keep] for k, a in vars(lobe).items()})
    assert len(v) > 800
    d = ref.tangents(rng, v)
    expected = ref.log_gradient(lobe, v)
    g = arr(asg(lobe).log_gradient(vec(v)))
    # 1/s to single precision because the dot product is accurate; a plain one has 100 % error here.
    assert np.max(np.linalg.norm(g - expected, axis=-1) / np.linalg.norm(expected, axis=-1)) < 1e-5
    expected = ref.log_second_derivative(lobe, v, d)
    second = arr(asg(lobe).log_second_derivative(vec(v), vec(d)))
    # The term (d·z/s)²: d·z is known to a few roundings of d, δ = 4e-7/s of d·z/s.
    size = np.maximum(np.maximum(lobe.lam, lobe.mu), (dot(d, lobe.z) / dot(v, lobe.z)) ** 2)
    slack = 4e-7 / dot(v, lobe.z)
    assert np.all(np.abs(second - expected) < 2e-5 * size + 2 * slack * np.sqrt(size) + slack**2)


def test_derivatives_are_zero_behind_and_finite_everywhere():
    rng = np.random.default_rng(12)
    lobe = ref.random_lobes(rng, 1000, 1e-3, 1e8)
    v = -ref.directions(rng, lobe, rng.uniform(0, 6, 1000))
    d = vec(ref.tangents(rng, v))
    assert np.all(arr(asg(lobe).log_gradient(vec(v))) == 0)
    assert np.all(arr(asg(lobe).log_second_derivative(vec(v), d)) == 0)
    assert np.all(arr(asg(lobe).log_gradient(vec(-lobe.z))) == 0)
    # Any direction at all, the antipode and the equator among them.
    v = np.concatenate([ref.unit(rng.normal(size=(700, 3))), lobe.x[700:800], lobe.y[800:900]])
    v = f32(np.concatenate([v, -lobe.z[900:]]))
    assert np.all(np.isfinite(arr(asg(lobe).log_gradient(vec(v)))))
    assert np.all(np.isfinite(arr(asg(lobe).log_second_derivative(vec(v), d))))


def test_gradient_vanishes_at_the_centre_and_curvature_is_minus_two_lambda_minus_one():
    lobe = ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], 300, 7)
    z = mi.Vector3f(0, 0, 1)
    assert np.all(arr(lobe.log_gradient(z)) == 0)
    assert lobe.log_second_derivative(z, mi.Vector3f(1, 0, 0))[0] == -601
    assert lobe.log_second_derivative(z, mi.Vector3f(0, 1, 0))[0] == -15


# --- Integral ------------------------------------------------------------------------------------

BANDWIDTHS = [0, 1e-4, 0.1, 0.5, 1, 2, 5, 10, 15, 15.9, 16.1, 19, 25, 50, 200, 1e3, 1e5, 1e8]


def solid_angle_quadrature(lam, mu):
    """∫G dω over the hemisphere in spherical coordinates about the lobe: the azimuth in closed
    form (a Bessel function), the height by scipy's adaptive quadrature."""
    # ∫ exp(−sin²θ (λcos²φ + μsin²φ)) dφ = 2π exp(−sin²θ (λ+μ)/2) I0(sin²θ |λ−μ|/2)
    low, half = min(lam, mu), abs(lam - mu) / 2

    def ring(q):  # q = sin²θ, cosθ sinθ dθ = dq/2
        return np.pi * np.exp(-q * low) * special.ive(0, q * half)

    decades = [0, *10.0 ** np.arange(-9, 1)]  # a power law between 1/µ and 1/λ
    return sum(
        integrate.quad(ring, p, q, epsabs=0, epsrel=1e-9)[0]
        for p, q in zip(decades, decades[1:], strict=False)
        if p * low < 50
    )


def test_quadrature_of_the_integral_agrees_with_mpmath():
    with mp.workdps(20):
        for lam, mu in ((0, 3), (2, 50)):
            exact = mp.quad(
                lambda th, lam=lam, mu=mu: (
                    mp.quad(
                        lambda ph: mp.exp(
                            -(mp.sin(th) ** 2) * (lam * mp.cos(ph) ** 2 + mu * mp.sin(ph) ** 2)
                        ),
                        [0, mp.pi / 2],
                        maxdegree=5,
                    )
                    * 4
                    * mp.cos(th)
                    * mp.sin(th)
                ),
                [0, mpf("0.3"), mp.pi / 2],
                maxdegree=5,
            )
            assert abs(solid_angle_quadrature(lam, mu) / exact - 1) < 1e-8


def test_integral_agrees_with_quadrature_from_0_to_1e8_in_both_orders():
    pairs = [(lam, mu) for lam in BANDWIDTHS for mu in BANDWIDTHS]
    lam, mu = f32(np.array(pairs)).T
    n = len(pairs)
    frame = np.eye(3)
    lobe = ref.lobes(*(np.broadcast_to(axis, (n, 3)) for axis in frame), lam, mu)
    expected = np.array([solid_angle_quadrature(*pair) for pair in zip(lam, mu, strict=True)])
    # Promised: 1e-4 (design), 1e-5 (docstring).
    np.testing.assert_allclose(arr(asg(lobe).integral()), expected, rtol=1e-5)


# --- Sampling ------------------------------------------------------------------------------------

SAMPLED = [
    (1e-4, 1e-4),
    (0.5, 3),
    (3, 0.5),
    (0, 40),
    (1, 1000),
    (20, 20),
    (25, 900),
    (1e4, 50),
    (1e8, 1e6),
]


RADIAL, ANGULAR = 12, 24


def raised(own, other):
    """Bandwidth that ``sample`` uses: at least 1, or the other one if that is smaller still."""
    return max(own, min(other, 1), 1e-6)


def stretched(a, b, lam, mu):
    """Polar coordinates of (a√λ, b√µ): the angle in [0, 2π) and the radius as a share of the
    smaller of 4 (where exp(−16) is left) and the unit disc's rim in that direction."""
    a1, b1 = np.sqrt(raised(lam, mu)), np.sqrt(raised(mu, lam))
    p, q = a * a1, b * b1
    phi, rho = np.arctan2(q, p) % (2 * np.pi), np.hypot(p, q)
    return phi, rho / limit(phi, a1, b1)


def limit(phi, a1, b1):
    return np.minimum(1 / np.hypot(np.cos(phi) / a1, np.sin(phi) / b1), 4)


def pdf_per_cell(lobe, nodes=8):
    """∫ pdf dω (dω = da db / v·z), the pdf by the module, in equal cells of ``stretched``
    coordinates, Gauss–Legendre nodes in each."""
    lam, mu = lobe.lam[0], lobe.mu[0]
    a1, b1 = np.sqrt(raised(lam, mu)), np.sqrt(raised(mu, lam))
    x, w = np.polynomial.legendre.leggauss(nodes)

    def points(n):
        return ((np.arange(n)[:, None] + 0.5 + x / 2) / n).ravel(), np.tile(w / 2 / n, n)

    (turn, w_phi), (share, w_rho) = points(ANGULAR), points(RADIAL)
    phi, share = np.meshgrid(2 * np.pi * turn, share, indexing="ij")
    rim = limit(phi, a1, b1)
    a, b = share * rim * np.cos(phi) / a1, share * rim * np.sin(phi) / b1
    weight = 2 * np.pi * w_phi[:, None] * w_rho * share * rim**2 / (a1 * b1)
    wide = ref.lobes(
        *(np.broadcast_to(axis, (a.size, 3)) for axis in (lobe.x, lobe.y, lobe.z)), lam, mu
    )
    v = ref.from_local(wide, a.ravel(), b.ravel())
    mass = arr(asg(wide).pdf(vec(v))).reshape(a.shape) / np.sqrt(1 - a * a - b * b) * weight
    return mass.reshape(ANGULAR, nodes, RADIAL, nodes).sum((1, 3))


def draw(lobe, n, seed):
    rng = np.random.default_rng(seed)
    u = f32(rng.uniform(size=(2, n)))
    u = np.minimum(u, 1 - 2.0**-24)
    v, pdf = asg(lobe).sample(mi.Point2f(u.astype(np.float32)))
    return v, pdf


@pytest.mark.parametrize("lam, mu", SAMPLED)
def test_samples_are_distributed_like_the_pdf_which_integrates_to_one(lam, mu):
    lobe = ref.lobes(*ref.random_frames(np.random.default_rng(13), 1), lam, mu)
    expected = pdf_per_cell(lobe)
    # exp(−16) < 2e-7 is left out; the rest is quadrature (1e-5 with twice the nodes) and rounding
    # of v·z at the rim.
    assert abs(expected.sum() - 1) < 3e-4
    n = 400_000
    v = arr(draw(lobe, n, 14)[0])
    phi, share = stretched(dot(v, lobe.x), dot(v, lobe.y), lam, mu)
    share = np.where(share < 1 + 1e-4, np.minimum(share, 1 - 1e-9), 2)  # rounding at the rim
    counts, _, _ = np.histogram2d(
        phi, share, bins=(ANGULAR, RADIAL), range=((0, 2 * np.pi), (0, 1))
    )
    expected, counts = n * expected.ravel(), counts.ravel()
    used = expected > 10
    rest = n - expected[used].sum(), n - counts[used].sum()
    chi2 = np.sum((counts[used] - expected[used]) ** 2 / expected[used])
    chi2 += (rest[1] - rest[0]) ** 2 / max(rest[0], 10)
    assert stats.chi2.sf(chi2, used.sum()) > 1e-4  # fixed seed: no chance involved


@pytest.mark.parametrize("lam, mu", SAMPLED)
def test_sample_returns_unit_directions_and_the_pdf_at_them(lam, mu):
    lobe = ref.lobes(*ref.random_frames(np.random.default_rng(15), 1), lam, mu)
    v, pdf = draw(lobe, 100_000, 16)
    front = arr(dr.dot(v, vec(lobe.z))) > 0.02  # at the rim v·z is rounding, and pdf ∝ v·z
    assert np.max(np.abs(np.linalg.norm(arr(v), axis=-1) - 1)) < 5e-7  # a few roundings
    error = np.abs(arr(asg(lobe).pdf(v)) / arr(pdf) - 1)
    # The exponent (up to 17) is evaluated at v rounded to 6e-8 of 1, σ = 1/√(2λ):
    # 2·√17·√λ·6e-8; 1e-7/0.02 for v·z; and the truncation 1 − exp(−ρ²max) depends on the angle of
    # (a, b) by √(µ/λ) at most, which is known to 1e-7/r.
    low, high = sorted((raised(lam, mu), raised(mu, lam)))
    r = np.maximum(np.hypot(dot(arr(v), lobe.x), dot(arr(v), lobe.y)), 1e-7)
    turning = 4e-7 * np.sqrt(high / low) / r if low < 20 else 0
    assert np.all((error < 2e-5 + 8e-7 * np.sqrt(high) + turning)[front])


def test_sample_and_pdf_follow_each_lane_of_a_wide_lobe():
    rng = np.random.default_rng(17)
    lobe = ref.random_lobes(rng, 50_000, 30, 1e5)
    v, pdf = draw(lobe, 50_000, 18)
    np.testing.assert_allclose(arr(asg(lobe).pdf(v)), arr(pdf), rtol=5e-4)
    # 2λa² + 2μb² is χ² of 2 degrees: exponential of mean 2 (standard error 2/√n, five of them).
    q = 2 * lobe.lam * dot(arr(v), lobe.x) ** 2 + 2 * lobe.mu * dot(arr(v), lobe.y) ** 2
    assert abs(q.mean() - 2) < 5 * 2 / np.sqrt(50_000)


@pytest.mark.parametrize("lam, mu", SAMPLED)
def test_mean_of_value_over_pdf_is_the_integral(lam, mu):
    lobe = ref.lobes(*ref.random_frames(np.random.default_rng(19), 1), lam, mu, 2.5)
    v, pdf = draw(lobe, 200_000, 20)
    ratio = arr(asg(lobe).eval(v)) / arr(pdf)
    ratio = ratio[np.isfinite(ratio)]
    assert len(ratio) > 199_990  # v·z = 0 after rounding
    expected = 2.5 * solid_angle_quadrature(*f32([lam, mu]))
    # Five standard errors of the mean, and rounding of the exponents where it has no variance.
    assert abs(ratio.mean() / expected - 1) < 5 * ratio.std() / expected / np.sqrt(2e5) + 1e-4


def test_sample_is_finite_at_the_corners_of_the_unit_square():
    corners = [0.0, 1e-30, 1e-7, 0.25, 0.5, 0.75, 1 - 2.0**-24]
    u, w = (flt(a.ravel()) for a in np.meshgrid(corners, corners))
    for lam, mu in [*SAMPLED, (0, 0), (0, 1e8)]:
        lobe = ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], lam, mu)
        v, pdf = lobe.sample(mi.Point2f(u, w))
        assert np.all(np.isfinite(arr(v)))
        assert np.all(np.isfinite(arr(pdf)))
        assert np.all(arr(pdf) >= 0)


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


def test_modules_names_are_reachable_from_the_package():
    assert aniso_pm.asg.ASG is ASG
    assert aniso_pm.asg.product is product
