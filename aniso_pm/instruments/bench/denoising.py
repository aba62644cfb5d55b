"""Raw against denoised error of ours, as installed, and of ``path``, after equal seconds.

The gallery at 640 × 480. Ours traces the layers of ``denoising`` while the clock runs; ``path``
renders with a box filter, with albedo and normal of Mitsuba's ``aov``, and the film's own filter is
applied afterwards, to its raw picture as to the denoised one. The filter's own time, which
is the same for both, is in the notes and not in the seconds. Relative MSE as in ``errors``: the
reference has a noise of its own, which its two halves take out in the mean.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np
from aniso_pm.errors import InputError
from aniso_pm.instruments import gallery
from aniso_pm.instruments.report import metrics, reference, runs
from aniso_pm.instruments.report.denoised import boxed
from aniso_pm.instruments.report.methods import Method
from aniso_pm.pictures import denoising

from .row import Row

BUDGETS = (10.0, 40.0)
SEEDS = 2
_SIZE, _QUICK_SIZE = {"width": "640", "height": "480"}, {"width": "160", "height": "120"}
_WARM_SEED = 7003
_SPP = 64  # of a pass, or as many as one has room for
METHODS = (
    Method("ours", {"type": "aniso_pm"}, "default", denoised=True),
    Method("path", {"type": "path"}, denoised=True),
)


def measure(
    quick: bool, files: list[Path] | None = None, size: dict[str, str] | None = None
) -> Iterator[Row]:
    """Rows of the gallery, or of other scenes.

    quick  one scene, small, one second and one seed.
    size   parameters ``width`` and ``height`` of the scenes.
    """
    denoising.check_installed()
    budgets: tuple[float, ...] = BUDGETS
    seeds, default = SEEDS, _SIZE
    scenes = files or [scene.file for scene in gallery.scenes()]
    if quick:
        budgets, seeds, default, scenes = (1.0,), 1, _QUICK_SIZE, scenes[-1:]
    for file in scenes:
        try:
            yield from _scene(Path(file), budgets, seeds, size or default)
        except InputError as error:  # no reference of that size
            yield Row(f"denoise: {Path(file).stem}", None, "×", None, str(error))


def _scene(file: Path, budgets, seeds: int, size) -> Iterator[Row]:
    world = mi.load_file(str(file), optimize=False, **size)
    box = boxed(file, size)
    sensor = world.sensors()[0]
    found = reference.require(file, world, sensor)
    limits = {
        k: v for k, v in reference.path_limits(world.integrator()).items() if v not in (-1, False)
    }
    stage = runs.Stage(world, sensor, {}, limits, 0, _SPP, lambda: (box, box.sensors()[0]))
    weight, mask = metrics.weights(found.halves), np.ones(found.mean.shape[:2], bool)

    def error(images) -> float:
        return metrics.mse(metrics.products(np.stack(images), found.halves, mask, weight))

    # As warm as budgets need it: six whole passes of ours would take longer than they do.
    ours, path = METHODS
    runs.recorded(stage, ours, None, _WARM_SEED, [budgets[0]])
    runs.warm_up(stage, path, None, _WARM_SEED)
    made: dict[str, list] = {method.name: [] for method in METHODS}
    for seed in range(seeds):
        for method in METHODS:
            made[method.name].append(runs.recorded(stage, method, None, seed, list(budgets)))
    for k, budget in enumerate(budgets):
        parts, took = {}, 0.0
        for name, of_seeds in made.items():
            some = [(run, layers[k]) for run, layers in of_seeds if layers[k] is not None]
            if not some:
                continue
            raw = [run.images[k] for run, _ in some]
            began = time.perf_counter()
            blended = [denoising.denoise(run.images[k], known) for run, known in some]
            took = (time.perf_counter() - began) / len(some)
            whole = [denoising.denoise(run.images[k], known, blend=False) for run, known in some]
            spp = np.mean([run.spp[k] for run, _ in some])
            parts[name] = error(raw), error(blended), error(whole), spp
        yield _row(
            file.stem, budget, parts, took, metrics.reference_error(found.halves, mask, weight)
        )


def _row(scene: str, budget: float, parts, took: float, own: float) -> Row:
    name = f"denoise: {scene}, {budget:g} s: path denoised over ours denoised"
    if len(parts) < 2:
        return Row(name, None, "×", None, "no picture in time")
    texts = [
        f"{who} raw {raw:.2e}, denoised {blended:.2e} (filter alone {whole:.2e}), {spp:.0f} spp"
        for who, (raw, blended, whole, spp) in parts.items()
    ]
    note = f"; denoising takes {took:.1f} s; reference's own error {own:.1e}"
    return Row(name, parts["path"][1] / parts["ours"][1], "×", None, "; ".join(texts) + note)
