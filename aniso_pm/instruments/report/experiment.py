"""One scene: regions, best bandwidths, then every method with every seed, each kept in its cell.

Runs are interleaved: all methods with one seed before the next seed, in an order that is turned by
one each time, so that a machine that gets slower does so for all of them. A failure is noted in its
cell, and the rest goes on.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from aniso_pm.errors import is_interrupt, one_line
from aniso_pm.instruments.doctor import versions
from aniso_pm.pictures import denoising
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings

from . import metrics, reference, regions, runs, sweep
from .cells import Cell, Store
from .machine import describe
from .methods import ISOTROPIC, RULES, Method, parse_all
from .plan import REGION_SEED, SWEEP_SEED, WARM_SEED, Plan

# Stopping rules and the size of passes are the report's.
_OURS = ("passes", "time", "target_error", "photon_count", "initial_radius", "kernel", "rule")
_FIELDS = {field.name for field in fields(Settings)}


@dataclass
class Measured:
    """All that was measured on one scene.

    runs      method → seed → Cell with the arrays of a ``runs.Run``.
    sweeps    kernel → size of passes → Cell with ``radius``, ``factor``, ``errors`` (pairs of a
              factor and a relative MSE).
    warm      method → record of its warm-up.
    left_out  names of methods that are the isotropic one in this scene.
    failures  (method, seed or None, reason).
    """

    name: str
    file: str
    size: tuple[int, int]
    reference: reference.Reference
    masks: dict[str, np.ndarray]
    methods: list[Method]
    left_out: list[str] = field(default_factory=list)
    runs: dict[str, dict[int, Cell]] = field(default_factory=dict)
    sweeps: dict[str, dict[str, Cell]] = field(default_factory=dict)
    warm: dict[str, dict[str, Any]] = field(default_factory=dict)
    failures: list[tuple[str, int | None, str]] = field(default_factory=list)


def measure(
    file: Path,
    world,
    sensor,
    plan: Plan,
    store: Store,
    tick: Callable[[float, str], None],
    boxed: Callable[[], tuple[Any, Any]] | None = None,
) -> Measured:
    """Run what ``plan`` asks of one scene and is not in ``store`` yet.

    tick   called as tick(seconds, text) after each run with the seconds planned for it.
    boxed  loads the scene and its camera with a box filter; called if ``plan.denoise`` asks for it.
           None: the film has one.

    Raises InputError where the scene has no reference.
    """
    found = reference.require(file, world, sensor)
    return _Experiment(file, world, sensor, plan, store, tick, found, boxed).run()


class _Experiment:
    def __init__(self, file, world, sensor, plan, store, tick, found, boxed):
        self.world, self.sensor, self.plan, self.store = world, sensor, plan, store
        self.tick = tick
        self._warmed: dict[str, dict[str, Any]] = {}
        integrator = world.integrator()
        own = integrator.parameters() if hasattr(integrator, "parameters") else {}
        limits = reference.path_limits(integrator)
        # Mitsuba's integrators do not know all of these names at their defaults.
        limits = {k: v for k, v in limits.items() if v not in (-1, False)}
        self.own = {k: v for k, v in own.items() if k not in _OURS}
        boxed = cache(boxed) if boxed else None
        self.stages = {
            name: runs.Stage(world, sensor, self.own, limits, size.photons, size.spp, boxed)
            for name, size in plan.sizes.items()
        }
        self.fixed = {
            "scene": _hash(reference.depends_on(world, sensor)),
            "versions": versions(),
            "machine": describe()["processor"],
        }
        width, height = sensor.film().crop_size()
        self.weight = metrics.weights(found.halves)
        self.whole = np.ones((height, width), bool)
        self.out = Measured(
            Path(file).stem, str(file), (width, height), found, {regions.WHOLE: self.whole}, []
        )

    def run(self) -> Measured:
        out, plan = self.out, self.plan
        methods = parse_all(plan.methods)
        try:
            settings = Settings(**{k: v for k, v in self.own.items() if k in _FIELDS})
            prepared = prepare(self.world, settings, self.own.get("hide_emitters", False))
        except ValueError as error:
            prepared = None
            out.failures += [(m.name, None, one_line(error)) for m in methods if m.ours]
            methods = [m for m in methods if not m.ours]
        out.methods = methods
        if prepared is not None:
            out.methods = [m for m in methods if prepared.follow_lobes or not _same(m, methods)]
            out.left_out = [m.name for m in methods if m not in out.methods]
            self._regions(prepared)
        if plan.denoise:
            out.methods = [one for m in out.methods for one in (m, m.with_denoising())]
        for method in out.methods:
            # The best bandwidth is that of the raw picture.
            if method.bandwidth == "best" and not method.denoised:
                for size in plan.sizes:
                    self._sweep(method, size)

        # --- The runs that are reported ---
        for seed in range(plan.seeds):
            turn = seed % max(1, len(out.methods))
            for method in out.methods[turn:] + out.methods[:turn]:
                cell = self._run(method, seed)
                if cell.error:
                    out.failures.append((method.name, seed, cell.error))
                else:
                    out.runs.setdefault(method.name, {})[seed] = cell
        return out

    # --- Cells ---

    def _cell(self, name: str, key: dict, make: Callable[[], tuple[dict, dict]]) -> Cell:
        """The kept cell, or a new one; what goes wrong is its content."""
        name, key = f"{self.out.name}/{name}", self.fixed | key
        cell = self.store.get(name, key)
        if cell is not None:
            return cell
        try:
            record, arrays = make()
        except Exception as error:
            if is_interrupt(error):
                raise
            record, arrays = {"error": one_line(error)}, {}
        return self.store.put(name, key, record, arrays)

    def _regions(self, prepared) -> None:
        mean = self.out.reference.mean

        def make():
            found = regions.find(prepared, self.sensor, mean, REGION_SEED)
            return {}, found

        key = {"reference": self.out.reference.record["spp"]}
        cell = self._cell("regions", key, make)
        if cell.error:
            self.out.failures.append(("regions", None, cell.error))
        self.out.masks |= cell.arrays

    def _sweep(self, method: Method, size: str) -> None:
        """Best bandwidth of a kernel with passes of one size."""
        plan, stage = self.plan, self.stages[size]
        budgets = [plan.sizes[size].sweep_seconds]
        key = {"parameters": stage.parameters(method, None), "budgets": budgets}
        key |= {"seeds": plan.sweep_seeds, "fine": plan.fine, "spp": stage.spp}

        def error(automatic: float, factor: float) -> float:
            """Relative MSE after exactly that time: of few passes, the last one ends well before
            it, and variance falls with time."""
            seeds = range(SWEEP_SEED, SWEEP_SEED + plan.sweep_seeds)
            found = [runs.run(stage, method, factor * automatic, s, budgets) for s in seeds]
            self.tick(plan.sweep_seeds * budgets[0], f"{self.out.name}: bandwidth, {method.kernel}")
            images = [run.images[0] for run in found]
            share = np.mean([run.seconds[0] for run in found]) / budgets[0]
            table = metrics.products(images, self.out.reference.halves, self.whole, self.weight)
            return metrics.variance(table) * share + metrics.bias2(table)

        def make():
            automatic = self._warm(method, stage, None)["radius"]
            # What is shown of the small passes is a few points: √2 more or less is enough.
            fine = plan.fine and size == "large"
            factor, errors = sweep.best(partial(error, automatic), fine)
            return {
                "automatic": automatic,
                "factor": factor,
                "radius": factor * automatic,
                "seconds": budgets[0],
                "errors": [[f, e if np.isfinite(e) else None] for f, e in errors.items()],
            }, {}

        cell = self._cell(f"sweep-{size}-{method.slug}", key, make)
        if cell.error:
            self.out.failures.append((method.name, None, cell.error))
        else:
            self.out.sweeps.setdefault(method.kernel, {})[size] = cell

    def _run(self, method: Method, seed: int) -> Cell:
        """One method with one seed at all budgets."""
        parts = self._parts(method)
        key = {
            "seed": seed,
            "parts": [
                [stage.parameters(method, radius), stage.spp, times]
                for stage, radius, times in parts
            ],
        }
        if method.denoised:
            key["denoiser"] = denoising.check_installed().oidn_version()

        def make():
            found = None
            for stage, radius, times in parts:
                warm = self._warm(method, stage, radius)
                part = runs.run(stage, method, radius, seed, times)
                found = part if found is None else runs.joined(found, part)
            found = asdict(found)
            return found | {"images": None, "warm": warm}, {"images": found["images"]}

        cell = self._cell(f"{method.slug}-{seed}", key, make)
        if not cell.error:
            # What was compiled, was compiled once: by the run that found the least in the cache.
            warm = cell.record["warm"]
            known = self.out.warm.setdefault(method.name, warm)
            if warm["compile_seconds"] > known["compile_seconds"]:
                self.out.warm[method.name] = warm
        self.tick(self.plan.seconds, f"{self.out.name}: {method.label}, seed {seed}")
        return cell

    def _parts(self, method: Method) -> list[tuple[runs.Stage, float | None, list[float]]]:
        """The runs that give the pictures of a method: stage, radius (None: automatic), budgets."""
        if not method.ours:
            # The size of passes is for the photon mappers.
            return [(self.stages["large"], None, self.plan.times)]
        if method.installed:
            return [(self.stages["large"], None, self.plan.times)]
        parts = []
        for name, size in self.plan.sizes.items():
            radius = None
            if method.bandwidth == "best":
                cell = self.out.sweeps.get(method.kernel, {}).get(name)
                radius = cell.record["radius"] if cell else None
            parts.append((self.stages[name], radius, size.times))
        return parts

    def _warm(self, method: Method, stage: runs.Stage, radius: float | None) -> dict[str, Any]:
        """Warm up a method once in this process."""
        key = method.name, stage.photons
        if key not in self._warmed:
            self._warmed[key] = runs.warm_up(stage, method, radius, WARM_SEED)
        return self._warmed[key]


def _same(method: Method, methods: list[Method]) -> bool:
    """Where a scene has no anisotropic surface, every rule is the isotropic kernel: one of them is
    run, to show that it costs nothing, if the isotropic kernel itself is."""
    rules = [m for m in methods if m.kernel in RULES]
    return method in rules[1:] and any(m.kernel == ISOTROPIC for m in methods)


def _hash(entries: dict[str, Any]) -> str:
    text = json.dumps(entries, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
