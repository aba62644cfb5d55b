"""The documentation site builds without a warning, and says what the code says."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from aniso_pm import cli
from aniso_pm.rendering.settings import Settings
from typer.main import get_command

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", out / "trees"]
    build = subprocess.run([*command, ROOT / "docs", out], capture_output=True, text=True)
    assert build.returncode == 0, build.stdout + build.stderr
    return out


def test_every_parameter_and_command_is_documented(site):
    plugins, commands = ((site / f"{p}.html").read_text() for p in ("plugins", "commands"))
    for field in fields(Settings):
        assert f"<p>{field.name}</p>" in plugins, field.name
    for name in get_command(cli.app).commands:
        assert f"Usage: aniso-pm {name}" in commands


def test_formulas_need_no_network(site):
    method = (site / "method.html").read_text()
    assert "<math" in method and "$$" not in method
    for page in site.glob("*.html"):
        assert '<script src="http' not in page.read_text(), page.name
