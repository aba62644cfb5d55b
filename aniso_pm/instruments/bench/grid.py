"""The rival: photons in a dense grid of cubic cells, kept for comparison only.

The conventional gather of a photon mapper: a counting sort into cells, cells not smaller than the
radius of the largest query, and every photon of the 27 cells around a query is tested. ``rows``
takes the three cells of a row at once, because their photons lie one after another: a third of the
loop's starts, and the strongest grid that was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from aniso_pm.map.index import Ellipses


@dataclass(frozen=True)
class Grid:
    """Photons by cells.

    low         lower corner of the grid; ``cell`` is the side of its cells, world units.
    resolution  number of cells along each axis.
    start       first photon of each cell and, one more, the number of photons.
    points      x, y, z and the caller's 32-bit word of each photon, interleaved.
    """

    low: Any
    cell: float
    resolution: list[int]
    start: Any
    points: Any


def build(positions, word, cell: float) -> Grid:
    """Sort photons (Point3f, UInt32) into cells of that side."""
    low = mi.Point3f(*(dr.min(axis) for axis in positions))
    high = [dr.max(axis)[0] for axis in positions]
    resolution = [int((h - low[k][0]) / cell) + 1 for k, h in enumerate(high)]
    x, y, z = (
        dr.minimum(mi.UInt32((positions[k] - low[k]) / cell), resolution[k] - 1) for k in range(3)
    )
    key = (z * resolution[1] + y) * resolution[0] + x
    order = dr.argsort(key)
    count = dr.zeros(mi.UInt32, resolution[0] * resolution[1] * resolution[2] + 1)
    dr.scatter_reduce(dr.ReduceOp.Add, count, mi.UInt32(1), key)
    p = dr.gather(mi.Point3f, positions, order)
    word = dr.reinterpret_array(mi.Float, dr.gather(mi.UInt32, word, order))
    points = dr.empty(mi.Float, 4 * dr.width(word))
    dr.scatter(points, mi.Vector4f(p.x, p.y, p.z, word), dr.arange(mi.UInt32, dr.width(word)))
    start = dr.cumsum(count) - count
    dr.eval(low, start, points)
    return Grid(low, cell, resolution, start, points)


@dr.syntax
def gather(grid: Grid, ellipses: Ellipses, cut2: float, visit, total, rows: bool):
    """As ``index.gather``: fold ``visit`` over all photons inside each lane's ellipse, whose long
    half axis, cut, must not be longer than a cell. rows: three cells at once."""
    center, a, b, c = ellipses.center, ellipses.a, ellipses.b, ellipses.c
    nx, ny, nz = (dr.opaque(mi.Int32, n) for n in grid.resolution)
    cell = mi.Vector3i((center - grid.low) / grid.cell)
    start, points = grid.start, grid.points

    near = mi.UInt32(0)
    while near < (9 if rows else 27):
        if dr.hint(rows, mode="scalar"):
            y, z = cell.y + mi.Int32(near % 3) - 1, cell.z + mi.Int32(near // 3) - 1
            x, last = dr.maximum(cell.x - 1, 0), dr.minimum(cell.x + 1, nx - 1)
        else:
            x, y = cell.x + mi.Int32(near % 3) - 1, cell.y + mi.Int32(near // 3 % 3) - 1
            z, last = cell.z + mi.Int32(near // 9) - 1, x
        exists = (x >= 0) & (last < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
        row = (z * ny + y) * nx
        slot = dr.gather(mi.UInt32, start, mi.UInt32(row + x), exists)
        end = dr.gather(mi.UInt32, start, mi.UInt32(row + last + 1), exists)
        while slot < end:
            point = dr.gather(mi.Vector4f, points, slot)
            d = mi.Vector3f(point.x, point.y, point.z) - center
            da, db = dr.dot(a, d), dr.dot(b, d)
            rho2 = da * da + db * db
            inside = (rho2 <= cut2) & (dr.abs(dr.dot(c, d)) <= 1)
            word = dr.reinterpret_array(mi.UInt32, point.w)
            total = visit(total, slot, word, d, rho2, inside)
            slot += 1
        near += 1
    return total
