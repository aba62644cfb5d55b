"""Time that is none of rendering: importing the package, and Python in later passes."""

from __future__ import annotations

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
    yield _later_passes(20 if quick else 60)


def _imports(repetitions: int) -> Row:
    """Both in processes of their own; set_variant counts, because that is when plugins are made."""
    select = f"import mitsuba as mi; mi.set_variant('{mi.variant()}')"
    codes = {"without": select, "with": f"import aniso_pm; {select}"}
    seconds = {name: [] for name in codes}
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


def _later_passes(passes: int) -> Row:
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
    mi.render(scene, integrator=integrator, spp=passes)
    # The first pass compiles; the second may still trace what has changed.
    later = [b - a for a, b in zip(ends[1:], ends[2:], strict=False)]
    return Row(
        "startup: Python in a later pass",
        1000 * statistics.median(later),
        "ms",
        ("<", 20),
        f"wall time of a pass of 16 light paths and 4×4 pixels, room with glass and metal: "
        f"median of {len(later)}, best {1000 * min(later):.3g} ms, worst {1000 * max(later):.3g} ms; "
        f"second pass {1000 * (ends[1] - ends[0]):.3g} ms; kernels included",
    )
