"""The spatial index against brute force over all pairs, in double precision."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import index as spatial

CUT2 = 4.0


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def to_points(a):
    return mi.Point3f(np.ascontiguousarray(a.T.astype(np.float32)))


def ellipses(rng, centers, size, aspect):
    """Random ellipses: Dr.Jit structure and the same rounded numbers for the reference."""
    n = rng.normal(size=centers.shape)
    n /= np.linalg.norm(n, axis=1)[:, None]
    s = np.cross(n, rng.normal(size=centers.shape))
    s /= np.linalg.norm(s, axis=1)[:, None]
    t = np.cross(n, s)
    s, t = s * size * aspect**0.5, t * size / aspect**0.5
    v = [mi.Vector3f(np.ascontiguousarray(x.T.astype(np.float32))) for x in (s, t, n)]
    e = spatial.Ellipses.from_axes(to_points(centers), *v, half_thickness=mi.Float(size))
    dr.eval(e.a, e.b, e.c)
    return e, [np.array(x).T.astype(np.float64) for x in (e.a, e.b, e.c)]


def gathered(points, words, e):
    index = spatial.build(to_points(points), mi.UInt32(words.astype(np.uint32)))

    def visit(total, slot, word, rho2, inside):
        count, weight, tag = total
        return (
            count + dr.select(inside, mi.UInt32(1), 0),
            weight + dr.select(inside, dr.exp(-rho2), 0),
            tag + dr.select(inside, word, 0),
        )

    total = (mi.UInt32(0), mi.Float(0), mi.UInt32(0))
    active = dr.full(mi.Bool, True, dr.width(e.center))
    return [x.numpy() for x in spatial.gather(index, e, CUT2, visit, total, active)]


def brute_force(points, words, centers, abc):
    d = points[None].astype(np.float32).astype(np.float64) - centers[:, None].astype(np.float32)
    a, b, c = (np.einsum("qpk,qk->qp", d, v) for v in abc)
    rho2 = a * a + b * b
    inside = (rho2 <= CUT2) & (np.abs(c) <= 1)
    # Pairs within rounding of the rim may go either way; they are counted apart.
    rim = (np.abs(rho2 - CUT2) < 1e-4) | (np.abs(np.abs(c) - 1) < 1e-4)
    return (
        inside.sum(1),
        np.where(inside, np.exp(-rho2), 0).sum(1),
        (inside * words).sum(1),
        rim.sum(1),
    )


@pytest.mark.parametrize("aspect", [1, 16, 300])
@pytest.mark.parametrize("count", [1, 7, 8, 9, 1000, 4097])
def test_gather_finds_what_brute_force_finds(count, aspect):
    rng = np.random.default_rng(count + aspect)
    points = rng.random((count, 3)) * [1, 1, 0.1]
    words = rng.integers(0, 1000, count)
    centers = points[rng.integers(0, count, 300)] + rng.normal(size=(300, 3)) * 0.02
    e, abc = ellipses(rng, centers, 0.1, aspect)
    number, weight, tag = gathered(points, words, e)
    number_, weight_, tag_, rim = brute_force(points, words, centers, abc)
    assert np.all(np.abs(number.astype(int) - number_) <= rim)
    certain = rim == 0
    assert certain.mean() > 0.5
    np.testing.assert_array_equal(tag[certain], tag_[certain])
    # Single-precision sums of at most a few thousand terms; at aspect 300 a and b are sums of
    # terms 17 times larger than themselves.
    np.testing.assert_allclose(weight[certain], weight_[certain], rtol=1e-4, atol=1e-6)


def test_uneven_density_loses_nothing():
    """99 % of the points in a millionth of the volume: keys must still tell them apart."""
    rng = np.random.default_rng(5)
    points = rng.random((5000, 3))
    points[:4950] = 0.5 + 0.01 * points[:4950]
    words = np.ones(5000, int)
    centers = points[::50]
    e, abc = ellipses(rng, centers, 0.002, 4)
    number, *_ = gathered(points, words, e)
    number_, _, _, rim = brute_force(points, words, centers, abc)
    assert np.all(np.abs(number.astype(int) - number_) <= rim)
    assert number_.max() > 20


def test_coincident_points_are_all_found():
    points = np.full((1000, 3), 0.25)
    e, _ = ellipses(np.random.default_rng(0), points[:3], 0.1, 2)
    number, weight, _ = gathered(points, np.ones(1000, int), e)
    assert np.all(number == 1000)
    np.testing.assert_allclose(weight, 1000, rtol=1e-6)


def test_inactive_lanes_do_nothing():
    points = np.random.default_rng(0).random((100, 3))
    index = spatial.build(to_points(points), dr.zeros(mi.UInt32, 100))
    e, _ = ellipses(np.random.default_rng(1), points[:8], 10.0, 1)
    active = mi.Bool([True, False] * 4)
    count = spatial.gather(
        index, e, CUT2, lambda total, *rest: total + 1, dr.zeros(mi.UInt32, 8), active
    )
    assert list(count.numpy()) == [100, 0] * 4


def test_order_is_a_permutation():
    points = np.random.default_rng(0).random((777, 3))
    index = spatial.build(to_points(points), dr.zeros(mi.UInt32, 777))
    np.testing.assert_array_equal(np.sort(index.order.numpy()), np.arange(777))
