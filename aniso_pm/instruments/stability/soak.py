"""Many renders in one process, with changes of variant: memory stays, pictures stay."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .case import Case, LeftOut, Measured
from .worlds import plate, room

RENDERS, EVERY, WARM_UP = 500, 25, 100
_OTHER = "llvm_ad_mono"


def resident() -> int:
    """Bytes of this process that are in memory."""
    statistics = Path("/proc/self/statm")
    if not statistics.exists():
        raise LeftOut("reads memory from /proc, which this system does not have")
    return int(statistics.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _render(seed):
    scene = mi.load_dict(room(lambda p: {"plate": plate(p)}, size=12))
    integrator = mi.load_dict({"type": "aniso_pm", "photon_count": 2000, "passes": 2})
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=seed), np.float64)


def soak(renders=RENDERS, every=EVERY, warm_up=WARM_UP) -> tuple[float, float]:
    """(growth of memory after the first ``warm_up`` renders in MiB, largest relative difference
    of a picture from the first one of its variant and seed)."""
    before = mi.variant()
    other = _OTHER if _OTHER in mi.variants() and before != _OTHER else before
    first: dict[tuple, np.ndarray] = {}
    worst, at_start = 0.0, 0
    try:
        for i in range(renders):
            if i % every == 0:
                mi.set_variant((before, other)[i // every % 2])
            key = mi.variant(), i % 5
            image = _render(key[1])
            known = first.setdefault(key, image)
            worst = max(worst, float(np.abs(image - known).max() / known.mean()))
            if i + 1 == warm_up:
                at_start = _settled()
        return (_settled() - at_start) / 2**20, worst
    finally:
        mi.set_variant(before)


def _settled() -> int:
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    return resident()


def _memory() -> Measured:
    grown, worst = soak()
    words = f"{RENDERS} renders, a change of variant every {EVERY}: {grown:+.1f} MiB, "
    # Pictures differ by the order of sums alone.
    same = worst < 1e-3
    return Measured(
        max(grown, 0.0) if same else float("nan"), f"{words}pictures within {worst:.1g}"
    )


def cases() -> list[Case]:
    return [
        Case(
            "soak",
            f"{RENDERS} renders with changes of variant",
            "growth of memory, MiB",
            20.0,
            _memory,
            slow=True,
        )
    ]
