"""Figures of one scene, from the results alone: ``NAME → matplotlib Figure``.

One curve a method, of the same colour everywhere; dashed at the default bandwidth, solid at the
best one; dots and dashes, and dots, where pictures are denoised. Bars and bands are 95 % intervals.
Hollow points are limited by the reference.
"""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from . import metrics

# Colours of Okabe and Ito, which everybody can tell apart, and marks.
_LOOKS = {
    "as installed": ("#E69F00", "*"),
    "isotropic": ("#0072B2", "o"),
    "lobe": ("#D55E00", "s"),
    "taylor": ("#009E73", "^"),
    "paper": ("#CC79A7", "v"),
    "path": ("#222222", "D"),
    "ptracer": ("#8a8a8a", "x"),
}
_MORE, _MORE_MARK = ("#56B4E9", "#a0522d", "#6a3d9a", "#b5a800"), "P"
_SIZE = (5.2, 4.5)
# Decades above the smallest error beyond which a curve leaves the picture.
_DECADES = 3


def figures(results: dict[str, Any], scene: dict[str, Any]) -> dict[str, Figure]:
    """All figures of one scene of ``results``."""
    rows = [row for row in results["rows"] if row["scene"] == scene["name"]]
    ratios = [ratio for ratio in results["ratios"] if ratio["scene"] == scene["name"]]
    found = {}
    for region in scene["regions"]:
        here = [row for row in rows if row["region"] == region]
        if here:
            found[f"error-{region}"] = _errors(scene, here, region)
            found[f"split-{region}"] = _split(scene, here, region)
        here = [r for r in ratios if r["region"] == region and r["base"].startswith("isotropic")]
        if here:
            found[f"ratio-{region}"] = _ratios(scene, here, region)
    for size in results["plan"]["sizes"]:
        sweeps = {kernel: of[size] for kernel, of in scene["sweeps"].items() if size in of}
        if sweeps:
            if any(e and e > 0 for sweep in sweeps.values() for _, e in sweep["errors"]):
                found[f"bandwidth-{size}"] = _sweeps(sweeps, size)
    return found


def _errors(scene, rows, region) -> Figure:
    figure, ax = _axes("seconds", "relative MSE", f"Error against time: {region} pixels")
    for method in scene["methods"]:
        mine = [row for row in rows if row["method"] == method["name"]]
        _curve(ax, method, _colour(scene, method), mine)
    _budgets(ax, [row for row in rows if row["relative_mse"]["value"]])
    values = [v for row in rows if (v := row["relative_mse"]["value"]) and v > 0]
    if values:
        ax.set_ylim(min(values) / 3, 2 * min(max(values), min(values) * 10**_DECADES))
        # Ten times the reference's own error: what lies below is limited by it.
        limit = metrics.CLEAR * scene["reference"]["relative_mse"][region]
        ax.axhspan(ax.get_ylim()[0] / 10, limit, color="0.93", lw=0, zorder=0)
    _legend(figure)
    return figure


def _split(scene, rows, region) -> Figure:
    """Variance and bias² at the largest budget, one line a method."""
    last = max(row["budget"] for row in rows)
    rows = {row["method"]: row for row in rows if row["budget"] == last}
    methods = [method for method in scene["methods"] if method["name"] in rows]
    figure, ax = _axes(
        "part of the relative MSE", None, f"Variance and bias² after {last:g} s: {region} pixels"
    )
    ax.set_yscale("linear")
    smallest = min(row["variance"]["value"] for row in rows.values())
    floor = max(smallest, 1e-12) / 300
    for k, method in enumerate(methods):
        row, colour = rows[method["name"]], _colour(scene, method)
        for part, mark, size in (("variance", "|", 10), ("bias2", "o", 6)):
            e = row[part]
            if e["value"] is None:
                continue
            value, low, high = (
                max(e["value"] if e[end] is None else e[end], floor)
                for end in ("value", "low", "high")
            )
            hollow = row["limited"] and part == "bias2"
            ax.plot([low, high], [k, k], color=colour, lw=1)
            ax.plot(value, k, mark, color=colour, mfc="white" if hollow else colour, ms=size)
    ax.axvline(scene["reference"]["relative_mse"][region], color="0.6", lw=1)
    ax.set_yticks(range(len(methods)), [method["label"] for method in methods], fontsize=8)
    ax.set_ylim(len(methods) - 0.5, -0.5)
    ax.plot([], [], "|", color="0.3", ms=9, label="variance")
    ax.plot([], [], "o", color="0.3", label="bias²")
    _legend(figure)
    return figure


def _ratios(scene, ratios, region) -> Figure:
    """Error over that of the isotropic kernel at the same kind of bandwidth."""
    figure, ax = _axes("seconds", "error / isotropic error", f"Equal time: {region} pixels")
    ax.set_yscale("log", base=2)
    ax.axhline(1, color="0.5", lw=1)
    values = [r["value"] for r in ratios if r["value"] is not None]
    # Wide intervals may leave the picture; no ratio does.
    ax.set_ylim(min([0.5, *values]) / 1.2, max([2.0, *values]) * 1.2)
    shift = 0.94
    for method in scene["methods"]:
        mine = [r for r in ratios if r["method"] == method["name"] and r["value"] is not None]
        if not mine:
            continue
        x = [r["budget"] * shift for r in mine]
        shift *= 1.025
        y = [r["value"] for r in mine]
        low = [v - (r["low"] or v) for v, r in zip(y, mine, strict=True)]
        high = [(r["high"] or v) - v for v, r in zip(y, mine, strict=True)]
        colour, mark = _colour(scene, method), _mark(method)
        line = _line(method)
        ax.errorbar(x, y, (low, high), color=colour, lw=1.2, ls=line, capsize=2)
        for a, b, r in zip(x, y, mine, strict=True):
            ax.plot(a, b, mark, color=colour, mfc="white" if r["limited"] else colour, ms=5)
        ax.plot([], [], mark + line, color=colour, label=method["label"], ms=5)
    ax.yaxis.set_major_formatter("{x:.3g}")
    _budgets(ax, ratios)
    _legend(figure)
    return figure


def _sweeps(sweeps, size) -> Figure:
    seconds = next(iter(sweeps.values()))["seconds"]
    figure, ax = _axes(
        "bandwidth of the first pass / automatic one",
        "relative MSE",
        f"Error against bandwidth after {seconds:g} s, {size} passes",
    )
    for kernel, sweep in sweeps.items():
        points = [(factor, error) for factor, error in sweep["errors"] if error and error > 0]
        if not points:
            continue
        colour, mark = _LOOKS[kernel]
        ax.plot(*zip(*points, strict=True), mark + "-", color=colour, label=kernel, ms=4)
        ax.plot(*next(p for p in points if p[0] == sweep["factor"]), "*", color=colour, ms=13)
    ax.set_xscale("log", base=2)
    ax.xaxis.set_major_formatter("{x:.3g}")
    _legend(figure)
    return figure


# --- Parts ---


def _axes(x: str, y: str | None, title: str):
    figure = Figure(figsize=_SIZE, layout="constrained")
    ax = figure.add_subplot()
    ax.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    ax.set_title(title, fontsize=10)
    ax.grid(True, which="major", color="0.9", lw=0.6)
    ax.set_axisbelow(True)
    return figure, ax


def _curve(ax, method, colour, rows) -> None:
    """Error against seconds; a curve without points is not in the legend either."""
    y = "relative_mse"
    rows = [row for row in rows if row[y]["value"] and row[y]["value"] > 0]
    if not rows:
        return
    line = _line(method)
    mark = _mark(method)
    seconds, values = [row["seconds"] for row in rows], [row[y]["value"] for row in rows]
    if all(row[y]["low"] is not None for row in rows):
        low = [max(row[y]["low"], row[y]["value"] / 10) for row in rows]
        ax.fill_between(
            seconds, low, [row[y]["high"] for row in rows], color=colour, alpha=0.15, lw=0
        )
    ax.plot(seconds, values, line, color=colour, lw=1.3)
    for a, b, row in zip(seconds, values, rows, strict=True):
        ax.plot(a, b, mark, color=colour, mfc="white" if row["limited"] else colour, ms=4.5)
    ax.plot([], [], mark + line, color=colour, label=method["label"], ms=4.5)


def _line(method) -> str:
    default = method["bandwidth"] == "default"
    if method["denoised"]:
        return "-." if default else ":"
    return "--" if default else "-"


def _named(method) -> str:
    return method["label"].partition(",")[0]


def _colour(scene, method) -> str:
    if _named(method) in _LOOKS:
        return _LOOKS[_named(method)][0]
    others = [m["plugin"] for m in scene["methods"] if _named(m) not in _LOOKS]
    return _MORE[others.index(method["plugin"]) % len(_MORE)]


def _mark(method) -> str:
    return _LOOKS.get(_named(method), ("", _MORE_MARK))[1]


def _budgets(ax, entries) -> None:
    """Ticks where the budgets are."""
    budgets = sorted({entry["budget"] for entry in entries})
    ax.set_xticks(budgets, [f"{b:.2g}" for b in budgets], minor=False)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlim(budgets[0] * 0.75, budgets[-1] * 1.25)


def _legend(figure) -> None:
    """Below the axes, where it hides nothing."""
    if not any(ax.get_legend_handles_labels()[0] for ax in figure.axes):
        return
    figure.legend(loc="outside lower center", ncols=2, fontsize=7, frameon=False, handlelength=2.6)


def as_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as the content of an "svg" or a "png" file, the same for the same results."""
    settings = {
        "svg.fonttype": "none",  # text stays text
        "svg.hashsalt": "aniso_pm",
    }
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    buffer = io.BytesIO()
    with matplotlib.rc_context(settings):
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()
