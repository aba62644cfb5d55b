"""Generate the meshes of the gallery: ``python tools/make_meshes.py``.

Nothing is random between runs (fixed seeds), so the files are reproducible.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from mesh import (
    MESHES,
    Mesh,
    arc,
    bernstein,
    cubic,
    frame_to,
    grid,
    join,
    line,
    normalize,
    revolve,
    save,
    sweep,
)

HERE = Path(__file__).resolve().parent

# --------------------------------------------------------------------------------------------------
# Teapot
# --------------------------------------------------------------------------------------------------


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


def make_fins() -> None:
    """Upright strips along y, in rows that are spaced like a bar code and broken at random."""
    rng = np.random.default_rng(7)
    height, length = 0.12, 0.3
    x = np.cumsum(rng.choice([0.12, 0.2, 0.32], 22))
    x = x[x < 3.2] - 1.6
    strips = []
    for at in x:
        for y in np.arange(-9.0, -0.1, length):
            if rng.random() < 0.6:
                p = np.array([[at, y + length * a, height * b] for b in (0, 1) for a in (0, 1)])
                uv = np.array([[a, b] for b in (0, 1) for a in (0, 1)], float)
                n = np.tile([1.0, 0, 0], (4, 1))
                strips.append(Mesh(p, n, uv, np.array([[0, 1, 3], [0, 3, 2]])))
    save("fins", Mesh.merge(*strips))


if __name__ == "__main__":
    MESHES.mkdir(exist_ok=True)
    make_teapot()
    make_pan()
    make_egg()
    make_cloth()
    make_backdrop()
    make_fins()
