"""A client of a Dask cluster: one that is there, or a local one for as long as it is used."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from aniso_pm.errors import Failed, InputError, one_line

# Seconds to connect to a scheduler.
_CONNECT = 10
# Ctrl-C is for the client to take, which asks the workers for what they have.
_PRELOAD = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
# Key of Dask's configuration: the part of the memory of its machine that a worker may plan with.
MEMORY_SHARE = "aniso_pm.memory_share"
# Only this machine reaches local clusters.
_LOOPBACK = "127.0.0.1"


def require() -> None:
    """Raise InputError in one line unless ``dask.distributed`` is installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            "rendering on workers needs dask.distributed: pip install 'aniso-pm[distributed]'"
        ) from error


@contextmanager
def local(workers: int) -> Iterator[Any]:
    """A client of as many worker processes on this machine, which share its cores and its memory,
    and end with the block. They listen on the loopback address only."""
    require()
    import dask
    from distributed import Client, LocalCluster

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    settings = {
        "distributed.worker.daemon": True,
        # What workers inherit; they plan at the same time.
        MEMORY_SHARE: 1 / workers,
        # Statements about single tasks are ours.
        "distributed.admin.large-graph-warning-threshold": "1GB",
        "distributed.scheduler.allowed-failures": 10,
        # A worker that its nanny starts again may take long where the machine is busy.
        "distributed.deploy.lost-worker-timeout": "60s",
    }
    with dask.config.set(settings), ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aniso_pm-workers-"))
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=max(1, (cores or 1) // workers),
                processes=True,
                host=_LOOPBACK,
                dashboard_address=f"{_LOOPBACK}:0",
                local_directory=folder,
                memory_limit=0,  # renderings keep within their share
                preload=_PRELOAD,
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError, TimeoutError) as error:
            raise Failed(f"worker processes could not be started: {one_line(error)}") from error
        stack.enter_context(cluster)
        yield stack.enter_context(Client(cluster))


@contextmanager
def connected(
    scheduler: str | None = None,
    scheduler_file: Path | None = None,
    tls: dict[str, str] | None = None,
) -> Iterator[Any]:
    """A client of a scheduler that runs, by address or by the file that it has written.

    tls: ``tls_ca_file``, ``tls_client_cert``, ``tls_client_key``; those not named are what Dask's
    configuration says. Raises InputError where there is none.
    """
    require()
    from distributed import Client
    from distributed.security import Security
    from distributed.utils import silence_logging_cmgr

    place = scheduler or str(scheduler_file)
    if scheduler_file is not None and not Path(scheduler_file).is_file():
        raise InputError(f"{scheduler_file}: there is no such file; does the scheduler run?")
    if scheduler_file is not None and not _names_a_scheduler(scheduler_file):
        raise InputError(f"{scheduler_file}: this is no file that `dask scheduler` has written")
    if scheduler is not None:
        _check_address(scheduler)
    given: dict[str, Any] = {"security": Security(require_encryption=True, **tls)} if tls else {}
    given["scheduler_file" if scheduler_file else "address"] = place
    # What goes wrong is said by us, in one line.
    with silence_logging_cmgr(logging.CRITICAL):
        try:
            client = Client(timeout=_CONNECT, set_as_default=False, **given)
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            raise InputError(
                f"no Dask scheduler answers at {place} ({one_line(error)}); start one with `dask "
                "scheduler`, or render on this machine with --workers"
            ) from error
        try:
            yield client
        finally:
            client.close()


def _names_a_scheduler(file: Path) -> bool:
    try:
        return bool(json.loads(file.read_text())["address"])
    except (OSError, ValueError, TypeError, KeyError):
        return False


def _check_address(address: str) -> None:
    """Before Dask's client, which would try for long and speak for itself."""
    from distributed.comm.addressing import parse_address, parse_host_port

    scheme, place = parse_address(address)
    try:
        if scheme in ("tcp", "tls"):
            parse_host_port(place)
    except ValueError as error:
        raise InputError(
            f"'{address}' is no address of a Dask scheduler ({one_line(error)}); it looks like "
            "tcp://host:8786"
        ) from error
