"""Generate the fins of the scene brushed_wall: ``python scenes/make_fins.py``."""

import numpy as np
from make_meshes import Mesh, save


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
    make_fins()
