"""``command-help``: what ``aniso-pm COMMAND --help`` prints, for every command there is."""

from aniso_pm.cli import app as program
from docutils import nodes
from docutils.parsers.rst import Directive
from typer.main import get_command
from typer.testing import CliRunner

_WIDTH = {"COLUMNS": "86", "TERMINAL_WIDTH": "86", "NO_COLOR": "1"}


class CommandHelp(Directive):
    def run(self):
        found = []
        for name in get_command(program).commands:
            text = CliRunner().invoke(program, [name, "--help"], env=_WIDTH).output
            text = text.replace("Usage: root ", "Usage: aniso-pm ").strip()
            section = nodes.section(ids=[f"aniso-pm-{name}"])
            section += nodes.title("", f"aniso-pm {name}")
            section += nodes.literal_block(text, text, language="text")
            found.append(section)
        return found


def setup(app):
    app.add_directive("command-help", CommandHelp)
    return {"parallel_read_safe": True}
