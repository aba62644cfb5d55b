"""Error against run time as installed: what somebody gets who sets nothing.

Relative MSE of ``path`` over that of the plain ``<integrator type="aniso_pm"/>`` after equal
seconds, above 1 where the photon mapper wins, on each scene of the gallery at 160 × 120, or at
640 × 480 (``large``).
``path`` has the scene's sampler (in the gallery a stratified one); ``max_depth`` and
``hide_emitters`` are the scene's. Seeds run in turn, compilation is not counted. Beside it stand
variance, bias² and energy, and the reference's own error: an error within ten times of that is
limited by the reference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from aniso_pm.errors import InputError
from aniso_pm.instruments import gallery
from aniso_pm.instruments.report import metrics, reference, regions, runs
from aniso_pm.instruments.report.methods import Method
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings

from .row import Row

BUDGETS = (3.0, 12.0)
SEEDS = 5
# Goals of ratios of the whole picture, and of pixels that owe a quarter of their light to caustics.
GOALS = {
    "brushed_wall": 6.0,
    "far_close": 2.0,
    "fry_pan": 1.0,
    "glass_balls": 3.0,
    "plain_room": 0.95,
    "teapot": 2.5,
}
CAUSTIC_GOAL = 8.0
_SIZE = {"width": "160", "height": "120"}
# Pictures of the usual size: as many seconds take fewer samples a pixel.
LARGE_BUDGETS, LARGE_SEEDS = (5.0, 20.0), 3
LARGE = {"width": "640", "height": "480"}
_REGION_SEED, _WARM_SEED = 7001, 7002


@dataclass(frozen=True)
class _Stage(runs.Stage):
    """As installed: no parameter but the limits of path length."""

    def parameters(self, method: Method, radius: float | None) -> dict[str, Any]:
        return self.limits | method.plugin


def measure(
    quick: bool,
    files: list[Path] | None = None,
    plugins: dict[str, dict[str, Any]] | None = None,
    defines: dict[str, str] | None = None,
) -> Iterator[Row]:
    """Rows of the gallery, or of other scenes that have references, in the size of their films.

    quick    one second and three seeds only.
    plugins  name → plugin, photon mappers to be compared with ``path``; None: as installed, and
             with ``kernel=isotropic``.
    defines  parameters of the other scenes.
    """
    budgets, seeds = ((1.0,), 3) if quick else (BUDGETS, SEEDS)
    size = (defines or {}) if files else _SIZE
    for file in files or [scene.file for scene in gallery.scenes()]:
        yield from _rows("error", Path(file), list(budgets), seeds, plugins, size)


def measure_large(quick: bool) -> Iterator[Row]:
    """Rows of the gallery at 640 × 480, as installed. quick: none."""
    if quick:
        yield Row("large: path over as installed", None, "×", None, "too slow for --quick")
        return
    for scene in gallery.scenes():
        plugins: dict[str, dict[str, Any]] = {"as installed": {}}
        file, budgets = Path(scene.file), list(LARGE_BUDGETS)
        yield from _rows("large", file, budgets, LARGE_SEEDS, plugins, LARGE)


def _rows(group: str, file: Path, *given: Any) -> Iterator[Row]:
    """given: as of ``_scene``. A scene without reference of that size is a row that says so."""
    try:
        yield from _scene(group, file, *given)
    except InputError as error:
        yield Row(f"{group}: {file.stem}", None, "×", None, str(error))


def _scene(
    group: str, file: Path, budgets, seeds: int, plugins, size: dict[str, str]
) -> Iterator[Row]:
    world = mi.load_file(str(file), optimize=False, **size)
    sensor = world.sensors()[0]
    found = reference.require(file, world, sensor)
    limits = {
        k: v for k, v in reference.path_limits(world.integrator()).items() if v not in (-1, False)
    }
    stage = _Stage(world, sensor, {}, limits, 0, 64)
    prepared = prepare(world, Settings(), False)
    masks = regions.find(prepared, sensor, found.mean, _REGION_SEED)
    masks.pop(regions.ANISOTROPIC, None)
    if plugins is None:
        plugins = {"as installed": {}}
        if prepared.follow_lobes:
            plugins["kernel=isotropic"] = {"kernel": "isotropic"}
    methods = {"path": Method("path", {"type": "path"})}
    for name, plugin in plugins.items():
        methods[name] = Method(name, {"type": "aniso_pm"} | plugin, "default")

    # --- All of one seed before the next ---
    for method in methods.values():
        if size is LARGE:  # as warm as budgets need it: whole passes would take longer
            runs.run(stage, method, None, _WARM_SEED, budgets[:1])
        else:
            runs.warm_up(stage, method, None, _WARM_SEED)
    done: dict[str, list[runs.Run]] = {name: [] for name in methods}
    for seed in range(seeds):
        for name, method in methods.items():
            done[name].append(runs.run(stage, method, None, seed, budgets))

    weight = metrics.weights(found.halves)
    for k, budget in enumerate(budgets):
        for region, mask in masks.items():
            own = metrics.reference_error(found.halves, mask, weight)
            tables = {}
            for name, each in done.items():
                images = np.stack([run.images[k] for run in each])
                tables[name] = metrics.products(images, found.halves, mask, weight)
            for name in plugins:
                title = f"{group}: {file.stem}, {budget:g} s, {region}: path over {name}"
                goal = _goal(file.stem, region, name) if size is _SIZE else None
                late = sum(run.passes[k] == 0 for run in done[name])
                if late:
                    note = (
                        f"in {late} of {seeds} runs the pilot and a first pass took longer than "
                        f"{budget:g} s; reference's own error {own:.1e}"
                    )
                    yield Row(title, None, "×", goal, note)
                    continue
                images = np.stack([run.images[k] for run in done[name]])
                ratio = metrics.ratio(tables["path"], tables[name])
                yield Row(
                    title,
                    ratio.value,
                    "×",
                    goal,
                    _note(ratio, tables, name, images, found, mask, own, done[name], k),
                )


def _goal(scene: str, region: str, name: str):
    if name != "as installed":
        return None
    goal = CAUSTIC_GOAL if region == regions.CAUSTIC else GOALS.get(scene)
    return (">=", goal) if goal else None


def _note(ratio, tables, name, images, found, mask, own, each, k) -> str:
    table, path = tables[name], tables["path"]
    energy = metrics.energy(images, found.halves, mask)
    limited = ", limited by the reference" if metrics.mse(table) < metrics.CLEAR * own else ""
    return (
        f"95 % {ratio.low:.2f} to {ratio.high:.2f}, {len(table)} seeds; relative MSE "
        f"{metrics.mse(table):.2e} (variance {metrics.variance(table):.2e}, bias² "
        f"{metrics.bias2(table):.2e}, energy {energy.value:.4f} ± "
        f"{(energy.high - energy.low) / 2:.4f}), path {metrics.mse(path):.2e}; "
        f"{np.mean([run.passes[k] for run in each]):.0f} passes, "
        f"{np.mean([run.spp[k] for run in each]):.0f} spp; reference's own error {own:.1e}{limited}"
    )
