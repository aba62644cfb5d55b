"""Generate the textures of the gallery, the same in each run: ``python tools/make_textures.py``."""

import mitsuba as mi
import numpy as np
from mesh import SCENES

mi.set_variant("scalar_rgb")  # only used to write images

TEXTURES = SCENES / "textures"


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


if __name__ == "__main__":
    TEXTURES.mkdir(exist_ok=True)
    make_planks()
    make_grip_wood()
    make_linen()
    make_tiles()
