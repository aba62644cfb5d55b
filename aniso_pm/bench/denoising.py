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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm import denoising, gallery
from aniso_pm.errors import InputError
from aniso_pm.film import pixel_weights
from aniso_pm.report import metrics, reference
from aniso_pm.report.experiment import require_reference

from .row import Row

BUDGETS = (10.0, 40.0)
SEEDS = 2
_SIZE, _QUICK_SIZE = {"width": "640", "height": "480"}, {"width": "160", "height": "120"}
_WARM_SEED = 7003
# Samples per pixel of one call of ``path``.
_CALL = 4


@dataclass
class _Shot:
    """A picture, what was known beside it, samples per pixel."""

    picture: np.ndarray
    layers: dict[str, np.ndarray]
    spp: int


class _Enough(Exception):  # noqa: N818 (not an error)
    """Ends a rendering from its callback."""


def measure(
    quick: bool, files: list[Path] | None = None, size: dict[str, str] | None = None
) -> Iterator[Row]:
    """Rows of the gallery, or of other scenes with a parameter ``rfilter``.

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
    boxed = mi.load_file(str(file), optimize=False, rfilter="box", **size)
    sensor = world.sensors()[0]
    found = require_reference(file, world, sensor)
    limits = {
        k: v for k, v in reference.path_limits(world.integrator()).items() if v not in (-1, False)
    }
    weights = pixel_weights(sensor.film())
    weight, mask = metrics.weights(found.halves), np.ones(found.mean.shape[:2], bool)

    def error(images) -> float:
        return metrics.mse(metrics.products(np.stack(images), found.halves, mask, weight))

    _ours(world, limits, _WARM_SEED, budgets[:1])
    _path(boxed, limits, _WARM_SEED, [0.1], weights)
    shots = [
        (_ours(world, limits, seed, budgets), _path(boxed, limits, seed, budgets, weights))
        for seed in range(seeds)
    ]
    for k, budget in enumerate(budgets):
        parts, took = {}, 0.0
        for name, of_seeds in zip(("ours", "path"), zip(*shots, strict=True), strict=True):
            some = [each[k] for each in of_seeds if each[k] is not None]
            if not some:
                continue
            began = time.perf_counter()
            blended = [denoising.denoise(shot.picture, shot.layers) for shot in some]
            took = (time.perf_counter() - began) / len(some)
            whole = [denoising.denoise(shot.picture, shot.layers, blend=False) for shot in some]
            spp = np.mean([shot.spp for shot in some])
            raw = [shot.picture for shot in some]
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


def _ours(world, limits, seed: int, budgets) -> list[_Shot | None]:
    """The last picture within each budget."""
    shots: list[_Shot | None] = [None] * len(budgets)
    parameters: dict[str, Any] = {"type": "aniso_pm", "time": 4 * budgets[-1] + 60}
    integrator = mi.load_dict(parameters | {"layers": "denoising"} | limits)

    def after_pass(index, image, statistics):
        stages = statistics["seconds"].items()
        seconds = sum(spent for stage, spent in stages if stage != "output")
        shot = _Shot(np.array(image)[..., :3], dict(integrator.layers), statistics["spp"])
        for k, budget in enumerate(budgets):
            if seconds <= budget:
                shots[k] = shot
        if seconds > budgets[-1]:
            raise _Enough

    integrator.callback = after_pass
    try:
        integrator.render(world, seed=seed, spp=64)
    except _Enough:
        pass
    return shots


def _path(world, limits, seed: int, budgets, weights) -> list[_Shot | None]:
    """The same of ``path``."""
    shots: list[_Shot | None] = [None] * len(budgets)
    integrator = mi.load_dict(
        {
            "type": "aov",
            "aovs": "albedo:albedo,normal:sh_normal",
            "path": {"type": "path"} | limits,
        }
    )
    sensor = world.sensors()[0]
    total: Any = 0.0
    square: Any = 0.0
    seconds, calls, spp = 0.0, 0, 0
    while seconds <= budgets[-1]:
        random = mi.sample_tea_32(seed, calls)[0]
        began = time.perf_counter()
        integrator.render(world, sensor=sensor, seed=random, spp=_CALL, develop=False)
        dr.sync_thread()
        seconds += time.perf_counter() - began
        image = np.array(sensor.film().develop(), np.float64)
        total, square, calls = total + image, square + image[..., :3] ** 2, calls + 1
        spp += sensor.sampler().sample_count()
        mean = total / calls
        layers = {
            "denoising_picture": mean[..., :3],
            "denoising_albedo": mean[..., -6:-3],
            "denoising_normal": mean[..., -3:],
            "denoising_filter": np.array(weights),
        }
        if calls >= 8:  # as ours
            variance = np.maximum(square / calls - mean[..., :3] ** 2, 0) / (calls - 1)
            layers["denoising_error"] = np.sqrt(variance)
        shot = _Shot(denoising.filtered_by(mean[..., :3], weights), layers, spp)
        for k, budget in enumerate(budgets):
            if seconds <= budget:
                shots[k] = shot
    return shots
