"""Triangle meshes for the gallery: grids, surfaces of revolution, sweeps, and writing them as PLY.

All meshes share one convention, because an anisotropic BSDF takes its brushing direction from the
surface parametrisation:

* ``dp/du`` is the direction of the brushing grooves: around the axis for everything that is turned
  on a lathe (teapot body, lid, spout, pan), along the length for everything that is drawn through a
  die (handles);
* ``dp/du x dp/dv`` is the outward normal, and so is the winding of the triangles.

A renderer computes ``dp/du`` per triangle. A turned surface is therefore tessellated more finely
around the axis than its silhouette needs: on a flat disc the groove direction is off by up to half
a sector, which would show as a saw-tooth edge of the highlights.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

SCENES = Path(__file__).resolve().parents[1] / "scenes"
MESHES = SCENES / "meshes"


@dataclass
class Mesh:
    """Triangles with one position, normal and texture coordinate per vertex."""

    p: np.ndarray
    n: np.ndarray
    uv: np.ndarray
    f: np.ndarray

    @staticmethod
    def merge(*parts: Mesh) -> Mesh:
        offsets = np.cumsum([0] + [len(m.p) for m in parts[:-1]])
        return Mesh(
            np.concatenate([m.p for m in parts]),
            np.concatenate([m.n for m in parts]),
            np.concatenate([m.uv for m in parts]),
            np.concatenate([m.f + o for m, o in zip(parts, offsets, strict=True)]),
        )

    def transformed(self, rotation: np.ndarray, offset=(0.0, 0.0, 0.0)) -> Mesh:
        """Rotate (no scale, so that normals stay valid) and move."""
        return Mesh(self.p @ rotation.T + np.asarray(offset), self.n @ rotation.T, self.uv, self.f)


def normalize(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def grid(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> Mesh:
    """Triangulate a grid of shape (rows, columns, 3); u runs along columns and v along rows.

    A first or last row that collapses to one point (a pole) becomes a fan in which every triangle
    has its own apex, at the u of the middle of its sector. Sharing one apex would give it one
    arbitrary u, and dp/du would turn away from the circumferential direction.
    """
    rows, cols = p.shape[:2]
    index = np.arange(rows * cols).reshape(rows, cols)
    pole = [np.ptp(p[r], axis=0).max() < 1e-6 for r in (0, -1)]

    p, n, uv = p.copy(), n.copy(), uv.copy()
    for r, is_pole in zip((0, -1), pole, strict=True):
        if is_pole:  # the last column of a pole row stays unused and is dropped below
            uv[r, :-1, 0] = 0.5 * (uv[r, :-1, 0] + uv[r, 1:, 0])

    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    upper = np.stack([a, b, d], -1)  # has two vertices in the upper row
    lower = np.stack([b, c, d], -1)  # has two vertices in the lower row
    if pole[0]:
        lower[0] = np.stack([a[0], c[0], d[0]], -1)
        upper = upper[1:]
    if pole[1]:
        upper[-1] = np.stack([a[-1], b[-1], d[-1]], -1)
        lower = lower[:-1]
    f = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])

    used, f = np.unique(f, return_inverse=True)
    return Mesh(
        p.reshape(-1, 3)[used], n.reshape(-1, 3)[used], uv.reshape(-1, 2)[used], f.reshape(-1, 3)
    )


def save(name: str, mesh: Mesh) -> None:
    """Check a mesh and write it as a binary PLY file."""
    # Rounding makes the positions along the seams bitwise equal, whichever patch evaluated them.
    p = np.round(mesh.p, 6).astype(np.float32) + np.float32(0.0)  # + 0 turns -0 into 0
    n = normalize(mesh.n)
    uv = mesh.uv

    e1, e2 = p[mesh.f[:, 1]] - p[mesh.f[:, 0]], p[mesh.f[:, 2]] - p[mesh.f[:, 0]]
    ng = np.cross(e1.astype(float), e2.astype(float))
    assert np.isfinite(p).all() and np.isfinite(n).all() and np.isfinite(uv).all(), name
    assert (np.linalg.norm(ng, axis=1) > 1e-9).all(), f"{name}: degenerate triangle"
    assert ((n[mesh.f] * normalize(ng)[:, None]).sum(-1) > 0.3).all(), f"{name}: orientation"
    t1, t2 = uv[mesh.f[:, 1]] - uv[mesh.f[:, 0]], uv[mesh.f[:, 2]] - uv[mesh.f[:, 0]]
    det = t1[:, 0] * t2[:, 1] - t1[:, 1] * t2[:, 0]
    assert (det > 1e-10).all(), f"{name}: degenerate or mirrored texture coordinates"

    vertex = np.empty(len(p), [(k, "<f4") for k in ("x", "y", "z", "nx", "ny", "nz", "u", "v")])
    columns = np.concatenate([p, n, uv], axis=1).T
    for k, column in zip(vertex.dtype.names, columns, strict=True):
        vertex[k] = column
    face = np.empty(len(mesh.f), [("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, mesh.f
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    header += [f"property float {k}" for k in vertex.dtype.names]
    header += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header"]
    path = MESHES / f"{name}.ply"
    path.write_bytes("\n".join(header).encode() + b"\n" + vertex.tobytes() + face.tobytes())
    lo, hi = p.min(0), p.max(0)
    print(
        f"{path.name:20s} {len(face):6d} triangles  {path.stat().st_size / 1024:6.1f} KiB"
        f"  [{lo[0]:.2f} {lo[1]:.2f} {lo[2]:.2f}] .. [{hi[0]:.2f} {hi[1]:.2f} {hi[2]:.2f}]"
    )


# --------------------------------------------------------------------------------------------------
# Curves in the (r, z) plane for surfaces of revolution: arrays of (r, z, n_r, n_z)
# --------------------------------------------------------------------------------------------------


def line(start, end, count: int) -> np.ndarray:
    """A straight profile; the normal is to the left of the direction of travel."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    d = normalize(end - start)
    points = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
    return np.concatenate([points, np.tile([-d[1], d[0]], (count + 1, 1))], 1)


def arc(centre, radius: float, a0: float, a1: float, count: int) -> np.ndarray:
    """A circular profile from angle a0 to a1 (degrees); normal to the left of the travel."""
    a = np.radians(np.linspace(a0, a1, count + 1))
    d = np.stack([np.cos(a), np.sin(a)], 1)
    return np.concatenate([np.asarray(centre) + radius * d, -np.sign(a1 - a0) * d], 1)


def join(*pieces: np.ndarray) -> np.ndarray:
    """Concatenate profiles which meet with a common tangent, dropping the doubled points."""
    return np.concatenate([pieces[0]] + [piece[1:] for piece in pieces[1:]])


def revolve(profile: np.ndarray, sectors: int, v_scale: float = 1.0) -> Mesh:
    """Turn a profile around the z axis. Its normals have to be to the left of its direction.

    u runs once around, v is the arc length along the profile.
    """
    r, z, nr, nz = profile.T
    u = np.arange(sectors + 1) / sectors
    angle = -2 * np.pi * (np.arange(sectors + 1) % sectors) / sectors  # closes exactly
    c, s, one = np.cos(angle), np.sin(angle), np.ones_like(angle)
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(r), np.diff(z)))])
    p = np.stack([np.outer(r, c), np.outer(r, s), np.outer(z, one)], -1)
    n = np.stack([np.outer(nr, c), np.outer(nr, s), np.outer(nz, one)], -1)
    uu, vv = np.meshgrid(u, length * v_scale)
    return grid(p, n, np.stack([uu, vv], -1))


def sweep(path: np.ndarray, half_size: np.ndarray, sides: int, power: float, cap: int) -> Mesh:
    """Sweep a superellipse along a path in the (x, z) plane and close both ends with domes.

    path: (k, 2) points, half_size: (k, 2) half width (y) and half thickness at these points.
    power: 2 is an ellipse, larger values approach a rectangle.
    u is the arc length along the path, v runs around.
    """

    def dome(q, tangent, size, sign):
        """Rings which shrink towards the end, on an ellipsoid with a half-thickness as depth."""
        b = np.radians(np.linspace(0, 90, cap + 1))[1:]
        b[-1] = np.radians(89)  # leaves a tiny flat disc, closed by a fan below
        rings_q = q + sign * np.sin(b)[:, None] * size[1] * tangent
        return rings_q, np.cos(b)[:, None] * size

    tangents = normalize(np.gradient(path, axis=0))
    head_q, head_s = dome(path[0], tangents[0], half_size[0], -1)
    tail_q, tail_s = dome(path[-1], tangents[-1], half_size[-1], 1)
    q = np.concatenate([head_q[::-1], path, tail_q])
    size = np.concatenate([head_s[::-1], half_size, tail_s])
    t = np.concatenate([np.tile(tangents[0], (cap, 1)), tangents, np.tile(tangents[-1], (cap, 1))])

    a = 2 * np.pi * (np.arange(sides + 1) % sides) / sides
    cy = np.sign(np.cos(a)) * np.abs(np.cos(a)) ** (2 / power)
    cz = np.sign(np.sin(a)) * np.abs(np.sin(a)) ** (2 / power)
    up = np.stack([-t[:, 1], t[:, 0]], 1)
    x = q[:, None, 0] + size[:, 1, None] * cz * up[:, 0, None]
    z = q[:, None, 1] + size[:, 1, None] * cz * up[:, 1, None]
    y = size[:, 0, None] * cy
    p = np.stack([x, y, z], -1)  # (along, around, 3)

    # Normals from central differences on the grid: the shape has no simple closed form.
    d_along = np.gradient(p, axis=0)
    wrapped = np.concatenate([p[:, -2:-1], p, p[:, 1:2]], axis=1)
    d_around = wrapped[:, 2:] - wrapped[:, :-2]
    n = normalize(np.cross(d_along, d_around))
    outward = p - np.stack([q[:, 0], 0 * q[:, 0], q[:, 1]], -1)[:, None]
    sign = np.sign((n * outward).sum(-1).mean())
    n *= sign

    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    v = np.arange(sides + 1) / sides
    # Rows of the grid go around (v) and columns along (u); reverse v if that is left-handed.
    order = slice(None) if sign > 0 else slice(None, None, -1)
    p, n = p[:, order].swapaxes(0, 1), n[:, order].swapaxes(0, 1)
    uu, vv = np.meshgrid(length, v)
    body = grid(p, n, np.stack([uu, vv], -1))

    # The flat discs at both ends; their texture is a plain projection.
    discs = []
    for column, direction in ((0, -t[0]), (-1, t[-1])):
        ring = p[:-1, column]
        normal = np.array([direction[0], 0, direction[1]])
        rim, centre = ring, ring.mean(0)
        side = np.array([0, 1.0, 0])
        other = np.cross(normal, side)
        points = np.concatenate([[centre], rim])
        local = points - centre
        k = np.arange(len(rim))
        f = np.stack([0 * k, 1 + k, 1 + (k + 1) % len(rim)], -1)
        e = np.cross(points[f[0, 1]] - centre, points[f[0, 2]] - centre)
        if e @ normal < 0:
            f = f[:, [0, 2, 1]]
        discs.append(
            Mesh(
                points,
                np.tile(normal, (len(points), 1)),
                np.stack([local @ side, local @ other], -1),
                f,
            )
        )
    return Mesh.merge(body, *discs)


def bernstein(t: np.ndarray, order: int = 0) -> np.ndarray:
    """Cubic Bernstein polynomials at t, or their first derivative; shape (len(t), 4)."""
    s = 1 - t
    if order == 0:
        return np.stack([s**3, 3 * t * s**2, 3 * t**2 * s, t**3], -1)
    return 3 * np.stack([-(s**2), s**2 - 2 * t * s, 2 * t * s - t**2, t**2], -1)


def cubic(points, count: int) -> np.ndarray:
    """Points on one cubic Bezier curve."""
    return bernstein(np.linspace(0, 1, count + 1)) @ np.asarray(points, float)


def frame_to(axis) -> np.ndarray:
    """A rotation which takes the z axis to the given direction."""
    z = normalize(np.asarray(axis, float))
    x = normalize(np.cross([0.0, 1.0, 0.0], z))
    return np.stack([x, np.cross(z, x), z], 1)
