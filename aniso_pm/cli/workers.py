"""Options of ``aniso-pm render`` that let the workers of a Dask cluster render."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError

Workers = Annotated[
    int | None,
    typer.Option(min=1, max=4096, help="Render in so many processes on this machine."),
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Render on this Dask scheduler's workers.")
]
SchedulerFile = Annotated[
    Path | None,
    typer.Option("--scheduler-file", help="Likewise; the file that the scheduler has written."),
]
Mixed = Annotated[
    bool, typer.Option("--mixed", help="Let LLVM and CUDA workers render one picture.")
]
TaskSeconds = Annotated[
    float | None,
    typer.Option(
        "--task-seconds", min=0.01, help="Seconds that a worker's task takes.  [default: 5]"
    ),
]
TaskLimit = Annotated[
    float | None,
    typer.Option("--task-limit", min=0.1, help="Seconds after which a worker's task has hung."),
]
TlsCa = Annotated[Path | None, typer.Option("--tls-ca-file", help="CA file, as of `dask worker`.")]
TlsCert = Annotated[Path | None, typer.Option("--tls-cert", help="Certificate, likewise.")]
TlsKey = Annotated[Path | None, typer.Option("--tls-key", help="Key, likewise.")]


# Seconds for processes of this machine to start, or to be started again, however busy it is.
_LOCAL_PATIENCE = 180.0


@contextmanager
def rendering_elsewhere(
    integrator,
    scene: Path,
    defines: dict[str, str],
    sensor: int,
    workers: int | None,
    scheduler: str | None,
    scheduler_file: Path | None,
    tls: dict[str, Path | None],
    *,
    mixed: bool,
    task_seconds: float | None,
    task_limit: float | None,
    home_every: float,
    passes: int,
) -> Iterator[None]:
    """Let ``integrator`` render on workers inside the block, if they are asked for.

    mixed, task_seconds, task_limit, home_every: of ``distributed.Options``. passes: that it will
    render, 0 without end.
    """
    ways = {"--workers": workers, "--scheduler": scheduler, "--scheduler-file": scheduler_file}
    asked = [name for name, value in ways.items() if value]
    tls_given = {f"tls_{name}": str(path) for name, path in tls.items() if path}
    if len(asked) > 1:
        raise InputError(f"{' and '.join(asked)}: give one of them")
    if tls_given and not scheduler and not scheduler_file:
        raise InputError("--tls-…: only with --scheduler or --scheduler-file")
    if not asked:
        others = {"--mixed": mixed, "--task-seconds": task_seconds, "--task-limit": task_limit}
        if given := [name for name, value in others.items() if value]:
            raise InputError(f"{', '.join(given)}: only with one of {', '.join(ways)}")
        yield
        return
    if not hasattr(integrator, "elsewhere"):
        raise InputError(f"{asked[0]}: {integrator.class_name()} renders in this process only")

    from aniso_pm.distributed.cluster import connected, local, require

    require()
    from aniso_pm.distributed import Elsewhere, Options, Parcel

    if passes == 1:
        warn(f"{asked[0]}: a single pass is one worker's work; give --passes, or --time")
    parcel = Parcel.of(scene, defines)
    if workers:
        place = local(workers)
    else:
        place = connected(scheduler, scheduler_file, tls_given)
    with place as client:
        patience = _LOCAL_PATIENCE if workers else Options.patience
        chosen = Options(
            task_seconds=task_seconds or Options.task_seconds,
            task_limit=task_limit,
            patience=patience,
            keep=workers or 0,
            home_every=home_every,
            mixed=mixed,
        )
        integrator.elsewhere = Elsewhere(client, parcel, sensor, chosen, warn)
        try:
            yield
        finally:
            integrator.elsewhere = None


def warn(text: str) -> None:
    """On standard error."""
    print(f"aniso-pm: warning: {text}", file=sys.stderr)
