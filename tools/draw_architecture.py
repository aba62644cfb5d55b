"""Draw docs/architecture.svg: the rooms of the library and who imports whom, from the code itself.

python tools/draw_architecture.py
"""

import sys
import textwrap
from pathlib import Path

import grimp
import matplotlib
import tomllib

matplotlib.rcParams["svg.fonttype"] = "none"
matplotlib.rcParams["svg.hashsalt"] = "architecture"  # the same file for the same imports
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.patches import FancyBboxPatch  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
WORDS = {
    "cli": "the program",
    "view": "the live page",
    "distributed": "passes on other machines",
    "instruments": "why, how well, how fast, how stable",
    "rendering": "what a scene needs, pilot, passes, sums, when it ends",
    "pictures": "EXR, PNG, denoising",
    "transport": "photons from the lights, paths from the eye",
    "map": "where photons lie and what an ellipse holds",
    "lobes and kernels": "the mathematics",
    "ground": "",
}


def rooms() -> list[list[str]]:
    """Floors from top to bottom, as the import linter knows them; the mathematics as one room."""
    with open(ROOT / "pyproject.toml", "rb") as file:
        contract = tomllib.load(file)["tool"]["importlinter"]["contracts"][0]
    floors = [[name.strip() for name in floor.split("|")] for floor in contract["layers"]]
    packages = [f for f in floors if all((ROOT / "aniso_pm" / name).is_dir() for name in f)]
    return [*packages, ["lobes and kernels"], ["ground"]]


def room_of(module: str, known: set[str]) -> str | None:
    name = module.removeprefix("aniso_pm").lstrip(".").split(".")[0]
    if name in known:
        return name
    if name in ("asg", "ndf", "warp", "kernel", "lobe_path"):
        return "lobes and kernels"
    return "ground" if name else None


def main(out: Path) -> None:
    graph = grimp.build_graph("aniso_pm")
    floors = rooms()
    known = {name for floor in floors for name in floor}
    inside: dict[str, set[str]] = {name: set() for name in known}
    uses: dict[str, set[str]] = {name: set() for name in known}
    for module in graph.modules:
        room = room_of(module, known)
        if room is None:
            continue
        parts = module.split(".")[1:]
        leaf = parts[1] if room in WORDS and parts[0] == room and len(parts) > 1 else parts[0]
        if leaf != room:
            inside[room].add(leaf)
        for imported in graph.find_modules_directly_imported_by(module):
            other = room_of(imported, known)
            if other and other not in (room, "ground"):
                uses[room].add(other)

    drawing = Figure(figsize=(9.5, 9.5), layout="constrained")
    axes = drawing.add_subplot()
    order = [name for floor in floors for name in floor]
    y, width = 0.0, 8.0
    for floor in floors:
        share = width / len(floor)
        texts = {}
        for name in floor:
            names = ", ".join(sorted(inside[name]))
            texts[name] = textwrap.wrap(names, int(15 * share)) or [""]
        height = 0.66 + 0.17 * max(len(text) for text in texts.values())
        for column, name in enumerate(floor):
            x = column * share
            box = FancyBboxPatch(
                (x, y - height), share - 0.15, height, boxstyle="round,pad=0,rounding_size=0.08",
                facecolor="#eef3f8", edgecolor="#0072b2",
            )  # fmt: skip
            axes.add_patch(box)
            title = f"{name}: {WORDS[name]}" if WORDS[name] else name
            axes.text(x + 0.12, y - 0.22, title, weight="bold", size=10, va="center")
            axes.text(
                x + 0.12, y - 0.42, "\n".join(texts[name]), size=8, va="top", color="0.25",
                linespacing=1.25,
            )  # fmt: skip
            below = ", ".join(sorted(uses[name], key=order.index))
            if below:
                axes.text(
                    x + 0.12, y - height + 0.14, f"uses {below}", size=8, va="center",
                    color="#0072b2", style="italic",
                )  # fmt: skip
        y -= height + 0.15
    axes.set_xlim(-0.05, width)
    axes.set_ylim(y, 0.1)
    axes.axis("off")
    drawing.savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "architecture.svg")
