"""Time of one whole pass with anisotropic kernels against discs of the same area.

Over scenes in which at least a fifth of the gathers are anisotropic: same photons, same eye paths,
same radius.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import mitsuba as mi

from . import rooms
from .row import Row
from .timing import interleaved, run

BOUND = 1.10
ENOUGH = 0.2
# Bandwidth for about 60 photons a kernel (the integrator's own aim) with so many light paths.
RADIUS, LIGHT_PATHS = 0.011, 250_000


def measure(quick: bool) -> Iterator[Row]:
    size, spp, photons, repetitions = (64, 8, 50_000, 3) if quick else (192, 16, LIGHT_PATHS, 7)
    made = {
        "brushed wall": rooms.brushed_back,
        "brushed floor": rooms.brushed_floor,
        "brushed ball": rooms.brushed_ball,
    }
    rows = []
    for name, make in made.items():
        scene = mi.load_dict(make(size))
        integrators = {
            kernel: mi.load_dict(
                {
                    "type": "aniso_pm",
                    "kernel": kernel,
                    "photon_count": photons,
                    "initial_radius": RADIUS * (LIGHT_PATHS / photons) ** 0.5,
                }
            )
            for kernel in ("anisotropic", "isotropic")
        }
        tasks = {
            kernel: partial(_seconds, scene, integrator, spp)
            for kernel, integrator in integrators.items()
        }
        times = interleaved(tasks, repetitions)
        found = integrators["anisotropic"].statistics
        share = found["gather_points_anisotropic"] / max(1, found["gather_points"])
        photons_each = found["photons_gathered"] / max(1, found["gather_points"])
        counted = share >= ENOUGH
        row = Row(
            f"pass: anisotropic against isotropic, {name}",
            times["anisotropic"].best / times["isotropic"].best,
            "×",
            ("<=", BOUND) if counted else None,
            f"{share:.0%} of the gathers anisotropic, {photons_each:.0f} photons a gather, "
            f"{size}×{size}, {spp} spp, {photons:g} light paths, best of {repetitions}: "
            f"anisotropic {times['anisotropic']}, isotropic {times['isotropic']}; "
            f"{_stages(*integrators.values())}" + ("" if counted else "; too few to count"),
        )
        yield row
        rows += [row] if counted else []
    if rows:
        worst = max(rows, key=lambda row: row.figure or 0)
        yield Row("pass: the worst of these scenes", worst.figure, "×", ("<=", BOUND), worst.name)


def _seconds(scene, integrator, spp: int) -> float:
    return run(lambda: mi.render(scene, integrator=integrator, spp=spp))


def _stages(anisotropic, isotropic) -> str:
    """Where the time of the last repetition went."""
    a, b = (integrator.statistics["seconds"] for integrator in (anisotropic, isotropic))
    stages = (s for s in a if s in b and max(a[s], b[s]) > 0.01)
    return ", ".join(f"{s} {1000 * a[s]:.0f} and {1000 * b[s]:.0f} ms" for s in stages)
