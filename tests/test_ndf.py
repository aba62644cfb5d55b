"""Claims about aniso_pm.ndf: the ASG of a microfacet NDF."""

from __future__ import annotations

import aniso_pm  # noqa: F401  # before drjit and mitsuba: it chooses their LLVM

# isort: split
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.instruments.stability.reference import mp, mpf
from aniso_pm.ndf import asg_from_roughness
from reference import arr, f32


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def beckmann(h, alpha_u, alpha_v):
    """D(h), Beckmann, Cook and Torrance 1982; h in the local frame (z = normal)."""
    q = (h[0] / alpha_u) ** 2 + (h[1] / alpha_v) ** 2
    return mp.exp(-q / h[2] ** 2) / (mp.pi * alpha_u * alpha_v * h[2] ** 4)


def ggx(h, alpha_u, alpha_v):
    """D(h), GGX: Walter et al. 2007, anisotropic: Burley 2012."""
    q = (h[0] / alpha_u) ** 2 + (h[1] / alpha_v) ** 2 + h[2] ** 2
    return 1 / (mp.pi * alpha_u * alpha_v * q**2)


NDFS = {"beckmann": beckmann, "ggx": ggx}
ROUGHNESS = [(0.01, 0.01), (0.02, 0.3), (0.3, 0.02), (0.1, 0.25), (0.5, 0.6)]


def curvature_at_peak(function):
    """Second differences of ln D at the normal along the tangent and the bitangent."""
    t = mpf("1e-12")
    top = mp.log(function((mpf(0), mpf(0), mpf(1))))
    along = [
        mp.log(function((mp.sin(t) * u, mp.sin(t) * v, mp.cos(t)))) for u, v in ((1, 0), (0, 1))
    ]
    return [float(2 * (f - top) / t**2) for f in along]  # even in t


@pytest.mark.parametrize("distribution", NDFS)
@pytest.mark.parametrize("match", ["peak", "curvature"])
@pytest.mark.parametrize("alpha_u, alpha_v", ROUGHNESS)
def test_amplitude_is_the_peak_of_the_distribution(distribution, match, alpha_u, alpha_v):
    lobe = asg_from_roughness(alpha_u, alpha_v, distribution, match)
    peak = float(NDFS[distribution]((0, 0, mpf(1)), *f32([alpha_u, alpha_v]).tolist()))
    assert abs(lobe.amplitude[0] / peak - 1) < 5e-7  # a few roundings
    assert abs(lobe.eval(mi.Vector3f(0, 0, 1))[0] / peak - 1) < 5e-7


@pytest.mark.parametrize("distribution", NDFS)
@pytest.mark.parametrize("alpha_u, alpha_v", ROUGHNESS)
def test_match_peak_puts_lambda_at_one_over_alpha_squared(distribution, alpha_u, alpha_v):
    lobe = asg_from_roughness(alpha_u, alpha_v, distribution)
    wanted = 1 / f32([alpha_u, alpha_v]) ** 2
    np.testing.assert_allclose([lobe.lam[0], lobe.mu[0]], wanted, rtol=3e-7)  # a few roundings
    np.testing.assert_array_equal(arr(lobe.x)[0], [1, 0, 0])
    np.testing.assert_array_equal(arr(lobe.y)[0], [0, 1, 0])
    np.testing.assert_array_equal(arr(lobe.z)[0], [0, 0, 1])


@pytest.mark.parametrize("distribution", NDFS)
def test_match_peak_has_the_mass_of_the_distribution(distribution):
    ndf = NDFS[distribution]
    for alpha in (0.05, 0.2):
        # Rotationally symmetric; the edges follow the peak and GGX's tail.
        edges = [0, alpha / 2, alpha, 3 * alpha, mpf("0.8"), mp.pi / 2]
        # ∫ D cosθ dω = 1 by definition of an NDF: this checks the formula above.
        cosine_mass = mp.quad(
            lambda t, a=alpha: ndf((mp.sin(t), 0, mp.cos(t)), a, a) * mp.cos(t) * mp.sin(t),
            edges,
        )
        assert abs(2 * mp.pi * cosine_mass - 1) < 1e-8
        # ∫ A·G dω = A·π/√(λμ) = 1 up to exp(−1/α²) < 2e-11: G carries the cosine.
        lobe = asg_from_roughness(alpha, alpha, distribution)
        assert abs(lobe.integral()[0] - 1) < 1e-5


@pytest.mark.parametrize("distribution", NDFS)
@pytest.mark.parametrize("alpha_u, alpha_v", ROUGHNESS)
def test_match_curvature_has_the_second_difference_of_the_logarithm(distribution, alpha_u, alpha_v):
    alphas = f32([alpha_u, alpha_v]).tolist()
    lobe = asg_from_roughness(alpha_u, alpha_v, distribution, "curvature")
    z, x, y = mi.Vector3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    found = [lobe.log_second_derivative(z, d)[0] for d in (x, y)]
    wanted = curvature_at_peak(lambda h: NDFS[distribution](h, *map(mpf, alphas)))
    # Difference of 1/α² >= 2.8 and 5/2, each rounded.
    np.testing.assert_allclose(found, wanted, rtol=2e-6)


@pytest.mark.parametrize("alpha", [0.05, 0.3])
def test_match_peak_of_beckmann_is_within_a_percent_of_the_distribution_near_the_peak(alpha):
    lobe = asg_from_roughness(alpha, 0.7 * alpha, "beckmann")
    for t in (0.1, 0.3):
        t *= alpha
        h = (float(np.sin(t)), 0.0, float(np.cos(t)))
        exact = float(beckmann(h, alpha, 0.7 * alpha))
        # ln D − ln(A·G) = 5/2·t² + O(t⁴/α²), see the module's head.
        assert (
            abs(np.log(lobe.eval(mi.Vector3f(*h))[0] / exact) + 2.5 * t * t)
            < 2 * t**4 / alpha**2 + 1e-5
        )


def test_arrays_of_roughness_give_one_lobe_a_lane():
    lobe = asg_from_roughness(mi.Float(0.1, 0.2, 0.5), 0.1)
    np.testing.assert_allclose(arr(lobe.lam), [100, 25, 4], rtol=1e-6)
    np.testing.assert_allclose(arr(lobe.mu) * np.ones(3), [100, 100, 100], rtol=1e-6)


@pytest.mark.parametrize(
    "arguments, names",
    [
        ((0.1, 0.1, "phong"), ["phong", "beckmann", "ggx"]),
        ((0.1, 0.1, "beckmann", "tail"), ["tail", "peak", "curvature"]),
        ((0.64, 0.1, "beckmann", "curvature"), ["0.64", "peak"]),
        ((0.1, 0.64, "beckmann", "curvature"), ["0.64", "peak"]),
        ((0.9, 0.9, "ggx", "curvature"), ["0.9", "peak"]),
    ],
)
def test_refuses_what_it_cannot_do_and_says_what_to_do(arguments, names):
    with pytest.raises(ValueError) as refusal:
        asg_from_roughness(*arguments)
    assert all(name in str(refusal.value) for name in names)


@pytest.mark.parametrize("distribution, limit", [("beckmann", 0.4**0.5), ("ggx", 0.8**0.5)])
def test_match_curvature_reaches_up_to_the_stated_roughness(distribution, limit):
    lobe = asg_from_roughness(limit - 1e-3, limit - 1e-3, distribution, "curvature")
    assert 0 < lobe.lam[0] < 0.02
    with pytest.raises(ValueError):
        asg_from_roughness(mi.Float(0.1, limit + 1e-3), 0.1, distribution, "curvature")
