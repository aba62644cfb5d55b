"""The report from end to end: scenes in, ``results.json``, figures and ``index.html`` out."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
from aniso_pm.errors import InputError, one_line
from aniso_pm.instruments.doctor import versions
from aniso_pm.pictures import denoising
from aniso_pm.rendering.film import pixel_weights

from . import page, pictures, reference, results
from .cells import Store
from .denoised import boxed
from .experiment import measure
from .machine import describe
from .methods import parse_all
from .plan import Plan


@dataclass(frozen=True)
class Report:
    """A finished report.

    results  everything, as in ``results.json`` (see ``results.schema.json``).
    page     the file ``index.html``.
    stale    cells found in the directory that did not fit and were made again.
    """

    results: dict[str, Any]
    page: Path
    stale: list[str]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table: one dictionary for each scene, method, region and budget."""
        return self.results["rows"]

    @property
    def ratios(self) -> list[dict[str, Any]]:
        """Paired ratios of relative MSE at equal time."""
        return self.results["ratios"]


def load(file: Path, defines: Mapping[str, str], sensor: int):
    """Scene and sensor. Raises InputError."""
    try:
        world = mi.load_file(str(file), optimize=False, **defines)
    except RuntimeError as error:
        raise InputError(f"{file}: {one_line(error)}") from error
    if sensor >= len(world.sensors()):
        raise InputError(
            f"{file}: no sensor {sensor}; the scene has {len(world.sensors())}, from 0"
        )
    return world, world.sensors()[sensor]


def report(
    scenes: Sequence[str | Path],
    directory: str | Path,
    plan: Plan | None = None,
    defines: Mapping[str, str] | None = None,
    sensor: int = 0,
    progress: Callable[[float, float, str], None] | None = None,
) -> Report:
    """Measure error against run time and write the report, in the current variant.

    scenes     XML files; each needs a reference (see ``reference.find``).
    directory  gets ``results.json``, ``index.html``, ``figures/`` and ``cells/``; made if it is not
               there. Runs that are in ``cells/`` already, and were of the same scene, parameters,
               versions and processor, are not repeated.
    plan       what to run; default: ``Plan()``.
    defines    parameters $KEY of the scenes.
    sensor     index of the camera.
    progress   called as progress(done, total, text) after each run, in seconds that were planned
               for runs; the total is a guess.

    Raises InputError, before anything is run, for scenes and methods that cannot be used. What
    fails later is in the results (``failures``) and does not stop the rest.
    """
    plan, defines = plan or Plan(), dict(defines or {})
    files, directory = [Path(scene) for scene in scenes], Path(directory)
    began, about = time.perf_counter(), {"machine": describe()}
    _check(files, plan, defines, sensor)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into '{directory}': {error.strerror or error}") from error

    store = Store(directory / "cells")
    total = len(files) * expected_seconds(plan)
    done = 0.0

    def tick(seconds: float, text: str) -> None:
        nonlocal done
        done += seconds
        if progress:
            progress(done, max(total, done), text)

    parts, figures, found, path = [], {}, {}, directory
    for file in files:
        world, camera = load(file, defines, sensor)
        wide = pixel_weights(camera.film()) != [1.0]
        box = partial(_boxed, file, defines, sensor) if plan.denoise and wide else None
        measured = measure(file, world, camera, plan, store, tick, box)
        parts.append(results.of_scene(measured, plan))

        # --- The report so far: what comes later may fail ---
        about |= {
            "quick": plan.quick,
            "variant": mi.variant(),
            "versions": versions(),
            "defines": defines,
            "seconds": time.perf_counter() - began,
        }
        found = results.table(parts, plan, about)
        panels = pictures.panels(measured, len(plan.times) - 1)
        figures[measured.name] = page.write_figures(directory, found, found["scenes"][-1], panels)
        path = page.write_page(directory, found, figures)
        # The materials of a scene that is still there would be part of the next one's kernels.
        del world, camera, measured, box
        gc.collect()
    return Report(found, path, store.stale)


def _boxed(file: Path, defines: Mapping[str, str], sensor: int):
    """Scene and sensor with a box filter."""
    world = boxed(file, defines)
    return world, world.sensors()[sensor]


def expected_seconds(plan: Plan) -> float:
    """Time of all runs on one scene, without compilation: a guess, because the number of bandwidths
    that a sweep tries is not known before, nor which methods a scene can do without."""
    methods = parse_all(plan.methods)
    sweeps = sum(method.bandwidth == "best" for method in methods)
    tried = 6 if plan.fine else 4
    times = sum(size.sweep_seconds for size in plan.sizes.values())
    runs = len(methods) * plan.seeds * (2 if plan.denoise else 1)
    return runs * plan.seconds + sweeps * tried * plan.sweep_seeds * times


def _check(files: list[Path], plan: Plan, defines, sensor: int) -> None:
    """Find out what would fail, before anything slow."""
    if not files:
        raise InputError("report: no scenes; name at least one")
    names = [file.stem for file in files]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"report: two scenes are called '{name}'; rename one of the files")
    parse_all(plan.methods)
    if plan.denoise:
        denoising.check_installed()
    for file in files:
        if not file.is_file():
            raise InputError(f"{file}: there is no such file")
    for file in files:
        world, camera = load(file, defines, sensor)
        reference.require(file, world, camera)
        del world, camera
    gc.collect()
