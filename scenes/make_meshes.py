"""Generate the meshes and textures of the two example scenes.

Run ``python scenes/make_meshes.py`` to regenerate everything in ``scenes/meshes`` and
``scenes/textures``. Nothing is random between runs (fixed seeds), so the files are reproducible.

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

import json
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")  # only used to write images

HERE = Path(__file__).resolve().parent
MESHES = HERE / "meshes"
TEXTURES = HERE / "textures"


# --------------------------------------------------------------------------------------------------
# Meshes
# --------------------------------------------------------------------------------------------------


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
# Teapot
# --------------------------------------------------------------------------------------------------


def bernstein(t: np.ndarray, order: int = 0) -> np.ndarray:
    """Cubic Bernstein polynomials at t, or their first derivative; shape (len(t), 4)."""
    s = 1 - t
    if order == 0:
        return np.stack([s**3, 3 * t * s**2, 3 * t**2 * s, t**3], -1)
    return 3 * np.stack([-(s**2), s**2 - 2 * t * s, 2 * t * s - t**2, t**2], -1)


def bezier_patch(points: np.ndarray, rows: int, cols: int, along: str, uv_box) -> Mesh:
    """Tessellate one bicubic patch whose (column derivative) x (row derivative) points outward.

    along: "columns" puts u along the columns, "rows" along the rows.
    uv_box: (u0, u1, v0, v1), the texture coordinates which the patch covers.
    """
    t, s = np.linspace(0, 1, rows + 1), np.linspace(0, 1, cols + 1)

    def evaluate(row_order, col_order):
        return np.einsum("ia,jb,abk->ijk", bernstein(t, row_order), bernstein(s, col_order), points)

    p, dt, ds = evaluate(0, 0), evaluate(1, 0), evaluate(0, 1)
    # At a pole (knob of the lid, centre of the bottom) the whole row is one point and ds is zero.
    # Near it ds grows like t * d2p/(dt ds), so the mixed derivative has the direction in the limit.
    pole = np.linalg.norm(ds, axis=-1) < 1e-9
    ds = np.where(pole[..., None], evaluate(1, 1), ds)
    n = normalize(np.cross(ds, dt))

    u0, u1, v0, v1 = uv_box
    if along == "columns":
        u, v = np.meshgrid(u0 + (u1 - u0) * s, v0 + (v1 - v0) * t)
        return grid(p, n, np.stack([u, v], -1))
    # Swap the axes of the grid; one of them has to be reversed to stay right-handed.
    p, n = p[:, ::-1].swapaxes(0, 1), n[:, ::-1].swapaxes(0, 1)
    u, v = np.meshgrid(u0 + (u1 - u0) * t, v0 + (v1 - v0) * s)
    return grid(p, n, np.stack([u, v], -1))


def make_teapot() -> None:
    data = json.loads((HERE / "utah_teapot.json").read_text())
    patches = np.array(data["vertices"])[np.array(data["patches"])].reshape(-1, 4, 4, 3)

    def ring(first: int, count: int, rows: int, cols: int, v0: float, v1: float, along="columns"):
        """The patches of one closed ring, ``count`` of them around the axis."""
        parts = []
        for k in range(count):
            box = (k / count, (k + 1) / count, v0, v1)
            if along == "rows":  # here u follows the length, and v the ring
                box = (v0, v1, 1 - (k + 1) / count, 1 - k / count)
            parts.append(bezier_patch(patches[first + k], rows, cols, along, box))
        return Mesh.merge(*parts)

    around = 40  # columns per patch, 160 around the body
    save(
        "teapot_body",
        Mesh.merge(
            ring(0, 4, 8, around, 0.0, 0.1),
            ring(4, 4, 18, around, 0.1, 0.5),
            ring(8, 4, 14, around, 0.5, 0.8),
            ring(28, 4, 8, around, 0.0, 1.0),  # bottom; a chart of its own, its rows go outward
        ),
    )
    save(
        "teapot_lid",
        Mesh.merge(ring(20, 4, 16, around, 0.0, 0.4), ring(24, 4, 14, around, 0.4, 1.0)),
    )
    save(
        "teapot_handle",
        Mesh.merge(ring(12, 2, 24, 16, 0.0, 0.5, "rows"), ring(14, 2, 24, 16, 0.5, 1.0, "rows")),
    )
    save("teapot_spout", Mesh.merge(ring(16, 2, 24, 24, 0.0, 0.8), ring(18, 2, 10, 24, 0.8, 1.0)))


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


# --------------------------------------------------------------------------------------------------
# Frying pan
# --------------------------------------------------------------------------------------------------

PAN_THICKNESS = 0.09
PAN_BASE = 1.95  # radius of the flat part
PAN_FILLET = (0.62, 58.0)  # radius of the middle surface, turned angle in degrees
PAN_FLARE = (2.2, 16.0)  # flank, bends slightly outward again


def pan_geometry():
    """Centres of the two arcs of the middle surface, and the rim's position and direction."""
    h = PAN_THICKNESS / 2
    c1 = np.array([PAN_BASE, h + PAN_FILLET[0]])
    a1 = np.radians(-90 + PAN_FILLET[1])
    joint = c1 + PAN_FILLET[0] * np.array([np.cos(a1), np.sin(a1)])
    out = np.array([np.cos(a1), np.sin(a1)])  # away from the first centre
    c2 = joint + PAN_FLARE[0] * out
    a2 = np.radians(90 + PAN_FILLET[1] - PAN_FLARE[1])
    rim = c2 + PAN_FLARE[0] * np.array([np.cos(a2), np.sin(a2)])
    return c1, c2, rim, 90 + PAN_FILLET[1] - PAN_FLARE[1]


def pan_profile() -> np.ndarray:
    """From the centre inside, over the rim, to the centre of the outer bottom."""
    h = PAN_THICKNESS / 2
    c1, c2, rim, a2 = pan_geometry()
    (r1, t1), r2 = PAN_FILLET, PAN_FLARE[0]
    return join(
        line((0, 2 * h), (PAN_BASE, 2 * h), 5),
        arc(c1, r1 - h, -90, -90 + t1, 7),
        arc(c2, r2 + h, 90 + t1, a2, 3),
        arc(rim, h, a2, a2 - 180, 6),
        arc(c2, r2 - h, a2, 90 + t1, 3),
        arc(c1, r1 + h, -90 + t1, -90, 6),
        line((PAN_BASE, 0), (0, 0), 2),
    )


def flank_point(fraction: float, side: float):
    """Point of the flank (0 at the fillet, 1 at the rim) and its unit normal, inside (+1) or out.

    Both are given in the (x, z) plane as 3-vectors.
    """
    _, c2, _, a2 = pan_geometry()
    a = np.radians(90 + PAN_FILLET[1] + fraction * (a2 - 90 - PAN_FILLET[1]))
    d = np.array([np.cos(a), np.sin(a)])
    q = c2 + (PAN_FLARE[0] + side * PAN_THICKNESS / 2) * d
    n = side * d
    return np.array([q[0], 0, q[1]]), np.array([n[0], 0, n[1]])


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


def cubic(points, count: int) -> np.ndarray:
    """Points on one cubic Bezier curve."""
    return bernstein(np.linspace(0, 1, count + 1)) @ np.asarray(points, float)


def frame_to(axis) -> np.ndarray:
    """A rotation which takes the z axis to the given direction."""
    z = normalize(np.asarray(axis, float))
    x = normalize(np.cross([0.0, 1.0, 0.0], z))
    return np.stack([x, np.cross(z, x), z], 1)


def make_pan() -> None:
    save("pan", revolve(pan_profile(), 320))

    # The handle lies in the (x, z) plane. A steel tang rises from the flank into a wooden grip.
    root, normal = flank_point(0.62, -1)
    a = np.array([root[0], root[2]]) - 0.02 * np.array([normal[0], normal[2]])
    joint, end = a + [1.05, 0.42], a + [4.15, 0.98]
    slope = normalize(end - joint)
    path = cubic([a, a + [0.4, 0.0], joint - 0.35 * slope, joint + 0.06 * slope], 20)
    t = np.linspace(0, 1, len(path))[:, None]
    bell = 0.5 - 0.5 * np.cos(np.pi * np.clip(t / 0.55, 0, 1))
    size = np.concatenate([0.36 - 0.15 * bell, 0.10 + 0.05 * bell], 1)
    save("pan_tang", sweep(path, size, 40, 2.6, 5))

    path = cubic([joint, joint + 1.2 * slope, end - [1.2, 0.12], end], 32)
    t = np.linspace(0, 1, len(path))[:, None]
    swell = np.sin(np.pi * np.clip(t, 0, 1)) ** 2
    width = 0.225 + 0.055 * swell + 0.05 * t**2
    size = np.concatenate([width, 0.165 + 0.035 * swell + 0.0 * t], 1)
    save("pan_grip", sweep(path, size, 40, 2.4, 7))


def make_egg() -> None:
    """An egg which lies on its side along x, about 1.15 long and 0.86 wide, centred on its axis."""
    a = np.linspace(0, np.pi, 33)
    taper = 0.13
    r = 0.43 * np.sin(a) * (1 - taper * np.cos(a))
    z = 0.575 * np.cos(a)
    dr = 0.43 * (np.cos(a) * (1 - taper * np.cos(a)) + taper * np.sin(a) ** 2)
    dz = -0.575 * np.sin(a)
    n = normalize(np.stack([-dz, dr], 1))
    r[[0, -1]] = 0
    profile = np.concatenate([np.stack([r, z], 1), n], 1)
    save("egg", revolve(profile, 48).transformed(frame_to([1.0, 0.0, 0.0])))


def make_cloth() -> None:
    """A folded napkin, 3.2 x 2.4: a cushion-like slab with a second layer and soft ripples."""
    # Samples are denser towards the edges, where the surface bends down to the table.
    a = np.sin(np.pi / 2 * np.linspace(-1, 1, 43))
    x, y = np.meshgrid(a, a)

    def surface(x, y):
        def plateau(d):
            return np.sqrt(np.clip(1 - np.abs(d) ** 16, 0, 1))

        fold = 0.5 - 0.5 * np.tanh(9.0 * (y - 0.22 - 0.05 * np.sin(2.2 * x + 0.5)))
        ripple = 0.022 * np.sin(3.1 * x + 2.0 * np.sin(1.7 * y)) + 0.014 * np.sin(5.3 * y + 2 * x)
        height = plateau(x) * plateau(y) * (0.10 + 0.09 * fold + ripple)
        px = 1.6 * x + 0.05 * np.sin(2.7 * y + 1)
        py = 1.2 * y + 0.05 * np.sin(2.3 * x)
        return np.stack([px, py, height], -1)

    # Differences inside the square: the slope at the very edge is infinite.
    h, inside = 2e-3, 0.995
    xi, yi = x * inside, y * inside
    du = surface(xi + h, yi) - surface(xi - h, yi)
    dv = surface(xi, yi + h) - surface(xi, yi - h)
    uv = np.stack([1.6 * x, 1.2 * y], -1)
    save("cloth", grid(surface(x, y), normalize(np.cross(du, dv)), uv))


def make_backdrop() -> None:
    """A studio sweep: floor towards -y, a quarter circle, wall upwards; 1 x 1 tiles in its uv."""
    half, front, back, radius, top = 20.0, -20.0, 12.0, 5.0, 20.0
    a = np.radians(np.linspace(0, 90, 25))
    y = np.concatenate([[front], back - radius + radius * np.sin(a), [back]])
    z = np.concatenate([[0], radius - radius * np.cos(a), [top]])
    ny = np.concatenate([[0], -np.sin(a), [-1]])
    nz = np.concatenate([[1], np.cos(a), [0]])
    length = front + np.concatenate([[0], np.cumsum(np.hypot(np.diff(y), np.diff(z)))])
    x = np.array([-half, half])
    p = np.stack([np.tile(x, (len(y), 1)), np.tile(y, (2, 1)).T, np.tile(z, (2, 1)).T], -1)
    n = np.stack([np.zeros((len(y), 2)), np.tile(ny, (2, 1)).T, np.tile(nz, (2, 1)).T], -1)
    uu, vv = np.meshgrid(x, length)
    save("backdrop", grid(p, n, np.stack([uu, vv], -1)))


# --------------------------------------------------------------------------------------------------
# Textures
# --------------------------------------------------------------------------------------------------


def noise(shape, cells, rng) -> np.ndarray:
    """Periodic value noise in [-1, 1] with the given number of cells (rows, columns)."""
    lattice = rng.uniform(-1, 1, cells)
    out = lattice
    for axis in (0, 1):
        x = np.arange(shape[axis]) * cells[axis] / shape[axis]
        i = np.floor(x).astype(int)
        w = x - i
        w = w * w * (3 - 2 * w)
        a, b = np.take(out, i % cells[axis], axis), np.take(out, (i + 1) % cells[axis], axis)
        w = w[:, None] if axis == 0 else w[None]
        out = a * (1 - w) + b * w
    return out


def write_png(name: str, srgb: np.ndarray) -> None:
    """Write sRGB values in [0, 1]; PNG so that the texture is exact."""
    image = np.ascontiguousarray(np.round(np.clip(srgb, 0, 1) * 255).astype(np.uint8))
    path = TEXTURES / f"{name}.png"
    mi.Bitmap(image).write(str(path))
    print(
        f"{path.name:20s} {image.shape[1]}x{image.shape[0]}  {path.stat().st_size / 1024:.1f} KiB"
    )


def ramp(t: np.ndarray, dark, light, levels: int = 22) -> np.ndarray:
    """Colour ramp in few steps: invisible under the grain, but it keeps the PNG small."""
    t = np.round(np.clip(t, 0, 1) * levels)[..., None] / levels
    return np.asarray(dark) * (1 - t) + np.asarray(light) * t


def make_planks() -> None:
    """Four planks of light wood, grain along u; periodic in both directions."""
    rng = np.random.default_rng(3)
    size, planks = 768, 4
    width = size // planks
    image = np.empty((size, size, 3))
    for k in range(planks):
        shape = (width, size)
        fibre = noise(shape, (96, 6), rng) * 0.5 + noise(shape, (160, 24), rng) * 0.4
        wave = noise(shape, (3, 2), rng) * 1.3 + noise(shape, (9, 4), rng) * 0.25
        rings = np.sin(2 * np.pi * (np.linspace(0, 6.0, width)[:, None] + 2.0 * wave))
        t = 0.60 + 0.12 * rings + 0.22 * fibre + rng.uniform(-0.15, 0.15)
        wood = ramp(t, (0.47, 0.34, 0.23), (0.85, 0.71, 0.54))
        edge = np.minimum(np.arange(width), np.arange(width)[::-1])
        wood *= np.clip(0.40 + 0.30 * edge, 0, 1)[:, None, None]  # the gap between the planks
        image[k * width : (k + 1) * width] = np.roll(wood, rng.integers(size), axis=1)
    write_png("planks", image)


def make_grip_wood() -> None:
    """Fine dark wood for the grip of the pan; grain along u."""
    rng = np.random.default_rng(5)
    shape = (128, 256)
    t = 0.5 + 0.35 * noise(shape, (48, 4), rng) + 0.2 * noise(shape, (64, 16), rng)
    t += 0.2 * noise(shape, (6, 2), rng)
    write_png("grip_wood", ramp(t, (0.13, 0.075, 0.05), (0.33, 0.20, 0.13)))


def make_linen() -> None:
    """Blue linen with two light stripes; the period covers the whole napkin in v."""
    rng = np.random.default_rng(11)
    size = 256
    y, x = np.mgrid[:size, :size]
    weave = 0.5 * noise((size, size), (128, 8), rng) + 0.5 * noise((size, size), (8, 128), rng)
    t = 0.5 + 0.35 * weave + 0.12 * ((x + y) % 2 - 0.5)
    blue = ramp(t, (0.22, 0.30, 0.38), (0.42, 0.51, 0.60), 14)
    light = ramp(t, (0.70, 0.68, 0.63), (0.90, 0.88, 0.83), 14)
    v = y / size
    stripe = (np.abs(v - 0.36) < 0.03) | (np.abs(v - 0.455) < 0.012)
    write_png("linen", np.where(stripe[..., None], light, blue))


def make_tiles() -> None:
    """2 x 2 cement tiles in two colours with a light joint; periodic in both directions."""
    rng = np.random.default_rng(7)
    size, half = 384, 192
    y, x = np.mgrid[:size, :size]
    tile = (x // half + y // half) % 2
    edge = np.minimum.reduce([x % half, half - 1 - x % half, y % half, half - 1 - y % half])
    cloud = 0.5 * noise((size, size), (6, 6), rng) + 0.3 * noise((size, size), (24, 24), rng)
    cloud += 0.25 * noise((size, size), (128, 128), rng)
    t = np.clip(0.5 + 0.5 * cloud, 0, 1)
    image = np.where(
        tile[..., None] == 1,
        ramp(t, (0.26, 0.35, 0.42), (0.36, 0.45, 0.51)),
        ramp(t, (0.76, 0.72, 0.65), (0.88, 0.85, 0.79)),
    )
    joint = np.clip((edge - 1.0) / 2.0, 0, 1)[..., None]
    write_png("tiles", image * joint + np.array([0.62, 0.60, 0.56]) * (1 - joint))


def main() -> None:
    MESHES.mkdir(exist_ok=True)
    TEXTURES.mkdir(exist_ok=True)
    make_teapot()
    make_pan()
    make_egg()
    make_cloth()
    make_backdrop()
    make_planks()
    make_grip_wood()
    make_linen()
    make_tiles()


if __name__ == "__main__":
    main()
