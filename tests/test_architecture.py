"""Who imports whom: the rooms of docs/architecture.md."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_rooms_know_those_below_them_and_run_in_no_circles(tmp_path):
    linter = Path(sys.executable).with_name("lint-imports")
    command = [linter, "--no-logo", "--cache-dir", tmp_path]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
    assert "2 kept, 0 broken" in found.stdout


def test_every_figure_names_its_page_its_command_and_its_commit():
    sys.path.insert(0, str(ROOT / "tools"))
    import figures

    text = figures.TABLE.read_text()
    found = figures.figures(text)
    assert len(found) == text.count("\n| ") - 1
    for figure in found:
        assert figure.page.exists() and figure.command.split()[0] in (
            "aniso-pm",
            "python",
            "pytest",
        )
