"""Time that is none of rendering: importing the package, and Python in later passes."""

from __future__ import annotations

import itertools
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator

import mitsuba as mi

from . import rooms
from .row import Row


def measure(quick: bool) -> Iterator[Row]:
    repetitions = 3 if quick else 7
    yield _imports(repetitions)
    yield from _later_passes(20 if quick else 60)


def _imports(repetitions: int) -> Row:
    """Both in processes of their own; set_variant counts, because that is when plugins are made."""
    select = f"import mitsuba as mi; mi.set_variant('{mi.variant()}')"
    codes = {"without": select, "with": f"import aniso_pm; {select}"}
    seconds: dict[str, list[float]] = {name: [] for name in codes}
    for _ in range(1 + repetitions):
        for name, code in codes.items():
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True)
            seconds[name].append(time.perf_counter() - began)
    best = {name: min(s[1:]) for name, s in seconds.items()}
    return Row(
        "startup: import aniso_pm beyond mitsuba's own import",
        best["with"] - best["without"],
        "s",
        ("<", 0.3),
        f"processes of their own, {select}, best of {repetitions}: "
        f"{best['with']:.3f} s with, {best['without']:.3f} s without",
    )


def _later_passes(passes: int) -> Iterator[Row]:
    """With next to nothing to compute, what a pass takes is Python (and launching kernels)."""
    scene = mi.load_dict(rooms.glass_and_metal(4))
    integrator = {
        "type": "aniso_pm",
        "photon_count": 16,
        "initial_radius": 0.1,
        "passes": passes,
    }
    integrator = mi.load_dict(integrator)
    ends = []
    integrator.callback = lambda *_: ends.append(time.perf_counter())
    # The first rendering compiles; the second one records its passes anew, in Python.
    for _ in range(2):
        ends.clear()
        mi.render(scene, integrator=integrator, spp=passes)
    second, *later = (1000 * (b - a) for a, b in itertools.pairwise(ends))
    yield Row(
        "startup: Python in the second pass",
        second,
        "ms",
        ("<", 20),
        "wall time, kernels included, of a pass of 16 light paths and 4×4 pixels, room with glass "
        "and metal; second rendering in this process",
    )
    yield Row(
        "startup: Python in later passes",
        statistics.median(later),
        "ms",
        ("<", 20),
        f"median of {len(later)}, {min(later):.3g} to {max(later):.3g} ms",
    )
