"""Memory of a photon map while it is built, and of a rendering that fills a machine.

Every figure comes from a process of its own: what an earlier one has left in Dr.Jit's cache of
freed memory would hide what is needed. Resident memory is what a machine must have; Dr.Jit's own
peak is printed too, because on a GPU it is what counts: it rounds blocks up to powers of two.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from .row import Row

_STATUS = Path("/proc/self/status")
_GIB = 2.0**30


def measure(quick: bool) -> Iterator[Row]:
    if not _STATUS.is_file():
        yield Row("memory", None, "bytes", None, "resident memory can be read on Linux only")
        return
    for light_paths in (1_200_000,) if quick else (1_200_000, 5_000_000):
        yield from _map_rows(in_process("map_memory", light_paths))
    if not quick:
        yield _large_row(in_process("large_memory"))


def _map_rows(found: dict[str, Any]) -> Iterator[Row]:
    stored, target = found["stored"], ("<=", 64)
    on_gpu = mi.variant().startswith("cuda_")
    yield Row(
        f"memory: peak while a map of {stored * 1e-6:.2g} M photons is built, index included",
        found["resident"] / stored,
        "B/photon",
        None if on_gpu else target,
        f"resident memory, above that before; diffuse room, {stored} photons, second of two maps "
        f"(room for them known); at rest {found['at_rest']:.0f} B; peak of the first map "
        f"{found['first'] / stored:.1f} B; every block takes whole pages, where huge ones of 2 MB",
    )
    yield Row(
        "memory: the same by Dr.Jit's allocator, blocks rounded up to powers of two",
        found["watermark"] / stored,
        "B/photon",
        target if on_gpu else None,
        "first and second map",
    )


def _large_row(found: dict[str, Any]) -> Row:
    return Row(
        "memory: 3e7 photons, 4096×4096 film, 1 spp",
        found["resident"] / _GIB,
        "GiB",
        ("<=", 24),
        f"peak resident memory of the process; {found['stored']} photons from "
        f"{found['light_paths']} light paths, {found['seconds']:.0f} s",
    )


def in_process(function: str, *arguments) -> dict[str, Any]:
    code = (
        "import aniso_pm, json, mitsuba as mi; "
        f"mi.set_variant('{mi.variant()}'); from aniso_pm.instruments.bench import memory; "
        f"print(json.dumps(memory.{function}(*{arguments!r})))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"measuring memory failed: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _resident(key: str) -> int:
    """Resident memory of this process now ("VmRSS") or at its peak ("VmHWM"), bytes."""
    lines = _STATUS.read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith(key)))


def _forget_peak():
    dr.sync_thread()
    dr.flush_malloc_cache()
    Path("/proc/self/clear_refs").write_text("5")


def map_memory(light_paths: int) -> dict[str, Any]:
    """Peak of building a map of the diffuse room, in this process, bytes."""
    from aniso_pm.rendering.prepared import prepare
    from aniso_pm.rendering.settings import Settings

    from . import rooms

    scene = mi.load_dict(rooms.room(16))
    prepared = prepare(scene, Settings(map="global", photon_count=light_paths, max_depth=6), False)
    # Compilers need memory of their own: once, for kernels, not for photons.
    prepared.with_(photon_count=1024).photon_map(0, 0)

    peaks, stored = [], 0
    for _ in range(2):
        _forget_peak()
        before = _resident("VmRSS")
        map_ = prepared.photon_map(0, 0, stored + stored // 8)
        dr.sync_thread()
        peaks.append(_resident("VmHWM") - before)
        stored, at_rest = map_.stored, prepared.bytes_per_photon
        del map_
    watermark = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    return {
        "stored": stored,
        "at_rest": at_rest,
        "first": peaks[0],
        "resident": peaks[1],
        "watermark": watermark,
    }


def large_memory() -> dict[str, Any]:
    """Peak of a rendering with 3e7 stored photons and 4096×4096 pixels, in this process, bytes."""
    import time

    from . import rooms

    scene = mi.load_dict(rooms.room(4096))
    integrator = {
        "type": "aniso_pm",
        "map": "global",
        "photon_count": 14_000_000,
        "initial_radius": 0.002,
        "max_depth": 6,
    }
    integrator = mi.load_dict(integrator)
    began = time.perf_counter()
    # Not mi.render(): it hides errors.
    dr.eval(integrator.render(scene, sensor=scene.sensors()[0], seed=0, spp=1))
    dr.sync_thread()
    return {
        "resident": _resident("VmHWM"),
        "stored": integrator.statistics["photons_stored"],
        "light_paths": integrator.statistics["photons_emitted"],
        "seconds": time.perf_counter() - began,
    }
