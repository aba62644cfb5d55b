"""A scene without anisotropy compiles the very same kernels as with ``kernel=isotropic``."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
from aniso_pm.rendering.history import recorded

from . import rooms
from .row import Row


def hashes(scene, kernel: str) -> set[str]:
    """Of all kernels of a small rendering of the scene, the second: what is replayed turns numbers
    of a scene into arrays, which later renderings find."""
    integrator = {
        "type": "aniso_pm",
        "map": "global",
        "kernel": kernel,
        "photon_count": 4096,
        "initial_radius": 0.1,
    }
    integrator = mi.load_dict(integrator)
    dr.eval(mi.render(scene, integrator=integrator, spp=1))
    with recorded() as records:
        dr.eval(mi.render(scene, integrator=integrator, spp=1))
        return {k["hash"] for k in records()}


def measure(quick: bool) -> Iterator[Row]:
    plain, metal = (mi.load_dict(make(16)) for make in (rooms.room, rooms.brushed_back))
    for name, scene, target in (("diffuse room", plain, ("<=", 0)), ("brushed wall", metal, None)):
        found = {kernel: hashes(scene, kernel) for kernel in ("anisotropic", "isotropic")}
        differ = found["anisotropic"] ^ found["isotropic"]
        yield Row(
            f"kernels: compiled for one kernel type but not the other, {name}",
            len(differ),
            "kernels",
            target,
            f"{len(found['anisotropic'])} kernels with kernel=anisotropic, "
            f"{len(found['isotropic'])} with kernel=isotropic",
        )
