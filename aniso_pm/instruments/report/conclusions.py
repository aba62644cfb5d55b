"""What a report comes to: for each pair of methods better, worse, or cannot be told apart."""

from __future__ import annotations

from collections import Counter
from typing import Any

from . import regions
from .methods import DENOISED, INSTALLED

# Pixels in which a comparison is made, if the scene has them; all of them else.
_AGAINST_ISOTROPIC = (regions.ANISOTROPIC, regions.WHOLE)
_AGAINST_PATH = (regions.WHOLE, regions.CAUSTIC, regions.ANISOTROPIC)


def conclusions(results: dict[str, Any], scene: dict[str, Any]) -> list[dict[str, Any]]:
    """The ratios of a scene at the largest budget that the reference does not limit (the largest of
    all where it limits all), with ``tally``, how often each verdict was given over the budgets
    that it does not limit, and ``compared``, their number."""
    labels = {method["name"]: method["label"] for method in scene["methods"]}
    groups: dict[tuple, list] = {}
    for ratio in results["ratios"]:
        if ratio["scene"] == scene["name"] and ratio["value"] is not None:
            wanted = _AGAINST_ISOTROPIC if ratio["base"].startswith("isotropic") else _AGAINST_PATH
            if ratio["region"] in wanted:
                key = ratio["base"], ratio["region"], ratio["method"]
                groups.setdefault(key, []).append(ratio)
    found = []
    for (base, _, method), ratios in groups.items():
        clear = [ratio for ratio in ratios if not ratio["limited"]]
        last = max(clear or ratios, key=lambda ratio: ratio["budget"])
        tally = Counter(ratio["verdict"] for ratio in clear)
        found.append(
            last
            | {"label": labels[method], "base_label": labels[base]}
            | {"base_kernel": base.partition("/")[0].removesuffix(DENOISED)}
            | {"tally": dict(tally), "compared": len(clear)}
        )
    order = list(labels)
    return sorted(
        found,
        key=lambda r: (
            r["method"].partition(",")[0] != INSTALLED,
            not r["base"].startswith("isotropic"),
            list(regions.DEFINITIONS).index(r["region"]),
            order.index(r["method"]),
        ),
    )


def too_slow(results: dict[str, Any], scene: dict[str, Any]) -> list[str]:
    """A sentence for each method of which no budget has a picture of every seed."""
    shown = {row["method"] for row in results["rows"] if row["scene"] == scene["name"]}
    failed = {failure["method"] for failure in scene["failures"]}
    return [
        f"{method['label']}: no picture within {results['plan']['seconds']:g} s ({_late(method)}); "
        "give a larger --time"
        for method in scene["methods"]
        if method["name"] not in shown and method["name"] not in failed
    ]


def _late(method: dict[str, Any]) -> str:
    """Why; what was not over in time was not measured."""
    if method["setup_seconds"] > 0:
        return f"set-up alone takes {method['setup_seconds']:.2g} s"
    return "no pass was over by then"


def as_text(results: dict[str, Any]) -> str:
    """The conclusions of all scenes, one line each, for a terminal."""
    lines = []
    for scene in results["scenes"]:
        lines.append(scene["name"])
        for one in conclusions(results, scene):
            interval = "" if one["low"] is None else f" ({one['low']:.2f} to {one['high']:.2f})"
            note = ", limited by the reference" if one["limited"] else ""
            lines.append(
                f"  {one['label']} / {one['base_label']}, {one['region']} pixels, "
                f"{one['budget']:g} s: error × {one['value']:.2f}{interval}: {one['verdict']}{note}"
            )
        lines += [f"  {sentence}" for sentence in too_slow(results, scene)]
        for failure in scene["failures"]:
            seed = "" if failure["seed"] is None else f", seed {failure['seed']}"
            lines.append(f"  {failure['method']}{seed} failed: {failure['reason']}")
    return "\n".join(lines)
