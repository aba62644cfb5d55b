"""Value and derivatives of ASGs; the references are in reference.py."""

from __future__ import annotations

import aniso_pm  # before drjit and mitsuba: it chooses their LLVM

# isort: split
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.asg import ASG, product
from aniso_pm.instruments.stability.reference import mp
from reference import arr, asg, dot, f32, vec


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


def test_modules_names_are_reachable_from_the_package():
    assert aniso_pm.asg.ASG is ASG
    assert aniso_pm.asg.product is product
