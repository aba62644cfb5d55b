"""What a cluster of so many workers would do: a model by arithmetic, and a simulation.

Everything that takes time has a figure: a pass, a task's overhead on the worker, a task's share of
the one process that runs client and scheduler, an addition of two sums, their way over the network,
the client's work when sums come home. The model says where each resource is used up:

    workers    W / (t + o/n) passes a second, for passes of t seconds, tasks of n passes, overhead o
    scheduler  n / c, for c seconds of client and scheduler a task
    client     S/b + h seconds between two times of H seconds, for sums of S bytes, b bytes a
               second, h seconds of work on them

and the first of them is the bottleneck. The simulation plays the same with the ledger and the pace
that really hand out passes, with workers of uneven speed that straggle and die.
"""

from __future__ import annotations

import heapq
import math
import random
from dataclasses import asdict, dataclass, replace
from typing import Any

from .ledger import Ledger
from .pace import Pace


@dataclass(frozen=True)
class Costs:
    """Figures of one picture on one kind of machine. Seconds and bytes.

    pass_seconds    of a pass on one worker.
    pixels          of the film; channels: of its sums, weight included.
    task_overhead   of a task on the worker, beside its passes.
    task_client     of a task in the process of client and scheduler.
    add_per_byte    of adding two sums, for each byte of one of them.
    home_per_byte   of the client's work on sums that came home: adding, error, state, picture.
    bandwidth       bytes a second between two machines.
    parcel          bytes of the scene with its files.
    startup         of a worker that joins: imports, scene, kernels.

    Bytes and ``add_per_byte`` were measured; the other defaults are orders of magnitude, to be
    replaced by ``aniso-pm cluster --measure`` and by what is known of the cluster.
    """

    pass_seconds: float = 0.4
    pixels: int = 640 * 480
    channels: int = 4
    task_overhead: float = 0.01
    task_client: float = 0.006
    add_per_byte: float = 1.9e-9
    home_per_byte: float = 1.5e-8
    bandwidth: float = 117e6
    parcel: int = 1 << 20
    startup: float = 15.0

    @property
    def sum_bytes(self) -> int:
        """Of one sum over passes: three double-precision numbers a channel of a pixel."""
        return self.pixels * self.channels * 8 * 3


@dataclass(frozen=True)
class Conditions:
    """How a cluster is used, and what happens on it.

    workers       processes.
    task_seconds, home_every  as ``Options`` has them.
    spread        of the workers' speeds: standard deviation of their logarithms.
    stragglers    share of tasks that take ``slowdown`` times as long.
    deaths        of a worker in an hour; another takes its place after ``Costs.startup``.
    """

    workers: int = 64
    task_seconds: float = 5.0
    home_every: float = 30.0
    spread: float = 0.1
    stragglers: float = 0.01
    slowdown: float = 5.0
    deaths: float = 0.1


def predict(costs: Costs, conditions: Conditions) -> dict[str, Any]:
    """Passes a second that each resource allows, the first bottleneck, and what to set."""
    n = max(1, round(conditions.task_seconds / costs.pass_seconds))
    task = n * costs.pass_seconds + costs.task_overhead + costs.sum_bytes * costs.add_per_byte
    home = costs.sum_bytes * (1 / costs.bandwidth + costs.home_per_byte)
    depth = max(1, math.ceil(math.log(max(2, conditions.workers), 4)))
    tree = depth * 4 * costs.sum_bytes * (1 / costs.bandwidth + costs.add_per_byte)
    period = conditions.home_every + home
    busy = home / period
    # Additions of the tree take turns with rendering: one of four sums for three workers.
    adding = 4 / 3 * costs.sum_bytes * costs.add_per_byte / period
    limits = {
        "workers": conditions.workers * n / task * (1 - min(1.0, adding)),
        "scheduler": n / costs.task_client * (1 - busy),
    }
    first = min(limits, key=lambda name: limits[name])
    if busy > 0.5:
        first = "client"
    return {
        "passes a task": n,
        "passes a second": min(limits.values()),
        "limits": limits,
        "bottleneck": first,
        "seconds to come home": home + tree,
        "share of the client's time for that": busy,
        "bytes of a sum": costs.sum_bytes,
        "bytes home a second": costs.sum_bytes / period,
        "seconds to send the scene": costs.parcel
        / costs.bandwidth
        * math.ceil(math.log2(conditions.workers + 1)),
        "workers that one scheduler serves": math.floor((1 - busy) * task / costs.task_client),
        "advice": advice(costs, conditions, first, busy),
    }


def advice(costs: Costs, conditions: Conditions, first: str, busy: float) -> str:
    """What to set, in a sentence."""
    if first == "client":
        every = math.ceil(costs.sum_bytes * (1 / costs.bandwidth + costs.home_per_byte) / 0.1)
        return f"let sums come home every {every} s (--save-every): it takes {busy:.0%} of its time"
    if first == "scheduler":
        seconds = math.ceil(2 * conditions.workers * costs.task_client)
        return f"tasks of {seconds} s (--task-seconds)"
    return "nothing: the workers themselves are the limit"


@dataclass
class _Worker:
    speed: float
    ready: float = 0.0  # when it has done all that it was given
    alive: int = 0  # how often it has died: tasks of former lives are lost


def simulate(
    costs: Costs, conditions: Conditions, seconds: float = 600.0, seed: int = 0
) -> dict[str, Any]:
    """So many seconds of rendering, after all workers have joined."""
    return _Simulation(costs, conditions, seconds, seed).result()


class _Simulation:
    """Events in the order of time: (when, number, what, worker, its life, carrier)."""

    def __init__(self, costs: Costs, conditions: Conditions, seconds: float, seed: int):
        self.costs, self.conditions, self.seconds = costs, conditions, seconds
        self.chance = random.Random(seed)
        self.ledger, self.pace = Ledger(0, 0, []), Pace(conditions.task_seconds, None)
        self.pace.seen(costs.pass_seconds, 1, first=False)
        normal = self.chance.gauss
        self.workers = [
            _Worker(math.exp(normal(0, conditions.spread))) for _ in range(conditions.workers)
        ]
        self.client = 0.0  # until when it is busy
        self.client_busy = self.idle = self.lost = 0.0
        self.events: list[tuple] = []
        self.number = self.deaths = 0
        self.held: dict[int, list[int]] = {k: [] for k in range(conditions.workers)}
        self._run()

    def _push(self, when: float, what: str, who: int = 0, life: int = 0, carrier: int = 0):
        self.number += 1
        heapq.heappush(self.events, (when, self.number, what, who, life, carrier))

    def _run(self) -> None:
        conditions = self.conditions
        for who in range(conditions.workers):
            self._push(0.0, "give", who)
            self._push(0.0, "give", who)  # one that waits
            if conditions.deaths:
                self._push(self.chance.expovariate(conditions.deaths / 3600), "dies", who)
        self._push(conditions.home_every, "home")
        while self.events:
            now, _, what, who, life, carrier = heapq.heappop(self.events)
            if now > self.seconds:
                break
            getattr(self, f"_{what}")(now, who, life, carrier)

    def _served(self, now: float, seconds: float) -> float:
        """When the client has done some work that is asked for now."""
        self.client = max(self.client, now) + seconds
        self.client_busy += seconds
        return self.client

    def _give(self, now, who, life, carrier):
        worker = self.workers[who]
        if life != worker.alive:
            return
        self.number += 1
        carrier, count = self.number, self.pace.passes(math.inf, len(self.workers))
        self.ledger.take(carrier, count)
        given = self._served(now, self.costs.task_client)
        begin = max(given, worker.ready)
        self.idle += begin - max(worker.ready, 0.0)
        slow = self.conditions.slowdown if self.chance.random() < self.conditions.stragglers else 1
        took = count * self.costs.pass_seconds * worker.speed * slow + self.costs.task_overhead
        took += self.costs.sum_bytes * self.costs.add_per_byte
        worker.ready = begin + took
        self._push(worker.ready, "ends", who, life, carrier)
        self.held[who].append(carrier)  # lost with the worker, done or not

    def _ends(self, now, who, life, carrier):
        if life == self.workers[who].alive:
            self._push(now, "give", who, life)

    def _dies(self, now, who, life, carrier):
        worker = self.workers[who]
        worker.alive += 1
        self.deaths += 1
        for carrier in self.held[who]:
            self.lost += sum(b - a for a, b in self.ledger.carried.get(carrier, []))
            self.ledger.give_back(carrier)
        self.held[who].clear()
        worker.ready = back = now + self.costs.startup
        self._push(back, "give", who, worker.alive)
        self._push(back, "give", who, worker.alive)
        again = self.chance.expovariate(self.conditions.deaths / 3600)
        self._push(back + again, "dies", who)

    def _home(self, now, who, life, carrier):
        """All that has ended comes home."""
        running = {event[5] for event in self.events if event[2] == "ends"}
        done = [c for carriers in self.held.values() for c in carriers if c not in running]
        for carriers in self.held.values():
            carriers[:] = [c for c in carriers if c in running]
        if done:
            self.ledger.unite("home", done)
            self.ledger.count("home")
        seconds = self.costs.sum_bytes * (1 / self.costs.bandwidth + self.costs.home_per_byte)
        back = self._served(now, seconds)
        self._push(back + self.conditions.home_every, "home")

    def result(self) -> dict[str, Any]:
        home = sum(b - a for a, b in self.ledger.counted)
        running = {event[5] for event in self.events if event[2] == "ends"}
        there = sum(
            b - a
            for carrier, passes in self.ledger.carried.items()
            if carrier not in running
            for a, b in passes
        )
        done = home + there
        ideal = self.conditions.workers / self.costs.pass_seconds
        return {
            "passes a second": done / self.seconds,
            "efficiency": done / self.seconds / ideal,
            "client busy": min(1.0, self.client_busy / self.seconds),
            "workers waiting": self.idle / self.seconds / self.conditions.workers,
            "deaths": self.deaths,
            "passes lost": self.lost / max(1, done + self.lost),
        }


def table(
    costs: Costs, counts: list[int], conditions: Conditions, seconds: float = 600.0
) -> list[dict[str, Any]]:
    """Model and simulation for several numbers of workers."""
    rows = []
    for count in counts:
        here = replace(conditions, workers=count)
        rows.append(
            {
                "workers": count,
                "model": predict(costs, here),
                "simulation": simulate(costs, here, seconds),
                "conditions": asdict(here),
            }
        )
    return rows
