"""What a cluster costs here: one process against two workers, tasks, additions, the way home."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from . import worker

# Films whose sums are measured, and pairs of interleaved runs.
_FILMS = {"640x480": (480, 640), "4096x4096": (4096, 4096)}
_PAIRS = 3
# Passes of a run; the first ones, with all that happens once, are not timed.
_PASSES, _WARM = 24, 4


def measured(say: Callable[[str], Any], workers: int = 2) -> dict[str, Any]:
    """Figures as ``model.Costs`` has them (``costs``), ratios and bytes.

    say: called with a line for each figure.
    """
    import mitsuba as mi
    from aniso_pm.instruments import gallery

    from . import Elsewhere, Options, Parcel
    from .cluster import local

    mi.set_variant("llvm_ad_rgb")
    scene = gallery.directory() / "teapot.xml"
    with local(workers) as client:
        defines = {"width": "320", "height": "240"}
        parcel = Parcel.of(scene, defines)
        world = mi.load_file(str(scene), optimize=False, **defines)
        integrator = world.integrator()

        def rate(elsewhere, passes: int, spp: int) -> float:
            """Passes a second, once all are warm."""
            seen: list[tuple[float, float]] = []

            def note(done, total, text):
                if done == int(done):
                    seen.append((time.perf_counter(), done))

            integrator.elsewhere, integrator.progress = elsewhere, note
            integrator.stop_after(passes)
            integrator.render(world, spp=passes * spp)
            began = next(what for what in seen if what[1] >= _WARM)
            ended = next(what for what in seen if what[1] >= passes)
            return (passes - began[1]) / (ended[0] - began[0])

        # --- One process against the workers, in turn ---
        ratios, alone = [], []
        for _ in range(_PAIRS):
            alone.append(rate(None, _PASSES, 8))
            ratios.append(rate(Elsewhere(client, parcel), _PASSES, 8) / alone[-1])
        say(f"{workers} workers / one process, passes a second: {statistics.median(ratios):.2f} ")
        say(f"  of {min(ratios):.2f} to {max(ratios):.2f}; alone {statistics.median(alone):.2f}/s")

        # --- Tasks of one short pass: what is left is overhead ---
        short = Elsewhere(client, parcel, options=Options(task_seconds=1e-3))
        tasks = 200
        before, wall = time.process_time(), time.perf_counter()
        rate(short, tasks, 1)
        each = (time.process_time() - before) / tasks
        wall = (time.perf_counter() - wall) / tasks
        say(f"a task: {1e3 * each:.1f} ms of processor time of client and scheduler")

    # --- Sums ---
    sums: dict[str, Any] = {}
    for name, shape in _FILMS.items():
        sums[name] = found = _sums(shape)
        say(
            f"{name}: {found['bytes'] / 1e6:.1f} MB a sum; two are added in "
            f"{1e3 * found['add']:.0f} ms"
        )
    small = sums["640x480"]
    return {
        "costs": {
            "task_client": each,
            "add_per_byte": small["add"] / small["bytes"],
        },
        "ratios": ratios,
        "alone": alone,
        "seconds of a short task": wall,
        "bytes of the scene": int(parcel.archive.nbytes),
        "sums": sums,
    }


def _sums(shape: tuple[int, int]) -> dict[str, float]:
    """Bytes of a sum as it travels, and seconds to add two."""
    from distributed.protocol import serialize

    arrays = {name: np.ones((*shape, 4)) for name in ("first", "square", "cross")}
    part = {"passes": [[0, 1]], "arrays": arrays, "counts": {}, "seconds": {}}
    _, frames = serialize(part)
    size = sum(memoryview(frame).nbytes for frame in frames)
    times = []
    for _ in range(3):
        began = time.perf_counter()
        worker.add(part, part | {"passes": [[1, 2]]})
        times.append(time.perf_counter() - began)
    return {"bytes": size, "add": min(times)}
