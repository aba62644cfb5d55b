"""The report as files: ``results.json``, figures as SVG and PNG, and one page, ``index.html``, that
needs none of them."""

from __future__ import annotations

import base64
import json
from functools import partial
from pathlib import Path
from typing import Any

import jinja2
from aniso_pm.pictures import output

from . import metrics, plots, regions
from .conclusions import conclusions, too_slow
from .pictures import HEAT

# What each figure shows, by the first part of its name.
CAPTIONS = {
    "error": "Relative MSE of the picture at hand after so many seconds (compilation not counted). "
    "Lower is better; a curve begins with its first finished picture. Bands: 95 % intervals. Grey, "
    "at the bottom: limited by the reference. Curves three decades above the best are cut off.",
    "split": "What the error at the largest budget consists of: noise, which more samples remove, "
    "and bias², which they do not. Bars: 95 % intervals. Grey line: the reference's own error.",
    "ratio": "Error over that of the isotropic kernel after the same time, at the same kind of "
    "bandwidth, with the same photons and eye paths: below 1 the anisotropic kernel wins.",
    "bandwidth": "Relative MSE after short runs at each bandwidth, on seeds that are not "
    "reported. The star is the best bandwidth.",
}


def write_figures(directory: Path, results, scene, panels) -> dict[str, Any]:
    """Write a scene's figures and pictures to ``directory/figures``; what the page shows of them:
    ``plots`` (name, caption, SVG as data URI) and ``panels`` (titles, PNGs as data URIs)."""
    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    shown = []
    for name, figure in plots.figures(results, scene).items():
        for kind in ("svg", "png"):
            content = plots.as_bytes(figure, kind)
            write(folder / f"{scene['name']}-{name}.{kind}", content)
            if kind == "svg":
                caption = CAPTIONS[name.partition("-")[0]]
                shown.append({"name": name, "caption": caption, "uri": _uri("svg+xml", content)})
    pictures = []
    for panel in panels:
        uris = {}
        for part in ("whole", "crop", "heat"):
            if part in panel:
                slug = panel["name"].replace("/", "-").replace(":", "-")
                write(folder / f"{scene['name']}-{slug}-{part}.png", panel[part])
                uris[part] = _uri("png", panel[part])
        pictures.append({"title": panel["title"], **uris})
    return {"plots": shown, "panels": pictures}


def as_json(results: dict[str, Any]) -> str:
    """JSON in which each row of a table is a line, so that versions of a file can be compared."""
    dumps = partial(json.dumps, ensure_ascii=False, allow_nan=False)
    parts = []
    for key, value in results.items():
        text = dumps(value)
        if isinstance(value, list) and value:
            text = "[\n  " + ",\n  ".join(map(dumps, value)) + "\n ]"
        parts.append(f" {dumps(key)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def write_page(directory: Path, results: dict[str, Any], figures: dict[str, Any]) -> Path:
    """Write ``results.json`` and ``index.html``. figures: scene → of :func:`write_figures`."""
    write(directory / "results.json", as_json(results).encode())
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("aniso_pm.instruments.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"number": number, "between": between, "duration": duration}
    page = environment.get_template("page.html.j2").render(
        results,
        figures=figures,
        conclusions={s["name"]: conclusions(results, s) for s in results["scenes"]},
        too_slow={s["name"]: too_slow(results, s) for s in results["scenes"]},
        definitions=regions.DEFINITIONS,
        clear=metrics.CLEAR,
        heat=HEAT,
    )
    path = directory / "index.html"
    write(path, page.encode())
    return path


def write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all. Raises ``output.OutputError``."""
    with output.replacing(path) as partial:
        partial.write_bytes(content)


def number(value: float | None) -> str:
    """Three digits, as short as they go."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}".replace("e-0", "e-")


def between(estimate: dict[str, Any]) -> str:
    """The interval of an estimate."""
    if estimate["low"] is None or estimate["high"] is None:
        return ""
    return f"{number(estimate['low'])} to {number(estimate['high'])}"


def duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
