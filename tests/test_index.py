"""The spatial index against brute force over all pairs, in double precision."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.map import index as spatial

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
    index, _ = spatial.build(to_points(points), mi.UInt32(words.astype(np.uint32)))

    def visit(total, slot, word, d, rho2, inside):
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
    index, _ = spatial.build(to_points(points), dr.zeros(mi.UInt32, 100))
    e, _ = ellipses(np.random.default_rng(1), points[:8], 10.0, 1)
    active = mi.Bool([True, False] * 4)

    def visit(total, slot, word, d, rho2, inside):
        return total + dr.select(inside, mi.UInt32(1), 0)

    count = spatial.gather(index, e, CUT2, visit, dr.zeros(mi.UInt32, 8), active)
    assert list(count.numpy()) == [100, 0] * 4


def test_order_is_a_permutation():
    points = np.random.default_rng(0).random((777, 3))
    _, order = spatial.build(to_points(points), dr.zeros(mi.UInt32, 777))
    np.testing.assert_array_equal(np.sort(order.numpy()), np.arange(777))


def test_the_curve_never_jumps():
    """A Hilbert curve through a full lattice goes from neighbour to neighbour."""
    # Cells of a lattice of 16 fill the cube of 2²¹ cells exactly.
    lattice = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), -1).reshape(-1, 3)
    code = spatial._hilbert(to_points(lattice * 2**17 + 2**16)).numpy()
    steps = np.diff(lattice[np.argsort(code)], axis=0)
    np.testing.assert_array_equal(np.abs(steps).sum(1), 1)
    assert len(np.unique(code)) == len(lattice)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_boxes_hold_their_points_tightly(scale):
    """Also far from the origin, and at every level of the tree."""
    rng = np.random.default_rng(3)
    points = scale * (rng.random((3000, 3)) ** 4 * [1, 1, 1e-9] + [300, 0, -5])
    points = points.astype(np.float32)
    index, _ = spatial.build(to_points(points), dr.zeros(mi.UInt32, 3000))
    low, size, empty = spatial._unpack(dr.unravel(mi.Vector4f, index.boxes))
    low = np.array(low, dtype=np.float64).T
    high = low + np.array(size, dtype=np.float64).T * float(index.extent[0])
    leaf = np.arange(3000) // spatial.LEAF + index.n_leaves
    p = index.points.numpy().reshape(-1, 4)[:3000, :3].astype(np.float64)
    assert list(np.flatnonzero(~empty.numpy())[-1:]) == [leaf[-1]]
    while leaf[-1] > 0:
        assert np.all(low[leaf] <= p) and np.all(p <= high[leaf])
        assert not empty.numpy()[leaf].any()
        # 1/32 for the mantissa, and no size below 2⁻³¹ of the whole
        tops = np.maximum.reduceat(p, np.flatnonzero(np.diff(leaf, prepend=0)))
        slack = high[np.unique(leaf)] - tops
        assert np.all(slack <= (tops - low[np.unique(leaf)]) / 31 + scale * 1e-8)
        leaf = leaf // 2
