"""The annotations of the library are right, as far as mypy can tell."""

import subprocess
import sys
from pathlib import Path


def test_mypy_finds_nothing(tmp_path):
    root = Path(__file__).resolve().parent.parent
    command = [sys.executable, "-m", "mypy", "--cache-dir", tmp_path]
    found = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
