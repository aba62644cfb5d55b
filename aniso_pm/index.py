"""Points → implicit bounding-volume hierarchy; sums over elliptical neighbourhoods.

Points are sorted along a Morton curve of 21 bits an axis (a coin in a stadium: 2e6 cells along
the longest side) and cut into leaves of LEAF points. The leaves are the bottom row of a complete
binary tree in heap order: node i has the children 2i and 2i + 1, leaf j is node n_leaves + j, no
pointer is stored. Boxes are made by pairwise minima and maxima, level by level. The traversal needs
no stack: a node that is hit goes to 2i; otherwise to the next node in depth-first order, which is
i + 1 with its trailing zeros shifted out (1 means: finished).

A neighbourhood is an elliptical cylinder {d : (a·d)² + (b·d)² <= cut², |c·d| <= 1} around a
centre. Its test against a box costs the same at any aspect ratio, so a thin ellipse visits the
points along it, not those of a disc around it.

This module knows points and ellipses; what the points carry is the caller's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

LEAF = 8
_MORTON_BITS = 21


@dataclass(frozen=True)
class Ellipses:
    """Elliptical cylinders around ``center``; a, b, c are covectors (1/length), see above."""

    center: Any
    a: Any
    b: Any
    c: Any

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

    order   permutation that sorted the points (UInt32): slot → number given to ``build``.
    points  x, y, z and the caller's 32-bit word of each slot, interleaved.
    boxes   lower corner, 0, upper corner, 0 of each node, interleaved, in heap order.
    """

    count: int
    n_leaves: int
    order: Any
    points: Any
    boxes: Any


def build(positions, word) -> Index:
    """Build the hierarchy. positions: Point3f of finite points; word: UInt32 that is handed to
    the visitor of ``gather`` with each point. At least one point."""
    count = dr.width(positions)
    order = dr.argsort(_morton(positions))
    positions = dr.gather(mi.Point3f, positions, order)
    word = dr.reinterpret_array(mi.Float, dr.gather(mi.UInt32, mi.UInt32(word), order))
    points = dr.empty(mi.Float, 4 * count)
    dr.scatter(points, mi.Vector4f(positions.x, positions.y, positions.z, word), _iota(count))

    n_leaves = 1
    while n_leaves * LEAF < count:
        n_leaves *= 2
    boxes = dr.empty(mi.Float, 16 * n_leaves)
    low, high = _leaf_boxes(points, count, n_leaves)
    level = n_leaves
    while True:
        # Node 0 does not exist; every other node is written exactly once.
        node = _iota(level) + level
        dr.scatter(boxes, mi.Vector4f(low.x, low.y, low.z, 0), 2 * node)
        dr.scatter(boxes, mi.Vector4f(high.x, high.y, high.z, 0), 2 * node + 1)
        dr.eval(boxes, low, high)
        if level == 1:
            break
        level //= 2
        left = 2 * _iota(level)
        low, high = (
            combine(dr.gather(mi.Point3f, v, left), dr.gather(mi.Point3f, v, left + 1))
            for v, combine in ((low, dr.minimum), (high, dr.maximum))
        )
    dr.eval(points, order)
    return Index(count, n_leaves, order, points, boxes)


def _iota(n):
    return dr.arange(mi.UInt32, n)


def _leaf_boxes(points, count, n_leaves):
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


def _morton(p):
    """63-bit Morton codes relative to the points' bounding cube."""
    cells = 2**_MORTON_BITS - 1
    low, high = (mi.Point3f(*(f(axis) for axis in p)) for f in (dr.min, dr.max))
    extent = dr.max(high - low)
    scale = dr.select(extent > 0, cells / extent, 0)
    wide = dr.uint64_array_t(mi.Float)
    code = wide(0)
    for axis in range(3):
        # The product may round up past the last cell.
        cell = dr.minimum(mi.UInt32((p[axis] - low[axis]) * scale), cells)
        code |= _spread(wide(cell)) << axis
    return code


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
def gather(index: Index, ellipses: Ellipses, cut2: float, visit, total, active):
    """Fold ``visit`` over all points inside each lane's ellipse.

    visit(total, slot, word, rho2, inside) -> total is called with the slot of a point, its word,
    ρ² = (a·d)² + (b·d)² and whether it is inside; ``total`` is any tree of Dr.Jit arrays.

    Two nested loops: one looks for the next leaf that is hit, one goes through its points, so that
    the lanes of a vector spend their time in the same loop.
    """
    center, a, b, c = ellipses.center, ellipses.a, ellipses.b, ellipses.c
    abs_a, abs_b, abs_c = dr.abs(a), dr.abs(b), dr.abs(c)
    count, n_leaves = dr.opaque(mi.UInt32, index.count), dr.opaque(mi.UInt32, index.n_leaves)
    points, boxes = index.points, index.boxes

    node = dr.select(active, mi.UInt32(1), mi.UInt32(0))  # 0: finished
    while node != 0:
        leaf = mi.UInt32(0)
        while (node != 0) & (leaf == 0):
            low = dr.gather(mi.Vector4f, boxes, 2 * node)
            high = dr.gather(mi.Vector4f, boxes, 2 * node + 1)
            # Relative to the centre first: far from the origin a box's middle is not a number.
            low = mi.Point3f(low.x, low.y, low.z) - center
            high = mi.Point3f(high.x, high.y, high.z) - center
            mid, half = 0.5 * (high + low), 0.5 * (high - low)
            da = dr.maximum(dr.abs(dr.dot(a, mid)) - dr.dot(abs_a, half), 0)
            db = dr.maximum(dr.abs(dr.dot(b, mid)) - dr.dot(abs_b, half), 0)
            dc = dr.abs(dr.dot(c, mid)) - dr.dot(abs_c, half)
            # Empty leaves have low = +inf, high = −inf: their half extent fails the last test.
            hit = (da * da + db * db <= cut2) & (dc <= 1) & (half.x >= 0)
            is_leaf = node >= n_leaves
            leaf = dr.select(hit & is_leaf, node, 0)
            following = node + 1
            following = following >> dr.tzcnt(following)
            following = dr.select(following == 1, 0, following)
            node = dr.select(hit & ~is_leaf, 2 * node, following)

        slot = (leaf - n_leaves) * LEAF
        end = dr.select(leaf != 0, dr.minimum(slot + LEAF, count), 0)
        slot = dr.select(leaf != 0, slot, 0)
        while slot < end:
            point = dr.gather(mi.Vector4f, points, slot)
            d = mi.Vector3f(point.x, point.y, point.z) - center
            da, db = dr.dot(a, d), dr.dot(b, d)
            rho2 = da * da + db * db
            inside = (rho2 <= cut2) & (dr.abs(dr.dot(c, d)) <= 1)
            total = visit(total, slot, dr.reinterpret_array(mi.UInt32, point.w), rho2, inside)
            slot += 1
    return total
