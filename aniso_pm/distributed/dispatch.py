"""Passes handed out to workers, added up there, and brought home: the loop of the client.

A *carrier* is something on the cluster that stands for passes: a task that renders them, or a sum
of several carriers. One rule covers all that can go wrong: a carrier that fails, is lost, or takes
too long gives its passes back to the ledger, and somebody else renders them. Dask itself renders
again what a worker had that died.

Results of a worker are added up where they are, as soon as there are two, so that it holds few
pictures however many passes it has rendered. Now and then all sums go through a tree of additions,
and the client gets one.
"""

from __future__ import annotations

import math
import queue
import threading
import time
import uuid
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import mitsuba as mi
from aniso_pm.errors import Failed, is_interrupt, one_line
from aniso_pm.rendering import digest
from aniso_pm.rendering.done import Batch
from aniso_pm.rendering.progressive import Run

from . import worker
from .crew import Crew, gone
from .ledger import Ledger
from .options import Options
from .pace import Pace
from .parcel import Parcel

# Sums that one addition of the tree takes.
_ARITY = 4
# Tasks per worker: one that it renders, one that waits.
_AHEAD = 2
# Seconds for the last sums to come home when rendering was interrupted.
_SALVAGE = 10.0
# Groups of deaths (Dask counts each task's) without one finished task, after which it is given up.
_DEATHS = 3
# Where an error is aimed at, or a state is due to be saved, sums come home so often at most: share
# of the time, and seconds.
_HOME_SHARE, _HOME_LEAST = 0.05, 1.0


@dataclass
class _Carrier:
    """What stands for passes. due: when to give up; places: workers that it, or its parts, are on,
    as far as known; bound: sets of workers outside of which it, or its parts, may not be."""

    key: str
    future: Any
    passes: int
    due: float
    renders: bool
    places: frozenset[str] = frozenset()
    bound: frozenset[frozenset[str]] = frozenset()
    done: bool = False
    started: float | None = None
    fetching: bool = False
    made: float = field(default_factory=time.monotonic)


class Elsewhere:
    """Renders passes on the workers of a Dask cluster: what ``Controls.elsewhere`` takes.

    client  a blocking ``distributed.Client``.
    parcel  the scene; sensor: number of its camera.
    warn    called with a sentence about each worker that is not used.
    """

    def __init__(
        self,
        client,
        parcel: Parcel,
        sensor: int = 0,
        options: Options | None = None,
        warn: Callable[[str], None] = lambda text: mi.Log(mi.LogLevel.Warn, f"aniso_pm: {text}"),
    ):
        self.client, self.parcel, self.sensor = client, parcel, sensor
        self.options, self.warn = options or Options(), warn

    def __call__(self, run: Run) -> None:
        _Dispatch(self, run).render()

    def job(self, run: Run) -> worker.Job:
        """What workers have to know."""
        scene = run.decided.scene
        return worker.Job(
            f"aniso_pm-{uuid.uuid4().hex[:12]}",
            self.parcel,
            worker.versions(),
            mi.variant(),
            digest.scene_entries(scene.scene) | digest.camera_entries(run.sensor),
            self.options.mixed,
            {
                # As given: what was chosen is in ``settled``.
                "settings": asdict(run.given.settings),
                "hide_emitters": scene.hide_emitters,
                "sensor": self.sensor,
                "seed": run.seed,
                "spp": run.spp,
                "first_pass": run.controls.first_pass,
                "settled": run.decided.settled,
                "variance": run.decided.variance,
            },
        )


class _Dispatch:
    """One rendering."""

    def __init__(self, elsewhere: Elsewhere, run: Run):
        self.run, self.client, self.options = run, elsewhere.client, elsewhere.options
        self.job = elsewhere.job(run)
        patience, keep = self.options.patience, self.options.keep
        self.crew = Crew(self.client, self.job, patience, keep, elsewhere.warn)
        self.pace = Pace(self.options.task_seconds, self.options.task_limit)
        first, count = run.controls.first_pass, run.given.settings.passes
        self.ledger = Ledger(first, count, run.done.passes)
        self.carriers: dict[str, _Carrier] = {}
        self.homing: _Carrier | None = None  # the sum of all, on its way home
        self.fetched: dict[str, Any] = {}  # sums that came home, or why they did not
        self.events: queue.SimpleQueue = queue.SimpleQueue()
        self.began = self.home = time.monotonic()
        self.home_cost = 0.0
        self.enough = False
        self.number = self.deaths = 0

    def render(self) -> None:
        """Give sums to the run as they come home. When that is interrupted, it gets what is ready
        before the exception goes on."""
        self.run.stopping.close()  # the pilot's kernels are compiled
        self.client.subscribe_topic(self.job.name, lambda event: self.events.put(event[1]))
        try:
            self._loop()
        except BaseException as error:
            if isinstance(error, Failed) or is_interrupt(error):
                self._salvage()
            raise
        finally:
            self._close()

    def _loop(self) -> None:
        while not self.ledger.finished:
            self.run.interrupts.check()
            self._check_scheduler()
            self.crew.update()
            self._give_up_stranded()
            self._decide()
            self._hand_out()
            self._hear(0.5)
            self._give_up_late()
            self._unite()
            if self._home_is_due():
                self._go_home()
            self._bring_home()
            if self.enough and not self.carriers:
                return

    # --- Handing out ---

    @property
    def rendering(self) -> list[_Carrier]:
        return [c for c in self.carriers.values() if c.renders and not c.done]

    @property
    def rendered(self) -> int:
        """Passes that are done, here or on the workers."""
        there = sum(c.passes for c in self.carriers.values() if c.done or not c.renders)
        return self.run.done.counts["passes"] + there

    def _decide(self) -> None:
        """Is it enough?"""
        error = self.run.statistics["relative_error"]
        if not self.enough and self.run.stopping.reached(self.rendered, error):
            self.enough = True
            # What has begun may end, if it does so in the time of one task; the rest is not needed.
            for carrier in self.rendering:
                if carrier.started is None:
                    self._drop(carrier)
                else:
                    expected = carrier.passes * (self.pace.each or 0)
                    carrier.due = min(carrier.due, time.monotonic() + max(1.0, expected))

    def _hand_out(self) -> None:
        if self.enough or not self.crew.good:
            return
        workers = len(self.crew.good)
        while (ahead := len(self.rendering)) < _AHEAD * workers:
            count = self.pace.passes(self.ledger.left, workers, self._seconds_left(workers))
            if count == 0 and not (ahead or self.rendered):
                count = 1  # the first pass is rendered whatever the time
            key = f"render-{self.job.name}-{self.number}"
            if not self.ledger.take(key, count):
                return
            self.number += 1
            future = self.client.submit(
                worker.render,
                self.crew.job,
                self.ledger.carried[key],
                key,
                key=key,
                workers=self.crew.allowed,
            )
            # Behind others it has to wait.
            due = time.monotonic() + 3 * _AHEAD * self.pace.limit(count)
            self._watch(_Carrier(key, future, count, due, True, bound=self._bound()))

    def _seconds_left(self, workers: int) -> float:
        """For a task that begins when what was handed out is done."""
        limit = self.run.given.settings.time
        if not limit:
            return math.inf
        if self.began:
            return limit
        ahead = sum(c.passes for c in self.rendering) * (self.pace.each or 0) / workers
        return limit - self.run.stopping.spent() - ahead

    def _watch(self, carrier: _Carrier) -> None:
        self.carriers[carrier.key] = carrier
        tell = {"what": "done", "task": carrier.key}
        carrier.future.add_done_callback(lambda _: self.events.put(tell))

    # --- Hearing ---

    def _hear(self, seconds: float) -> None:
        """Wait for news, and take in all there are."""
        try:
            self._take(self.events.get(timeout=seconds))
            while True:
                self._take(self.events.get_nowait())
        except queue.Empty:
            pass
        self.run.report_elsewhere(self.rendered)

    def _take(self, news: dict[str, Any]) -> None:
        what, carrier = news["what"], self.carriers.get(news["task"])
        if what == "failed":
            self.crew.refuse(news["worker"], news["reason"])
        elif what == "end":
            self.crew.readmit(news["worker"])
        if carrier is None:
            return
        now = time.monotonic()
        if what == "start":
            if self.began:  # the time for processes to start and to load the scene does not count
                self.run.stopping.set_aside(now - self.began)
                self.began = 0.0
            carrier.places, carrier.started = frozenset([news["worker"]]), now
            carrier.due = now + self.pace.limit(carrier.passes)
        elif what == "end":
            if self.pace.each is None:
                self.run.stopping.set_aside(news["compiling"])
            carrier.places = frozenset([news["worker"]])
            self.pace.seen(news["seconds"], carrier.passes, news["first"])
        elif what == "done":
            self._done(carrier)
        elif what == "fetched":
            self.fetched[carrier.key] = news["found"]

    def _done(self, carrier: _Carrier) -> None:
        if carrier.future.status == "finished":
            carrier.done, carrier.due, self.deaths = True, math.inf, 0
            return
        if carrier.future.status == "error":
            error = carrier.future.exception()
            if type(error).__name__ == "KilledWorker":
                self.deaths += 1
                if self.deaths >= _DEATHS:
                    raise Failed(
                        "workers die again and again while they render (is there memory enough? "
                        f"see the workers' logs): {one_line(error)}"
                    )
            elif carrier.renders:
                for address in carrier.places:
                    self.crew.refuse(address, f"{type(error).__name__}: {one_line(error)}")
        self._lost(carrier)

    def _bound(self) -> frozenset[frozenset[str]]:
        allowed = self.crew.allowed
        return frozenset() if allowed is None else frozenset([frozenset(allowed)])

    def _give_up_stranded(self) -> None:
        """What nobody is left for that may render it, Dask would keep for ever."""
        for carrier in list(self.carriers.values()):
            if carrier.future.status != "finished":
                if any(not workers & self.crew.known for workers in carrier.bound):
                    self._lost(carrier)

    def _give_up_late(self) -> None:
        """Carriers that take too long are lost; a worker that hangs is not used any more."""
        now, rendering = time.monotonic(), self.rendering
        idle = self.ledger.left == 0 and len(rendering) < len(self.crew.good)
        for carrier in list(self.carriers.values()):
            due = carrier.due
            if idle and carrier.renders and carrier.started and not carrier.done:
                due = min(due, carrier.started + self.pace.limit(carrier.passes, idle=True))
            if now < due or carrier.key not in self.carriers:
                continue
            places = [] if self.enough else self._where(carrier)
            self._lost(carrier)
            if self.enough:
                continue
            self.pace.too_long()
            for address in places:
                self._hangs(address, now - (carrier.started or carrier.made))

    def _where(self, carrier: _Carrier) -> list[str]:
        """Workers that a late carrier is late because of: that which renders it; or that which has
        it and does not begin, though it renders nothing else."""
        if carrier.done or carrier.started:
            return sorted(carrier.places) if carrier.renders else []
        busy = frozenset().union(*(c.places for c in self.rendering if c.started))
        having = self.client.processing().items()
        return [w for w, keys in having if carrier.key in keys and w not in busy]

    def _hangs(self, address: str, seconds: float) -> None:
        """What a worker has that hangs is lost."""
        self.crew.refuse(address, f"a task has not ended in {seconds:.0f} seconds", slow=True)
        for carrier in [c for c in self.carriers.values() if address in c.places]:
            self._lost(carrier)
        if self.options.keep:
            self.crew.restart(address)

    def _lost(self, carrier: _Carrier) -> None:
        self.ledger.give_back(carrier.key)
        self._drop(carrier)

    def _drop(self, carrier: _Carrier) -> None:
        self.ledger.give_back(carrier.key)
        self.carriers.pop(carrier.key, None)
        if self.homing is carrier:
            self.homing = None
        carrier.future.release()

    # --- Adding up ---

    def _unite(self) -> None:
        """Two results of the same worker become one, where they are."""
        by_worker = defaultdict(list)
        for carrier in self.carriers.values():
            if carrier.done and carrier is not self.homing and len(carrier.places) == 1:
                by_worker[carrier.places].append(carrier)
        for several in by_worker.values():
            if len(several) > 1:
                self._sum(several)

    def _sum(self, several: list[_Carrier]) -> _Carrier:
        """A carrier that is the sum of others, by a tree of additions in the order of passes."""
        several = sorted(several, key=lambda c: self.ledger.carried[c.key][0][0])
        layer = [carrier.future for carrier in several]
        while True:
            groups = [layer[k : k + _ARITY] for k in range(0, len(layer), _ARITY)]
            layer = [self._addition(group) for group in groups]
            if len(layer) == 1:
                break
        future, passes = layer[0], sum(carrier.passes for carrier in several)
        self.ledger.unite(future.key, [carrier.key for carrier in several])
        for carrier in several:
            del self.carriers[carrier.key]
        due = time.monotonic() + 3 * self.pace.limit(1)
        places = frozenset().union(*(carrier.places for carrier in several))
        bound = self._bound().union(*(carrier.bound for carrier in several))
        self._watch(_Carrier(future.key, future, passes, due, False, places, bound))
        return self.carriers[future.key]

    def _addition(self, futures: list):
        if len(futures) == 1:
            return futures[0]
        self.number += 1
        key = f"add-{self.job.name}-{self.number}"
        return self.client.submit(
            worker.add, *futures, key=key, workers=self.crew.allowed, priority=10
        )

    # --- Coming home ---

    def _home_is_due(self) -> bool:
        if self.homing or not any(carrier.done for carrier in self.carriers.values()):
            return False
        if (self.enough or self.ledger.left == 0) and all(c.done for c in self.carriers.values()):
            return True
        every, checkpoint = self.options.home_every, self.run.controls.checkpoint
        if self.run.given.settings.target_error or (checkpoint and checkpoint.due()):
            every = min(every, max(_HOME_LEAST, self.home_cost / _HOME_SHARE))
        return time.monotonic() - self.home > every

    def _go_home(self) -> None:
        ready = [carrier for carrier in self.carriers.values() if carrier.done]
        self.homing = self._sum(ready) if len(ready) > 1 else ready[0]
        self.home = time.monotonic()

    def _bring_home(self) -> None:
        """Give the sum of all to the run, if it is ready to be fetched."""
        carrier = self.homing
        if carrier is None or not carrier.done:
            return
        if carrier.future.status == "pending":  # its worker has died, Dask renders it again
            carrier.done, carrier.due = False, time.monotonic() + 3 * self.pace.limit(1)
            self._watch(carrier)
            return
        if not carrier.fetching:
            carrier.fetching, carrier.due = True, time.monotonic() + 3 * self.pace.limit(1)
            threading.Thread(target=self._fetch, args=[carrier], daemon=True).start()
        if carrier.key not in self.fetched:
            return
        self.homing, found = None, self.fetched.pop(carrier.key)
        if isinstance(found, BaseException):
            self._lost(carrier)
            return
        if self.ledger.count(carrier.key):
            self.run.add(Batch(**found))
        self._drop(carrier)
        self.home_cost = time.monotonic() - self.home
        self.home = time.monotonic()

    def _fetch(self, carrier: _Carrier) -> None:
        """In a thread: the worker that has the sum may hang, which others have to notice."""
        try:
            found = carrier.future.result()
        except Exception as error:
            found = error
        self.events.put({"what": "fetched", "task": carrier.key, "found": found})

    def _salvage(self) -> None:
        """Give what is ready on the workers to the run, if it comes soon."""
        until = time.monotonic() + _SALVAGE
        try:
            for carrier in self.rendering:
                self._drop(carrier)
            while self.carriers and time.monotonic() < until and self.client.status == "running":
                # One after the other: additions would wait for tasks that cannot be stopped.
                if not self.homing:
                    self.homing = next((c for c in self.carriers.values() if c.done), None)
                self._bring_home()
                self._hear(0.1)
        except (Failed, OSError):
            return  # nothing more to be had

    def _check_scheduler(self) -> None:
        if self.client.status != "running":
            raise Failed(gone(self.client))

    def _close(self) -> None:
        for carrier in list(self.carriers.values()):
            carrier.future.release()
        self.crew.close()
        if self.client.status == "running":
            self.client.unsubscribe_topic(self.job.name)
