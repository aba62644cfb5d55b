"""How old the figures of the documentation are: docs/figures.md against the history of the code.

    python tools/figures.py

prints, for each line of that table, the commits since then that changed the code which renders;
moves of files count as well. Exit status 1 if any figure is older than that code.
"""

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "figures.md"
# What a picture and its time follow from (not warnings); before and after the modules moved.
CODE = ("aniso_pm", "plugins", "scenes/*.xml")
NOT = ("cli", "view", "distributed", "pictures", "instruments", "rendering/advice.py")
OLD = ("bench", "explain", "report", "stability", "inspect.py", "doctor.py", "gallery.py")


@dataclass(frozen=True)
class Figure:
    what: str
    page: Path
    command: str
    commit: str


def figures(text: str) -> list[Figure]:
    """The rows of the table."""
    row = re.compile(r"^\| (.+?) \| (README|\[\w+\]\(.+?\)) \| `(.+?)` \| (\w{7,40}) \|$", re.M)
    return [Figure(a, _file(b), c, d) for a, b, c, d in row.findall(text)]


def _file(page: str) -> Path:
    """Of ``README``, which has no link because the site leaves it out, or of a link."""
    link = re.search(r"\(([^)#]+)", page)
    return TABLE.parent / link[1] if link else ROOT / "README.md"


def since(commit: str) -> list[str]:
    """Commits after that one that changed what is measured, newest first."""
    left_out = [f":(exclude)aniso_pm/{name}" for name in NOT + OLD]
    command = ["git", "log", "--oneline", f"{commit}..HEAD", "--", *CODE, *left_out]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return found.stdout.splitlines()


def main() -> int:
    old = 0
    for figure in figures(TABLE.read_text(encoding="utf-8")):
        commits = since(figure.commit)
        old += bool(commits)
        age = f"{len(commits)} commits ago, last {commits[0]}" if commits else "of today's code"
        print(f"{figure.what} ({figure.command})\n    {age}")
    return 1 if old else 0


if __name__ == "__main__":
    sys.exit(main())
