"""The workers of a cluster: who is there, who may render, who may not and why.

Every worker that the scheduler knows is asked to join: it loads the scene and compares itself with
the client. One that differs, or fails, is named and not asked again. Workers may come and go.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from aniso_pm.errors import Failed, one_line

from . import worker

# Seconds between two looks at who is there.
_LOOK = 0.5
# Seconds for a nanny to bring back a worker of ours.
_MISSED = 30.0
# Seconds for a worker to come while the others are refused.
_GRACE = 3.0
# Seconds in which a worker has to load the scene.
_JOINING = 600.0


@dataclass
class _Candidate:
    future: Any
    until: float


class Crew:
    """Workers for one job.

    client    a blocking ``distributed.Client``.
    patience  seconds to wait for a first worker, or another one when all are gone.
    keep      workers that the client's own cluster is to have; 0: it has none of its own.
    warn      called with a sentence for each worker that is not used.

    known     addresses of all who are there.
    """

    def __init__(
        self,
        client,
        job: worker.Job,
        patience: float,
        keep: int,
        warn: Callable[[str], None],
    ):
        self.client, self._job, self._warn = client, job, warn
        self._patience, self._keep = patience, keep
        self.good: dict[str, dict[str, Any]] = {}
        self.refused: dict[str, str] = {}
        self._joining: dict[str, _Candidate] = {}
        self.known: set[str] = set()
        self._slow: set[str] = set()
        self._looked = 0.0
        self._some = self._complete = time.monotonic()  # when there was last anybody, everybody
        self.job = None  # the job where workers can get it, sent once

    def update(self) -> None:
        """Look who is there. Raises Failed if that is nobody, and nobody can be hoped for."""
        now = time.monotonic()
        if now - self._looked < _LOOK:
            return
        self._looked = now
        self._look()
        if len(self.known) >= self._keep:
            self._complete = now
        elif now - self._complete > _MISSED:  # its nanny has not brought it back
            self._complete = now
            self.client.cluster.scale(self._keep)
        for address in self.known - {*self.good, *self.refused, *self._joining}:
            self._ask(address)
        self._hear()
        if self.good or self._joining:
            self._some = now
        # Who was slow may come back, or be started again.
        elif now - self._some > (_GRACE if self.refused and not self._slow else self._patience):
            raise Failed(self._nobody())

    def refuse(self, address: str, reason: str, slow: bool = False) -> None:
        """Use a worker no more. slow: it may come back (see ``readmit``)."""
        if slow:
            self._slow.add(address)
        if address in self.good or address in self._joining:
            self.good.pop(address, None)
            self._joining.pop(address, None)
            self.refused[address] = reason
            self._warn(f"worker {address} is not used: {reason}")

    def readmit(self, address: str) -> None:
        """Use a worker again that was slow, and not hanging."""
        if address in self._slow and self.refused.pop(address, ""):
            self.good[address] = {}
        self._slow.discard(address)

    @property
    def allowed(self) -> list[str] | None:
        """Who may be given tasks; None where that is everybody. Who has not joined yet does so with
        its first task."""
        return sorted(self.known - self.refused.keys()) if self.refused else None

    def restart(self, address: str) -> None:
        """Let its nanny end a worker and start another, without waiting for that."""
        options = {"timeout": 60, "raise_for_error": False}
        arguments = ([address],)
        threading.Thread(
            target=self.client.restart_workers, args=arguments, kwargs=options, daemon=True
        ).start()

    def close(self) -> None:
        for candidate in self._joining.values():
            candidate.future.release()
        self.job = None

    # --- Asking ---

    def _look(self) -> None:
        try:
            self.known = set(self.client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, TimeoutError) as error:
            raise Failed(gone(self.client)) from error
        for group in (self.good, self.refused, self._joining):
            for address in [a for a in group if a not in self.known]:
                del group[address]

    def _ask(self, address: str) -> None:
        if self.job is None or self.job.status in ("lost", "cancelled", "error"):
            self.job = self.client.scatter(self._job, hash=False, workers=[address])
        future = self.client.submit(
            worker.join,
            self.job,
            key=f"join-{self._job.name}-{address}-{time.monotonic_ns()}",
            workers=[address],
            allow_other_workers=False,
            priority=20,
        )
        self._joining[address] = _Candidate(future, time.monotonic() + _JOINING)

    def _hear(self) -> None:
        for address, candidate in list(self._joining.items()):
            status = candidate.future.status
            if status == "finished":
                self.good[address] = {}
                del self._joining[address]
            elif status == "error":
                self.refuse(address, _reason(candidate.future.exception()))
            elif status in ("lost", "cancelled"):
                del self._joining[address]  # the job's only copy may be lost: ask again
            elif time.monotonic() > candidate.until:
                self.refuse(address, f"it has not loaded the scene in {_JOINING:.0f} seconds")

    def _nobody(self) -> str:
        place = self.client.scheduler.address
        if not self.refused:
            return (
                f"no worker is connected to the scheduler {place}, and none has come for "
                f"{self._patience:g} seconds"
            )
        named = [f"{address}: {reason}" for address, reason in sorted(self.refused.items())]
        more = f" (and {len(named) - 3} more)" if len(named) > 3 else ""
        return f"no worker is left that can render: {'; '.join(named[:3])}{more}"


def gone(client) -> str:
    """What to say where the scheduler does not answer."""
    return (
        f"the scheduler {client.scheduler.address} is gone; start it again, and go on from the "
        "passes so far with --resume (Python: a checkpoint)"
    )


def _reason(error: BaseException) -> str:
    text = one_line(error)
    return text if isinstance(error, worker.Differs) else f"{type(error).__name__}: {text}"
