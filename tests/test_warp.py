"""Claims about aniso_pm.warp: half-vector lobe → reflection lobe."""

from __future__ import annotations

import aniso_pm  # before drjit and mitsuba: it chooses their LLVM

# isort: split
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.warp import symmetric_eigen, warp_to_reflection
from reference import arr, asg, dot, f32, flt, unit, vec


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def mirror(o, n):
    return 2 * dot(o, n)[:, None] * n - o


def pull_back(lobe, o, e, f):
    """½ second derivative at the mirror direction of r ↦ λ(h·x)² + μ(h·y)², h = normalize(o + r),
    in the tangent basis (e, f), by differences along geodesics: this is −½ that of
    ln(G(h(r)) / (h·z)).

    The form is smooth on the scale of c = o·z, so steps of 1e-3·c with one Richardson step leave
    1e-12; it vanishes at the mirror direction, so that there is next to no rounding."""
    r0, c = mirror(o, lobe.z), dot(o, lobe.z)[:, None]

    def form(d, step):
        r = r0 * np.cos(step) + d * np.sin(step)
        h = unit(o + r)
        return lobe.lam * dot(h, lobe.x) ** 2 + lobe.mu * dot(h, lobe.y) ** 2

    def half_second(d):
        coarse, fine = (
            (form(d, t * c) + form(d, -t * c)) / (2 * (t * c[:, 0]) ** 2) for t in (1e-3, 5e-4)
        )
        return (4 * fine - coarse) / 3

    m11, m22 = half_second(e), half_second(f)
    m12 = half_second(unit(e + f)) - (m11 + m22) / 2
    return np.stack([np.stack([m11, m12], -1), np.stack([m12, m22], -1)], -2)


def closed_form(lobe, o):
    """M of design.md, section 1, with X', Y' (double precision)."""
    n, c = lobe.z, dot(o, lobe.z)
    i = mirror(o, n)
    X = unit(np.cross(o, n))
    Y = np.cross(i, X)
    cos, sin = dot(lobe.x, X), dot(lobe.y, X)
    m11 = (lobe.lam * cos**2 + lobe.mu * sin**2) / (4 * c**2)
    m12 = (lobe.mu - lobe.lam) * cos * sin / (4 * c)
    m22 = (lobe.mu * cos**2 + lobe.lam * sin**2) / 4
    return np.stack([np.stack([m11, m12], -1), np.stack([m12, m22], -1)], -2), X, Y


def orthonormal(lobe):
    """The lobe with its rounded frame made exactly orthonormal. The Hessian of the form in a frame
    with x·z = 6e-8 has its small eigenvalue off by 6e-8 times the condition number (up to 1e7
    here), which says nothing about the lobe that was meant."""
    z = unit(lobe.z)
    x = unit(lobe.x - z * dot(lobe.x, z)[:, None])
    return ref.lobes(x, np.cross(z, x), z, lobe.lam, lobe.mu)


def configurations(n, seed, low=1.0, high=1e4, exact=False):
    """Random NDF lobes and viewers with 0.02 < o·z < 1."""
    rng = np.random.default_rng(seed)
    lobe = ref.random_lobes(rng, n, low, high)
    if exact:
        lobe = orthonormal(lobe)
    c, phi = rng.uniform(0.02, 1, n)[:, None], rng.uniform(0, 2 * np.pi, n)[:, None]
    o = c * lobe.z + np.sqrt(1 - c * c) * (np.cos(phi) * lobe.x + np.sin(phi) * lobe.y)
    return lobe, (unit(o) if exact else f32(unit(o)))


def form_of(warped, e, f, n):
    """λ x xᵀ + μ y yᵀ of the module's result, in the basis (e, f)."""
    x, y = (np.broadcast_to(arr(axis), (n, 3)) for axis in (warped.x, warped.y))
    lam, mu = (np.broadcast_to(arr(k), n)[:, None] for k in (warped.lam, warped.mu))
    return ref.ellipse(x * np.sqrt(lam), y * np.sqrt(mu), e, f)


def test_closed_form_is_the_pullback_hessian_in_double_precision():
    lobe, o = configurations(2000, 1, exact=True)
    M, X, Y = closed_form(lobe, o)
    # Asked: 1e-6.
    assert np.max(ref.relative_difference(M, pull_back(lobe, o, X, Y))) < 1e-6


def test_warped_lobe_matches_the_pullback_hessian():
    lobe, o = configurations(2000, 2)
    exact = orthonormal(lobe)
    e, f = ref.tangent_basis(unit(mirror(unit(o), exact.z)))
    M = pull_back(exact, unit(o), e, f)
    found = form_of(warp_to_reflection(asg(lobe), vec(o)), e, f, 2000)
    # The direction of the axes is rounded to 1e-7, which the aspect ratio of the form magnifies in
    # the short direction (at most √1e4/0.02 = 5,000), and c is known to 1e-7/c <= 5e-6.
    stretch = np.sqrt(np.linalg.cond(M))
    assert np.max(ref.relative_difference(found, M) / (1e-4 + 1e-6 * stretch)) < 1


def test_warped_bandwidths_are_the_eigenvalues():
    lobe, o = configurations(2000, 3, 1, 1e6)
    M, _, _ = closed_form(lobe, o)
    det = lobe.lam * lobe.mu / (16 * dot(o, lobe.z) ** 2)
    large = np.linalg.eigvalsh(M)[:, 1]
    warped = warp_to_reflection(asg(lobe), vec(o))
    found = np.sort([arr(warped.lam), arr(warped.mu)], axis=0)
    # c enters squared: 2·6e-8/c <= 6e-6. The smaller one is held to relative accuracy, too. The
    # sine of the azimuth is known to 1e-7/sinθ where it decides (λ >> μ across the plane).
    np.testing.assert_allclose(found[1], large, rtol=2e-3)
    np.testing.assert_allclose(found[0], det / large, rtol=2e-3)


def test_warped_lobe_describes_the_distribution_of_reflected_directions():
    # Independent of any Hessian: reflect half-vectors drawn from the NDF lobe and compare the
    # covariance of the reflected directions with that of the warped lobe, 1/(2λ) and 1/(2μ).
    rng = np.random.default_rng(4)
    n = 200_000
    for c, phi in ((0.9, 0.3), (0.4, 1.0), (0.15, 2.5)):
        lam, mu = 4e6, 1e6
        h = np.stack([rng.normal(size=n) / np.sqrt(2 * lam), rng.normal(size=n) / np.sqrt(2 * mu)])
        h = np.stack([*h, np.sqrt(1 - h[0] ** 2 - h[1] ** 2)], -1)
        s = np.sqrt(1 - c * c)
        o = np.array([s * np.cos(phi), s * np.sin(phi), c])
        r = 2 * (h @ o)[:, None] * h - o
        frame = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
        warped = warp_to_reflection(aniso_pm.asg.ASG(*frame, lam, mu), mi.Vector3f(*o.tolist()))
        a = r @ arr(warped.x)[0] * np.sqrt(2 * warped.lam[0])
        b = r @ arr(warped.y)[0] * np.sqrt(2 * warped.mu[0])
        # Unit covariance; standard error √2/√n = 0.003, and σ/c = 1e-3/0.15 of curvature, squared.
        np.testing.assert_allclose(np.cov(a, b), np.eye(2), atol=0.015)


def test_warped_lobe_is_centred_at_the_mirror_direction_with_a_right_handed_frame():
    lobe, o = configurations(20_000, 5, 1e-2, 1e8)
    warped = warp_to_reflection(asg(lobe), vec(o))
    x, y, z = arr(warped.x), arr(warped.y), arr(warped.z)
    assert np.max(np.linalg.norm(z - mirror(o, lobe.z), axis=-1)) < 1e-6  # a few roundings
    assert np.max(np.linalg.norm(np.cross(x, y) - z, axis=-1)) < 2e-6
    for axis in (x, y, z):
        assert np.max(np.abs(np.linalg.norm(axis, axis=-1) - 1)) < 1e-6
    assert np.max(np.abs(dot(x, z))) < 1e-6


def test_amplitude_is_kept_in_front_and_zero_behind_and_at_the_horizon():
    lobe, o = configurations(1000, 6)
    lobe.amplitude = f32(np.random.default_rng(6).uniform(0.1, 1e3, 1000))
    front = arr(warp_to_reflection(asg(lobe), vec(o)).amplitude)
    np.testing.assert_array_equal(front, lobe.amplitude)
    behind = warp_to_reflection(asg(lobe), vec(o - 2 * dot(o, lobe.z)[:, None] * lobe.z))
    assert np.all(arr(behind.amplitude) == 0)
    z = aniso_pm.asg.ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], 100, 4, 3)
    assert warp_to_reflection(z, mi.Vector3f(1, 0, 0)).amplitude[0] == 0
    assert warp_to_reflection(z, mi.Vector3f(0, 0, -1)).amplitude[0] == 0


@pytest.mark.parametrize("lam, mu", [(100, 100), (1e8, 1), (1, 1e8), (1e-2, 3)])
def test_warp_is_finite_and_of_the_right_determinant_from_normal_incidence_to_the_horizon(lam, mu):
    degrees = np.array([0, 1e-6, 1e-3, 0.0057, 0.006, 0.1, 45, 89, 89.9, 89.99])
    azimuth = np.radians([0, 90, 180, 270, 45, 30, 1e-5])  # along each tangent axis, too
    theta, phi = (a.ravel() for a in np.meshgrid(np.radians(degrees), azimuth))
    o = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    ndf = aniso_pm.asg.ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], lam, mu)
    warped = warp_to_reflection(ndf, vec(o))
    frame = [arr(axis) for axis in (warped.x, warped.y, warped.z)]
    warped_lam, warped_mu = arr(warped.lam), arr(warped.mu)
    assert np.all(np.isfinite(frame)) and np.all(np.isfinite([warped_lam, warped_mu]))
    assert np.all(np.minimum(warped_lam, warped_mu) > 0)
    assert np.max(np.linalg.norm(np.cross(frame[0], frame[1]) - frame[2], axis=-1)) < 2e-6
    # det M = λμ/(16c²); o is rounded, so c is the rounded component.
    det = lam * mu / (16 * f32(o)[:, 2] ** 2)
    np.testing.assert_allclose(warped_lam * warped_mu, det, rtol=1e-5)


def test_warp_at_normal_incidence_is_the_ndf_at_a_quarter_of_its_bandwidths():
    rng = np.random.default_rng(7)
    lobe = ref.random_lobes(rng, 500, 1, 1e4)
    warped = warp_to_reflection(asg(lobe), vec(lobe.z))
    found = form_of(warped, lobe.x, lobe.y, 500)
    wanted = np.zeros((500, 2, 2))
    wanted[:, 0, 0], wanted[:, 1, 1] = lobe.lam / 4, lobe.mu / 4  # dr/dh = 2 in every direction
    stretch = np.sqrt(np.linalg.cond(wanted))
    assert np.max(ref.relative_difference(found, wanted) / stretch) < 3e-6  # axes to 1e-7


def test_warp_is_continuous_where_the_tangent_at_normal_incidence_takes_over():
    # At sinθ = 1e-4 the code changes its tangent; the form must not notice: 2 against 2c differ by
    # 5e-9 there, tilts by 1e-4 squared.
    ndf = aniso_pm.asg.ASG([1, 0, 0], [0, 1, 0], [0, 0, 1], 400, 1)
    e, f = np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
    for phi in (0.0, 0.4, 1.57, 3.0):
        below, above = (
            form_of(
                warp_to_reflection(
                    ndf, mi.Vector3f(float(t * np.cos(phi)), float(t * np.sin(phi)), 1.0)
                ),
                e,
                f,
                1,
            )
            for t in (0.9e-4, 1.1e-4)
        )
        assert np.max(ref.relative_difference(below, above)) < 2e-5


def test_isotropic_lobe_does_not_depend_on_the_azimuth_of_its_axes():
    rng = np.random.default_rng(8)
    lobe, o = configurations(2000, 9)
    lobe.mu = lobe.lam
    turn = rng.uniform(0, 2 * np.pi, 2000)[:, None]
    turned = ref.lobes(
        f32(lobe.x * np.cos(turn) + lobe.y * np.sin(turn)),
        f32(lobe.y * np.cos(turn) - lobe.x * np.sin(turn)),
        lobe.z,
        lobe.lam,
        lobe.mu,
    )
    e, f = ref.tangent_basis(unit(mirror(o, lobe.z)))
    forms = [form_of(warp_to_reflection(asg(k), vec(o)), e, f, 2000) for k in (lobe, turned)]
    # Roundings, times the stretch 1/c <= 50 of the form.
    assert np.max(ref.relative_difference(*forms) * dot(o, lobe.z)) < 1e-5
    # And its principal directions are those of the plane of incidence: λ/(4c²) across, λ/4 in it.
    warped = warp_to_reflection(asg(lobe), vec(o))
    np.testing.assert_allclose(arr(warped.lam), lobe.lam / (4 * dot(o, lobe.z) ** 2), rtol=2e-5)
    np.testing.assert_allclose(arr(warped.mu), lobe.lam / 4, rtol=2e-5)
    across = unit(np.cross(o, lobe.z))
    steep = 1 - dot(o, lobe.z) ** 2 > 0.2  # else the form is a circle and has no directions
    assert np.max(1 - np.abs(dot(arr(warped.x), across))[steep]) < 1e-6


def test_symmetric_eigen_agrees_with_numpy_and_survives_extremes():
    rng = np.random.default_rng(10)
    m = rng.normal(size=(3, 5000)) * 10.0 ** rng.uniform(-12, 12, 5000)
    m[1, :100] = 0  # diagonal
    m[:, 100:200] = np.stack([m[0, 100:200], 0 * m[0, 100:200], m[0, 100:200]])  # multiple of 1
    m[:, 200:210] = 0
    m = f32(m)
    large, small, c, s = (arr(a) for a in symmetric_eigen(*(flt(a) for a in m)))
    matrix = np.stack([np.stack([m[0], m[1]], -1), np.stack([m[1], m[2]], -1)], -2)
    values = np.linalg.eigvalsh(matrix)
    size = np.abs(values).max(-1) + 1e-30
    assert np.max(np.abs(np.stack([small, large], -1) - values) / size[:, None]) < 1e-6
    q = np.stack([c, s], -1)
    residual = np.einsum("nij,nj->ni", matrix, q) - large[:, None] * q
    assert np.max(np.linalg.norm(residual, axis=-1) / size) < 1e-6  # roundings
    assert np.all(c[100:210] == 1) and np.all(s[100:210] == 0)
