"""What stands in several places says the same everywhere."""

import re
import subprocess
import sys
from pathlib import Path

import yaml
from aniso_pm import __version__, cli
from typer.main import get_command

ROOT = Path(__file__).resolve().parent.parent


def test_the_citation_names_the_paper_and_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    paper = citation["references"][0]
    assert paper["title"] == "Anisotropic Density Estimation for Photon Mapping"
    assert [author["family-names"] for author in paper["authors"]] == ["Luan", "Wu", "Xu"]


def test_the_changelog_knows_this_version_and_every_command():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert f"## {__version__}" in text
    for name in get_command(cli.app).commands:
        assert f"`{name}`" in text, name


def test_links_between_documents_lead_somewhere():
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    for document in documents:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", document.read_text()):
            if not target.startswith("http"):
                assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_the_shell_completes_commands():
    program = Path(sys.executable).with_name("aniso-pm")
    environment = {
        "_ANISO_PM_COMPLETE": "complete_bash",
        "COMP_WORDS": "aniso-pm exp",
        "COMP_CWORD": "1",
        "PATH": "/usr/bin:/bin",
    }
    found = subprocess.run([program], env=environment, capture_output=True, text=True)
    assert found.stdout.split() == ["explain"]
