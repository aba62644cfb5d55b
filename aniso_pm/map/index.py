"""Points → implicit bounding-volume hierarchy; sums over elliptical neighbourhoods.

Points are sorted along a Hilbert curve of 21 bits an axis (a coin in a stadium: 2e6 cells along
the longest side) and cut into leaves of LEAF points. The leaves are the bottom row of a complete
binary tree in heap order: node i has the children 2i and 2i + 1, leaf j is node n_leaves + j, no
pointer is stored. Boxes are made by pairwise minima and maxima, level by level, and stored in 16
bytes, one load, a few per cent too large. The traversal needs no stack: a node that is hit goes to
2i; otherwise to the next node in depth-first order, which is i + 1 with its trailing zeros shifted
out (1 means: finished).

A neighbourhood is an elliptical cylinder {d : (a·d)² + (b·d)² <= cut², |c·d| <= 1} around a
centre. It meets a box if their projections meet on its own axes and on those of the box. That costs
the same at any aspect ratio: a thin ellipse visits the points along it, not those of a disc.

This module knows points and ellipses; what the points carry is the caller's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..arrays import number

LEAF = 8
_BITS = 21
# Leaves that a lane finds before it goes through their points. One more entry is a waste bin; with
# 32 entries and more Dr.Jit 1.5 is reported to break its stack.
_QUEUE = 15
# A box is its lower corner and its size as three numbers of 10 bits, relative to the whole cube:
# 5 of exponent, 5 of mantissa, rounded up. This is the exponent of the smallest as a float has it.
_EXPONENT = 96 << 23
# Points from which on peak memory counts.
_LARGE = 1 << 20
_EMPTY = 1 << 30  # in the word of the sizes: nothing in the box


@dataclass(frozen=True)
class Ellipses:
    """Elliptical cylinders around ``center``; a, b, c are covectors (1/length), see above."""

    center: Any
    a: Any
    b: Any
    c: Any

    def reach(self, cut2: float):
        """Half extents along x, y and z, a little more than exact; a, b and c are orthogonal."""
        s, t, n = (v * dr.rcp(dr.squared_norm(v)) for v in (self.a, self.b, self.c))
        return (1 + 1e-5) * (dr.sqrt(cut2 * (s * s + t * t)) + dr.abs(n))

    @staticmethod
    def from_axes(center, s, t, n, half_thickness) -> Ellipses:
        """Half axes s ⟂ t (where the weight is 1/e) in the plane of unit normal n."""
        return Ellipses(
            center,
            s * dr.rcp(dr.squared_norm(s)),
            t * dr.rcp(dr.squared_norm(t)),
            n * dr.rcp(half_thickness),
        )


@dataclass(frozen=True)
class Index:
    """Hierarchy over ``count`` points.

    count, n_leaves  int, or as arrays (``number``) where functions are frozen.
    points  x, y, z and the caller's 32-bit word of each slot, interleaved; not a number in the
            slots that fill up the last leaf.
    boxes   lower corner and size (see ``_pack``) of each node, interleaved, in heap order.
    extent  the longest side of all points together, the unit of the sizes.
    """

    count: Any
    n_leaves: Any
    points: Any
    boxes: Any
    extent: Any

    def points_in(self, node, active):
        """Number of points below a node; 0 where it is not active."""
        n_leaves, count = number(mi.UInt32, self.n_leaves), number(mi.UInt32, self.count)
        height = dr.lzcnt(node) - dr.lzcnt(n_leaves)
        first = LEAF * ((node << height) - n_leaves)
        return dr.select(active, dr.minimum(LEAF << height, count - first), 0)


def curve_order(positions):
    """Permutation (UInt32) that sorts points along a Hilbert curve through them."""
    low, extent = _cube(positions)
    scale = dr.select(extent > 0, (2**_BITS - 1) / extent, 0)
    code = _hilbert((positions - low) * scale)
    # The sort is stable, so two of halves are one of the whole: as fast, and less memory.
    high, low = mi.UInt32(code >> 32), mi.UInt32(code)
    dr.eval(high, low)
    del code
    order = dr.argsort(low)
    del low
    high = dr.gather(mi.UInt32, high, order)
    dr.eval(order, high)
    give_back(dr.width(positions))
    order = dr.gather(mi.UInt32, order, dr.argsort(high))
    dr.eval(order)
    return order


def give_back(count: int):
    """Let go of memory that Dr.Jit keeps for later, where that of ``count`` points is much.

    What is kept serves blocks of the same size only: without this, the peak is the sum of all
    sizes that ever were. Small blocks are worth keeping for the next pass, and so are all blocks of
    a GPU: their sizes are powers of two, and giving them back stops every device.
    """
    if count >= _LARGE and dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        dr.sync_thread()
        dr.flush_malloc_cache()


def _cube(positions):
    """(lower corner, side) of a cube around points."""
    low, high = (mi.Point3f(*(f(axis) for axis in positions)) for f in (dr.min, dr.max))
    return low, dr.max(high - low)


def build(positions, word) -> tuple[Index, Any]:
    """(hierarchy, order) of at least one point; order: slot → number of the point (UInt32).

    positions: Point3f of finite points; word: UInt32 that is handed to the visitor of ``gather``
    with each point.
    """
    return build_of([positions, word])


def build_of(columns: list) -> tuple[Index, Any]:
    """As ``build`` of [positions, word]. The list is emptied: columns that nobody else has make
    room for the boxes (arguments of a call do not, before Python 3.11: the caller holds them)."""
    positions, word = columns
    columns.clear()
    count = dr.width(positions)
    _, extent = _cube(positions)
    order = curve_order(positions)
    give_back(count)
    positions = dr.gather(mi.Point3f, positions, order)
    word = dr.reinterpret_array(mi.Float, dr.gather(mi.UInt32, word, order))
    used_leaves = -(-count // LEAF)
    points = dr.full(mi.Float, dr.nan, 4 * LEAF * used_leaves)
    dr.scatter(points, mi.Vector4f(positions.x, positions.y, positions.z, word), _iota(count))
    dr.eval(points, extent)
    del positions, word
    give_back(count)

    n_leaves = 1
    while n_leaves < used_leaves:
        n_leaves *= 2
    boxes = dr.zeros(mi.Float, 8 * n_leaves)
    low, high = _leaf_boxes(points, count, n_leaves)
    level = n_leaves
    while True:
        # Node 0 does not exist; every other node is written exactly once.
        dr.scatter(boxes, _pack(low, high, extent), _iota(level) + level)
        dr.eval(boxes, low, high)
        if level == 1:
            break
        level //= 2
        left = 2 * _iota(level)
        low, high = (
            combine(dr.gather(mi.Point3f, v, left), dr.gather(mi.Point3f, v, left + 1))
            for v, combine in ((low, dr.minimum), (high, dr.maximum))
        )
    del low, high
    give_back(count)
    return Index(count, n_leaves, points, boxes, extent), order


def _iota(n):
    return dr.arange(mi.UInt32, n)


def _leaf_boxes(points, count, n_leaves):
    """(lower, upper) corner of each leaf; +inf and −inf if it is empty."""
    low, high = dr.full(mi.Point3f, dr.inf, n_leaves), dr.full(mi.Point3f, -dr.inf, n_leaves)
    # As a literal, the count would be compiled into the kernel: a new one for every map.
    count = dr.opaque(mi.UInt32, count)
    first = LEAF * _iota(n_leaves)
    for k in range(LEAF):
        exists = first + k < count
        p = dr.gather(mi.Vector4f, points, dr.minimum(first + k, count - 1))
        p = mi.Point3f(p.x, p.y, p.z)
        low = dr.select(exists, dr.minimum(low, p), low)
        high = dr.select(exists, dr.maximum(high, p), high)
    return low, high


def _pack(low, high, extent):
    """A box in four words."""
    word, empty = mi.UInt32(0), low.x > high.x
    for axis in range(3):
        # Rounding of the difference, the quotient and their product with the extent: 2⁻²² of it.
        size = (high[axis] - low[axis]) / extent * (1 + 2**-20)
        size = dr.select(empty | (extent == 0), 0, size)
        bits = dr.reinterpret_array(mi.UInt32, dr.maximum(size, 2.0**-31))
        word |= ((bits - _EXPONENT + 0x3FFFF) >> 18) << (10 * axis)
    word = dr.select(empty, _EMPTY, word)
    return mi.Vector4f(low.x, low.y, low.z, dr.reinterpret_array(mi.Float, word))


def _unpack(box):
    """(lower corner, size / extent, empty?) of what ``_pack`` made."""
    word = dr.reinterpret_array(mi.UInt32, box.w)
    size = (((word >> (10 * axis)) & 0x3FF) << 18 for axis in range(3))
    size = mi.Vector3f(*(dr.reinterpret_array(mi.Float, bits + _EXPONENT) for bits in size))
    return mi.Point3f(box.x, box.y, box.z), size, word >= _EMPTY


@dr.syntax
def _hilbert(cell):
    """63-bit Hilbert codes of positions in cells [Skilling 2004]: untwist, then Gray code."""
    x, y, z = mi.UInt32(cell.x), mi.UInt32(cell.y), mi.UInt32(cell.z)
    bit = mi.UInt32(1 << (_BITS - 1))
    while bit > 1:
        below = bit - 1
        x = dr.select(x & bit != 0, x ^ below, x)
        swap = (x ^ y) & below
        flip = y & bit != 0
        x, y = dr.select(flip, x ^ below, x ^ swap), dr.select(flip, y, y ^ swap)
        swap = (x ^ z) & below
        flip = z & bit != 0
        x, z = dr.select(flip, x ^ below, x ^ swap), dr.select(flip, z, z ^ swap)
        bit >>= 1
    y ^= x
    z ^= y
    gray = mi.UInt32(0)
    bit = mi.UInt32(1 << (_BITS - 1))
    while bit > 1:
        gray = dr.select(z & bit != 0, gray ^ (bit - 1), gray)
        bit >>= 1
    wide = dr.uint64_array_t(mi.Float)
    x, y, z = wide(x ^ gray), wide(y ^ gray), wide(z ^ gray)
    return (_spread(x) << 2) | (_spread(y) << 1) | _spread(z)


def _spread(x):
    """Insert two zero bits between neighbouring bits of a 21-bit number."""
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << shift)) & mask
    return x


@dr.syntax
def gather(index: Index, ellipses: Ellipses, cut2: float, visit, total, active, whole=None):
    """Fold ``visit`` over all points inside each lane's ellipse.

    visit(total, slot, word, d, rho2, inside) -> total is called with the slot of a point, its word,
    its offset d from the centre, ρ² = (a·d)² + (b·d)² and whether it is inside (it is not in slots
    without a point); ``total`` is any tree of Dr.Jit arrays.

    whole  None, or (tolerance, rim, visit_node): nodes within the thickness of the cylinder whose
           half extents x, y in units of 1/|a|, 1/|b| have x² + y² <= tolerance (x² + y² + rim, if
           the rim goes through them) are offered to visit_node(total, node) -> (total, taken), and
           only opened if they are not taken.

    Lanes that lie next to each other should have ellipses next to each other (``curve_order``):
    they go through the same nodes at the same time then, twice as fast.

    Two loops in turn: one looks for leaves that are hit until the queue is full, one goes through
    their points. So the lanes of a vector spend their time in the same loop, and wait for each
    other once for some fifteen leaves, not for each.
    """
    center, a, b, c = ellipses.center, ellipses.a, ellipses.b, ellipses.c
    n_leaves = number(mi.UInt32, index.n_leaves)
    points, boxes = index.points, index.boxes
    half_extent, reach = 0.5 * index.extent, mi.Vector3f(ellipses.reach(cut2))
    abs_a, abs_b, abs_c = dr.abs(a), dr.abs(b), dr.abs(c)
    if dr.hint(whole is not None, mode="scalar"):
        tolerance, rim, visit_node = dr.opaque(mi.Float, whole[0]), whole[1], whole[2]

    queue = dr.alloc_local(mi.UInt32, _QUEUE + 1)
    node = dr.select(active, mi.UInt32(1), mi.UInt32(0))  # 0: finished
    while node != 0:
        found = mi.UInt32(0)
        while (node != 0) & (found < _QUEUE):
            low, size, empty = _unpack(dr.gather(mi.Vector4f, boxes, node))
            half = size * half_extent
            # Relative to the centre first: far from the origin a box's middle is not a number.
            mid = (low - center) + half
            da, db, dc = dr.abs(dr.dot(a, mid)), dr.abs(dr.dot(b, mid)), dr.abs(dr.dot(c, mid))
            wa, wb, wc = dr.dot(abs_a, half), dr.dot(abs_b, half), dr.dot(abs_c, half)
            near_a, near_b = dr.maximum(da - wa, 0), dr.maximum(db - wb, 0)
            hit = ~empty & dr.all(dr.abs(mid) <= half + reach)
            hit &= (near_a * near_a + near_b * near_b <= cut2) & (dc - wc <= 1)
            if dr.hint(whole is not None, mode="scalar"):
                far_a, far_b = da + wa, db + wb
                on_rim = far_a * far_a + far_b * far_b > cut2
                error = wa * wa + wb * wb + dr.select(on_rim, rim, 0)
                small = hit & (error <= tolerance) & (dc + wc <= 1)
                taken = mi.Bool(False)
                if small:
                    total, taken = visit_node(total, node)
                hit &= ~taken
            is_leaf = node >= n_leaves
            # Not a masked write: those go astray in Dr.Jit 1.5's LLVM backend.
            queue[dr.select(hit & is_leaf, found, _QUEUE)] = node - n_leaves
            found += dr.select(hit & is_leaf, mi.UInt32(1), 0)
            following = node + 1
            following = following >> dr.tzcnt(following)
            following = dr.select(following == 1, 0, following)
            node = dr.select(hit & ~is_leaf, 2 * node, following)

        k = mi.UInt32(0)
        while k < LEAF * found:
            slot = LEAF * queue[k // LEAF] + k % LEAF
            point = dr.gather(mi.Vector4f, points, slot)
            d = mi.Vector3f(point.x, point.y, point.z) - center
            da, db = dr.dot(a, d), dr.dot(b, d)
            rho2 = da * da + db * db
            inside = (rho2 <= cut2) & (dr.abs(dr.dot(c, d)) <= 1)
            word = dr.reinterpret_array(mi.UInt32, point.w)
            if inside:
                total = visit(total, slot, word, d, rho2, inside)
            k += 1
    return total
