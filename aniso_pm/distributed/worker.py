"""What runs on the workers: joining, rendering passes, adding sums up.

These are plain functions that Dask calls. A worker keeps the scenes of the last jobs; everything
else comes with a task. Dr.Jit has threads of its own, so that one task at a time renders, on as
many of them as the worker has been given.
"""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .cluster import MEMORY_SHARE
from .parcel import Parcel

# Scenes that a worker keeps.
_KEPT = 2


class Differs(RuntimeError):
    """This worker is not like the client: its pictures would not belong to the same one."""


@dataclass(frozen=True)
class Job:
    """Everything about a rendering but its passes.

    name      of the rendering; the topic of what workers tell.
    parcel    the scene.
    versions  of aniso_pm, mitsuba, drjit at the client; variant: its own.
    scene     hashes of the scene as loaded (``digest``).
    mixed     may workers take the other backend, where they have or lack a CUDA device?
    render    arguments of ``_Rendering``.
    """

    name: str
    parcel: Parcel
    versions: dict[str, str]
    variant: str
    scene: dict[str, Any]
    mixed: bool
    render: dict[str, Any]


def versions() -> dict[str, str]:
    """What has to be the same everywhere."""
    import drjit as dr
    import mitsuba as mi
    from aniso_pm import __version__

    return {"aniso_pm": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__}


def join(job: Job) -> dict[str, Any]:
    """Get ready: versions, variant, scene. Returns what the worker is.

    Raises Differs, OSError where there is no room to unpack the scene.
    """
    return _joined(job).facts


def render(job: Job, passes: list[list[int]], task: str) -> dict[str, Any]:
    """Render passes (half-open ranges). Returns them with their sums: see ``done.Batch``.
    Tells the client when it starts and ends."""
    worker = _Worker()
    with _rendering:
        worker.tell(job, task, "start")
        began = time.perf_counter()
        rendering = _joined(job)
        try:
            batch, compiling = rendering.passes(passes)
        except Exception as error:
            worker.tell(job, task, "failed", reason=_reason(error))
            raise
        first, rendering.used = not rendering.used, True
        seconds = time.perf_counter() - began - compiling
        worker.tell(job, task, "end", seconds=seconds, compiling=compiling, first=first)
    return {
        "passes": batch.passes,
        "arrays": batch.arrays,
        "counts": batch.counts,
        "seconds": batch.seconds,
    }


def add(*parts: dict[str, Any]) -> dict[str, Any]:
    """One for several of what :func:`render` or this function returned."""
    from aniso_pm.rendering.state import added, joined

    first, *others = parts
    arrays = {name: array.copy() for name, array in first["arrays"].items()}
    counts, seconds, passes = first["counts"], first["seconds"], list(first["passes"])
    for part in others:
        for name, array in part["arrays"].items():
            arrays[name] += array
        counts = added(counts, part["counts"])
        seconds = added(seconds, part["seconds"])
        passes += part["passes"]
    return {"passes": joined(passes), "arrays": arrays, "counts": counts, "seconds": seconds}


# --- This process ---

_rendering = threading.RLock()
_jobs: OrderedDict[str, _Rendering] = OrderedDict()


class _Rendering:
    """A job, ready on this worker."""

    def __init__(self, job: Job, worker: _Worker):
        import drjit as dr
        import mitsuba as mi
        from aniso_pm.rendering import progressive
        from aniso_pm.rendering.controls import Controls
        from aniso_pm.rendering.digest import camera_entries, differences, scene_entries
        from aniso_pm.rendering.prepared import prepare
        from aniso_pm.rendering.settings import Settings

        mine = versions()
        for name, version in job.versions.items():
            if mine[name] != version:
                raise Differs(f"it has {name} {mine[name]}, the client has {version}")
        _set_variant(job)
        on_cpu = mi.variant().startswith("llvm")
        if on_cpu:
            # Mitsuba (3.9) waits forever for the lines of an EXR file where there is one thread.
            dr.set_thread_count(max(2, worker.threads))
        world = job.parcel.load(worker.directory)
        if on_cpu:
            dr.set_thread_count(worker.threads)
        sensor = world.sensors()[job.render["sensor"]]
        found = differences(job.scene, scene_entries(world) | camera_entries(sensor))
        if found:
            raise Differs(f"it has loaded another scene than the client: {'; '.join(found[:3])}")
        settings = Settings(**job.render["settings"])
        # A GPU has memory of its own.
        limit = worker.memory if on_cpu else None
        memory = _planned(settings.max_memory, limit, worker.memory_share)
        settings = settings.with_(max_memory=memory)
        prepared = prepare(world, settings, job.render["hide_emitters"])
        settled = job.render["settled"]
        controls = Controls(job.render["first_pass"], settled=settled)
        seed, spp = job.render["seed"], job.render["spp"]
        self.run = progressive.Run(prepared, sensor, seed, spp, controls, {})
        self.run.start()
        self.variance = job.render["variance"]
        self.used = False
        self.facts = {"variant": mi.variant(), "threads": worker.threads, "process": os.getpid()}

    def passes(self, ranges):
        """(Batch of these passes, seconds spent on compilation)."""
        from aniso_pm.rendering.state import numbers

        compiled = self.run.stopping.compiling
        self.run.forget_passes()
        for index in numbers(ranges):
            self.run.render_pass(index)
        batch = self.run.batch()
        names = [n for n in batch.arrays if self.variance or n not in ("square", "cross")]
        # Copies: these arrays lie in Dr.Jit's memory. Dask's thread would give it back, holding
        # Python's lock and waiting for Dr.Jit's, while the thread that renders does the reverse.
        arrays = {name: np.array(batch.arrays[name], copy=True) for name in names}
        return replace(batch, arrays=arrays), self.run.stopping.compiling - compiled


def _joined(job: Job) -> _Rendering:
    with _rendering:
        if job.name not in _jobs:
            worker = _Worker()
            while len(_jobs) >= _KEPT:
                _jobs.popitem(last=False)
            with worker.quiet():
                made = _Rendering(job, worker)
            _jobs[job.name] = made
        _jobs.move_to_end(job.name)
        return _jobs[job.name]


def _planned(given: float, limit: float | None, share: float) -> float:
    """``max_memory`` of a worker, GiB; 0: automatic. given: of all on this machine; limit: that it
    has from elsewhere."""
    from aniso_pm.rendering import memory

    if given or share == 1:
        return share * given or limit or 0.0
    return limit or share * memory.automatic() / memory.GIB


def _set_variant(job: Job) -> None:
    import drjit as dr
    import mitsuba as mi

    variant = job.variant
    if job.mixed:
        kind = "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "llvm"
        variant = f"{kind}_{variant.partition('_')[2]}"
    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise Differs(f"it cannot use the variant {variant}: {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    from aniso_pm.errors import one_line

    return one_line(error)


class _Worker:
    """The Dask worker that this runs on."""

    def __init__(self):
        from distributed import get_worker

        self._worker = get_worker()

    @property
    def threads(self) -> int:
        return self._worker.state.nthreads

    @property
    def directory(self) -> Path:
        return Path(self._worker.local_directory)

    @property
    def memory(self) -> float | None:
        """GiB that a rendering may take: three quarters of the worker's limit, if it has one."""
        limit = self._worker.memory_manager.memory_limit
        return 0.75 * limit / 2**30 if limit else None

    @property
    def memory_share(self) -> float:
        """Part of this machine's memory that is for this worker."""
        import dask

        return dask.config.get(MEMORY_SHARE, 1.0)

    def tell(self, job: Job, task: str, what: str, **more) -> None:
        self._worker.log_event(
            job.name, {"task": task, "what": what, "worker": self._worker.address, **more}
        )

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Mitsuba's warnings are said once, by the client."""
        import mitsuba as mi

        before = mi.logger().log_level()
        mi.set_log_level(mi.LogLevel.Error)
        try:
            yield
        finally:
            mi.set_log_level(before)
