"""Light paths/s of photon tracing against camera paths/s of Mitsuba's ``path``.

Same scene, same number of paths, same ``max_depth`` and ``rr_depth``; photons are stored, but not
yet indexed; ``path`` traces its rays from the camera on, into no film.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings

from . import rooms
from .row import Row
from .timing import interleaved, run

DEPTH, ROULETTE = 8, 3  # light paths begin theirs no later


def measure(quick: bool) -> Iterator[Row]:
    count, repetitions = (1 << 17, 3) if quick else (1 << 20, 5)
    scenes = {"diffuse room": rooms.room, "room with glass and metal": rooms.glass_and_metal}
    for name, make in scenes.items():
        yield _against_path(name, mi.load_dict(make(64)), count, repetitions)


def _against_path(name: str, scene, count: int, repetitions: int) -> Row:
    settings = Settings(map="global", photon_count=count, max_depth=DEPTH, rr_depth=ROULETTE)
    prepared = prepare(scene, settings, False)
    stored = prepared.photon_map(0, 0).stored
    path = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": ROULETTE})
    sensor, sampler = scene.sensors()[0], mi.load_dict({"type": "independent"})

    def photons() -> float:
        laps = {}
        dr.sync_thread()
        began = time.perf_counter()

        def lap(stage):
            laps[stage] = time.perf_counter() - began

        prepared.photon_map(0, 0, stored, lap=lap)
        return laps["photons"]

    def paths():
        sampler.seed(0, count)
        u, v = sampler.next_2d(), sampler.next_2d()
        ray, weight = sensor.sample_ray_differential(mi.Float(0), mi.Float(0.5), u, v)
        return weight * path.sample(scene, sampler, ray)[0]

    times = interleaved({"photons": photons, "path": lambda: run(paths)}, repetitions)
    return Row(
        f"trace: light paths against path's, {name}",
        times["path"].best / times["photons"].best,
        "×",
        (">=", 0.8),
        f"max_depth {DEPTH}, rr_depth {ROULETTE}, {count:g} paths each, {stored / count:.2f} "
        f"photons stored a light path, best of {repetitions}: "
        f"photons {_speed(count, times['photons'])}, path {_speed(count, times['path'])}",
    )


def _speed(count, times) -> str:
    return f"{count / times.best * 1e-6:.3g} M/s, {times}"
