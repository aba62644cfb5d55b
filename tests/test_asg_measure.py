"""Integral and sampling of ASGs; the references are in reference.py."""

from __future__ import annotations

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import reference as ref
from aniso_pm.asg import ASG
from aniso_pm.instruments.stability.reference import mp, mpf
from reference import arr, asg, dot, f32, flt, vec
from scipy import integrate, special, stats


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


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
