"""The command line program ``aniso-pm``.

Exit status: 0 done; 2 wrong usage or input, said in one line; 1 anything else; 130 interrupted,
with the picture so far written where the integrator can give it. Mitsuba is imported inside the
commands only.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated, Any

import typer
from aniso_pm._version import __version__
from aniso_pm.errors import Failed, InputError, one_line
from aniso_pm.pictures import output

from . import bench, cluster, examine, explain, reference, render, report, scenes, view
from .common import INTERRUPTED, InterruptError, interruptible

app = typer.Typer(
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main(arguments: list[str] | None = None) -> int:
    """Run the program with ``arguments`` (default: ``sys.argv``) and return its exit status."""
    # Closed by who called us.
    sys.stdout, sys.stderr = (s or open(os.devnull, "w") for s in (sys.stdout, sys.stderr))
    try:
        return app(args=arguments, prog_name="aniso-pm", standalone_mode=False) or 0
    except (InputError, output.OutputError) as error:
        return _fail(2, str(error), error)
    except Failed as error:
        return _fail(1, str(error), error)
    except BrokenPipeError:
        # The reader of our output has left ("| head"): nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except BaseException as error:
        if hasattr(error, "format_message"):  # typer's own: wrong usage
            command = getattr(getattr(error, "ctx", None), "command_path", "aniso-pm")
            return _fail(2, f"{_wrong_usage(error)} (see {command} --help)", error)
        if isinstance(error, InterruptError):
            return _fail(INTERRUPTED, str(error), error)
        if isinstance(error, typer.Abort | KeyboardInterrupt):
            return _fail(INTERRUPTED, str(InterruptError()), error)
        if isinstance(error, SystemExit):
            raise
        return _fail(1, f"{type(error).__name__}: {one_line(error)}", error)


def _wrong_usage(error: Any) -> str:
    """Typer's message, with the value where what checked it (pydantic) leaves that out."""
    message: str = error.format_message()
    checks: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
    values = [repr(check["input"]) for check in checks if "input" in check]
    return f"{message}, not {', '.join(values)}" if values else message


def _fail(status: int, message: str, error: BaseException) -> int:
    if os.environ.get("ANISO_PM_TRACEBACK"):
        import traceback

        traceback.print_exception(error)
    print(f"aniso-pm: error: {one_line(message)}", file=sys.stderr)
    return status


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"aniso-pm {__version__}")
        raise typer.Exit()


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Say which.")
    ] = False,
) -> None:
    """Photon mapping with anisotropic density estimation for Mitsuba 3.

    With ANISO_PM_TRACEBACK=1 in the environment, errors come with their Python traceback.
    """


for command in (
    render.render,
    render.merge,
    view.view,
    reference.reference,
    report.report,
    scenes.scenes,
    examine.inspect,
    explain.explain,
    examine.stability,
    examine.doctor,
    bench.bench,
    cluster.cluster,
):
    app.command()(interruptible(command))
