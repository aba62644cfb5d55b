"""From what was measured to a table: ``results.json``, whose schema is ``results.schema.json``."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from aniso_pm.pictures import output

from . import metrics, regions
from .experiment import Measured
from .methods import DENOISED, ISOTROPIC, Method
from .plan import Plan
from .runs import SET_UP

SCHEMA = 1


def table(parts: list[dict[str, Any]], plan: Plan, about: dict[str, Any]) -> dict[str, Any]:
    """All scenes together, see the schema. parts: of :func:`of_scene`."""
    sizes = {name: asdict(size) for name, size in plan.sizes.items()}
    planned = asdict(plan) | {"times": plan.times, "sizes": sizes}
    scenes = [{k: v for k, v in p.items() if k not in ("rows", "ratios")} for p in parts]
    both = {name: [entry for part in parts for entry in part[name]] for name in ("rows", "ratios")}
    return output.plain({"schema": SCHEMA, **about, "plan": planned, "scenes": scenes, **both})


def of_scene(measured: Measured, plan: Plan) -> dict[str, Any]:
    """What was measured on one scene. ``rows`` has one entry for each method, region and budget,
    ``ratios`` one for each of these and each method that it is compared with (:func:`bases`)."""
    ref = measured.reference
    weight = metrics.weights(ref.halves)
    own = {
        name: metrics.reference_error(ref.halves, mask, weight)
        for name, mask in measured.masks.items()
    }
    made = [method for method in measured.methods if method.name in measured.runs]
    tables = {method.name: _tables(measured, method, plan, weight) for method in made}
    rows, ratios = [], []
    for method in made:
        for k, budget in enumerate(plan.times):
            for region in measured.masks:
                pair = tables[method.name].get((k, region))
                if pair is None:
                    continue
                place = {
                    "scene": measured.name,
                    "method": method.name,
                    "denoised": method.denoised,
                    "region": region,
                    "budget": budget,
                }
                rows.append(place | _row(measured, method, k, pair, own[region]))
                for base in bases(method, made):
                    other = tables[base.name].get((k, region))
                    if other is not None:
                        seeds = [list(measured.runs[m.name]) for m in (method, base)]
                        found = _ratio(pair[1], other[1], *seeds, own[region])
                        ratios.append(place | {"base": base.name} | found)
    return {
        "name": measured.name,
        "file": measured.file,
        "size": list(measured.size),
        "reference": {
            "integrator": ref.record["integrator"],
            "spp": ref.record["spp"],
            "seconds": ref.record.get("seconds"),
            "relative_mse": own,
        },
        "regions": {
            name: {"pixels": int(mask.sum()), "definition": regions.DEFINITIONS[name]}
            for name, mask in measured.masks.items()
        },
        "methods": [_method(measured, method) for method in made],
        "left_out": measured.left_out,
        "sweeps": {
            kernel: {size: cell.record for size, cell in cells.items()}
            for kernel, cells in measured.sweeps.items()
        },
        "failures": [
            {"method": name, "seed": seed, "reason": reason}
            for name, seed, reason in measured.failures
        ],
        "rows": rows,
        "ratios": ratios,
    }


def bases(method: Method, methods: list[Method]) -> list[Method]:
    """What a method is compared with: the isotropic kernel at the same kind of bandwidth, and
    ``path``, where they were run; raw pictures with raw ones, denoised with denoised ones."""
    found: list[Method] = []
    methods = [m for m in methods if m.denoised == method.denoised]
    if method.ours and method.kernel != ISOTROPIC:
        found += [m for m in methods if m.kernel == ISOTROPIC and m.bandwidth == method.bandwidth]
    if method.plugin["type"] != "path":
        found += [m for m in methods if m.plugin["type"] == "path"][:1]
    return found


def images(measured: Measured, name: str, k: int) -> np.ndarray | None:
    """Pictures of a method at budget ``k``: (seeds, y, x, 3); None unless every run had one."""
    cells = measured.runs[name].values()
    found = np.array([cell.arrays["images"][k] for cell in cells])
    return found if all(cell.record["passes"][k] for cell in cells) else None


def _tables(measured: Measured, method: Method, plan: Plan, weight) -> dict[tuple, tuple]:
    """(budget, region) → tables of products, absolute and relative, and energy."""
    found = {}
    halves = measured.reference.halves
    for k in range(len(plan.times)):
        pictures = images(measured, method.name, k)
        if pictures is None:
            continue
        for region, mask in measured.masks.items():
            found[k, region] = (
                metrics.products(pictures, halves, mask),
                metrics.products(pictures, halves, mask, weight),
                metrics.energy(pictures, halves, mask),
            )
    return found


def _row(measured, method, k, pair, own) -> dict[str, Any]:
    absolute, relative, energy = pair
    cells = measured.runs[method.name].values()

    def mean(name):
        return float(np.mean([cell.record[name][k] for cell in cells]))

    return {
        "seconds": mean("seconds"),
        "passes": mean("passes"),
        "spp": mean("spp"),
        "seeds": len(cells),
        "mse": asdict(metrics.estimate(metrics.mse, absolute)),
        "relative_mse": asdict(metrics.estimate(metrics.mse, relative)),
        "variance": asdict(metrics.estimate(metrics.variance, relative)),
        "bias2": asdict(metrics.estimate(metrics.bias2, relative)),
        "energy": asdict(energy),
        "limited": _limited(relative, own),
    }


def _limited(table, own: float) -> bool:
    return not metrics.mse(table) > metrics.CLEAR * own


def _ratio(table, base, seeds: list[int], base_seeds: list[int], own: float) -> dict[str, Any]:
    limited = _limited(table, own) or _limited(base, own)
    # A run that failed has left a seed without its pair.
    both = [s for s in seeds if s in base_seeds]
    mine, others = ([have.index(s) for s in both] for have in (seeds, base_seeds))
    found = metrics.ratio(table[np.ix_(mine, mine)], base[np.ix_(others, others)])
    return asdict(found) | {"verdict": metrics.verdict(found), "limited": limited}


def _method(measured: Measured, method: Method) -> dict[str, Any]:
    cells = list(measured.runs[method.name].values())
    passes = [cell.record["passes"][-1] for cell in cells]
    stages = [cell.record["stages"] for cell in cells]
    per_pass = {
        stage: float(np.median([s[stage] / n for s, n in zip(stages, passes, strict=True) if n]))
        for stage in stages[0]
        if stage not in SET_UP and all(passes)
    }
    return {
        "name": method.name,
        "label": method.label,
        "plugin": method.plugin,
        "bandwidth": method.bandwidth,
        "denoised": method.denoised,
        "denoiser_seconds": _denoiser_seconds(cells),
        "radius": cells[0].record["radius"],
        "compile_seconds": measured.warm[method.name]["compile_seconds"],
        "setup_seconds": float(np.median([sum(s.get(n, 0.0) for n in SET_UP) for s in stages])),
        "pass_seconds": per_pass,
        "cost": _cost(measured, method),
    }


def _denoiser_seconds(cells) -> float | None:
    found = [cell.record.get("denoiser_seconds") for cell in cells]
    found = [seconds for seconds in found if seconds is not None]
    return float(np.median(found)) if found else None


def _cost(measured: Measured, method: Method) -> dict[str, float] | None:
    """Time of a pass over that of the isotropic kernel of the same area."""
    base = measured.runs.get(f"{ISOTROPIC}/default" + DENOISED * method.denoised)
    cells = measured.runs[method.name]
    if method.bandwidth != "default" or method.kernel == ISOTROPIC or not base:
        return None
    seeds = [s for s in cells if s in base and cells[s].record["passes"][-1]]
    seeds = [s for s in seeds if base[s].record["passes"][-1]]
    if not seeds:
        return None

    def duration(cell):
        stages = cell.record["stages"]
        seconds = sum(t for stage, t in stages.items() if stage not in SET_UP)
        return seconds / cell.record["passes"][-1]

    found = metrics.mean_ratio(
        [duration(cells[s]) for s in seeds], [duration(base[s]) for s in seeds]
    )
    return asdict(found) if math.isfinite(found.value) else None
