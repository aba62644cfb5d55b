"""The table: as text, as JSON, as a page to read, as Markdown for the documentation."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2
from aniso_pm.pictures import output

from .case import FAIL, FALLBACK, LEFT_OUT, PASS, Row
from .regions import REGIONS

SCHEMA = 1
FILES = ("stability.json", "stability.html", "stability.md")


def record(rows: list[Row], about: dict[str, Any]) -> dict[str, Any]:
    """Everything, in JSON's types. The schema is documented on the Markdown page; ``about`` holds
    versions, variant and whether slow cases were left out."""
    verdicts = Counter(row.verdict for row in rows)
    return output.plain(
        {
            "schema": SCHEMA,
            **about,
            "seconds": sum(row.seconds for row in rows),
            "counts": {verdict: verdicts[verdict] for verdict in (PASS, FALLBACK, FAIL, LEFT_OUT)},
            "regions": [asdict(region) for region in REGIONS],
            "rows": [_as_dict(row) for row in rows],
        }
    )


def _as_dict(row: Row) -> dict[str, Any]:
    case, measured = row.case, row.measured
    return {
        "group": case.group,
        "name": case.name,
        "quantity": case.quantity,
        "worst": measured.worst,
        "at": measured.at,
        "target": case.target,
        "fallback": measured.fallback,
        "region": case.region,
        "verdict": row.verdict,
        "reason": row.reason,
        "slow": case.slow,
        "seconds": round(row.seconds, 2),
    }


def line(row: Row) -> str:
    """One row as text."""
    worst = "–" if row.verdict == LEFT_OUT else f"{row.measured.worst:.1e}"
    text = f"{row.verdict:<8}  {worst:>7} of {row.case.target:<7g} {row.case.title}"
    return f"{text}  ({row.reason})" if row.reason else text


def summary(counts: dict[str, int]) -> str:
    return ", ".join(f"{number} {verdict}" for verdict, number in counts.items() if number)


def write(directory: Path, found: dict[str, Any]) -> list[Path]:
    """Write the record and the two pages made of it. Raises output.OutputError."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("aniso_pm.instruments.stability", "."),
        autoescape=jinja2.select_autoescape(["html.j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"number": _number, "share": _share, "cell": _cell}
    groups: dict[str, list] = {}
    for row in found["rows"]:
        groups.setdefault(row["group"], []).append(row)
    text = {"stability.json": json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False)}
    for name in FILES[1:]:
        template = environment.get_template(f"page{Path(name).suffix}.j2")
        text[name] = template.render(found, groups=groups, summary=summary(found["counts"]))
    paths = []
    for name, content in text.items():
        path = directory / name
        try:
            path.write_text(content.rstrip() + "\n", encoding="utf-8")
        except OSError as error:
            raise output.OutputError(f"cannot write '{path}': {error.strerror or error}") from error
        paths.append(path)
    return paths


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "–"
    return "0" if value == 0 else f"{value:.1e}" if abs(value) < 0.01 else f"{value:.3g}"


def _share(value: float | None) -> str:
    return f"{value:.2%}" if value else "0"


def _cell(text: str) -> str:
    """Text that cannot break a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")
