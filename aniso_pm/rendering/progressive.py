"""Passes: fresh photons and fresh eye paths at a shrinking bandwidth, until a rule says stop.

Probabilistic progressive photon mapping [Knaus and Zwicker 2011]: the kernel of pass i, counted
from 0, has (i + α)/(i + 1) times the area of that of the pass before. Variance grows and bias
shrinks so that the mean over passes converges to the right image. Passes are pure: pass i depends
on (scene, parameters, seed, i) alone, so that they can be rendered in several runs, or on several
machines, and added up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import mitsuba as mi

from ..errors import Failed, is_interrupt
from ..pictures.output import OutputError
from . import advice, memory, state
from . import film as films
from .accumulate import mean_and_variance, relative_standard_error
from .beginning import Decided, decide
from .controls import Controls, Rendered
from .done import Batch, Done
from .interrupts import Interrupts
from .one_pass import Tracer
from .prepared import Prepared
from .schedule import LARGEST, bandwidth
from .stage_times import Clock
from .stopping import Stopping


def render(scene: Prepared, sensor, seed: int, spp: int, controls: Controls, statistics: dict):
    """Render passes until a stopping rule says so; leaves the picture in the sensor's film.

    spp         see ``shares``; 0 takes the sampler's own.
    statistics  filled in as rendering goes on.

    Ctrl-C ends rendering: the film then holds all passes that were finished, or the wavefronts of
    the first one, and statistics["interrupted"] is True. It is raised on where there is nothing.
    A ``Failed`` of those who render the passes ends it likewise; statistics["failure"] is its text,
    or that of the error that kept the state from the disk.
    Raises state.StateError where the checkpoint's state is not one of this rendering.
    """
    run = Run(scene, sensor, seed, spp, controls, statistics)
    try:
        with run.interrupts:
            run.start()
            if controls.elsewhere:
                controls.elsewhere(run)
            else:
                for index in run.numbers():
                    run.render_pass(index)
                    run.interrupts.check()
    except BaseException as error:
        failed = isinstance(error, Failed)
        if not (failed or is_interrupt(error)) or not run.keep_unfinished():
            raise
        statistics["interrupted"] = True
        if failed:
            statistics["failure"] = str(error)
    finally:
        run.stopping.close()
    run.finish()
    advice.after(scene, statistics)
    return run.rendered()


class Run:
    """One call of ``render``: which passes, what is told of them, and what is kept."""

    decided: Decided  # from ``start`` on
    identity: dict[str, Any]  # of a rendering with a checkpoint, from ``start`` on
    tracer: Tracer | None = None

    def __init__(self, scene, sensor, seed, spp, controls, statistics):
        self.given, self.sensor, self.seed, self.spp = scene, sensor, seed, spp
        self.controls, self.statistics = controls, statistics
        self.film = sensor.film()
        self.stopping = Stopping(scene.settings)
        self.interrupts = Interrupts()
        self.clock = Clock()
        self.radius = self.variance = None
        self.done = Done.nothing()

    @property
    def passes(self) -> int:
        """Whole ones that are done."""
        return self.done.counts["passes"]

    # --- Before the first pass ---

    def start(self):
        """Pilot, or the state of an earlier run."""
        checkpoint = self.controls.checkpoint
        earlier = checkpoint.start() if checkpoint else None
        self.decided = decide(
            self.given,
            self.sensor,
            self.seed,
            self.spp,
            self.controls,
            earlier.settled if earlier else self.controls.settled,
        )
        self.clock.lap("pilot")
        self.stopping.count_compilation()
        self.tracer = Tracer(self.decided, self.sensor, self.seed, self.clock)
        if checkpoint:
            self.identity = self.decided.identity(self.sensor, self.seed)
        self.statistics |= {
            **self.decided.statistics(self.given.settings),
            **self.done.counts,
            "relative_error": None,
            "interrupted": False,
            "seconds": self.clock.seconds,
        }
        if earlier:
            self._go_on_from(earlier)

    def _go_on_from(self, earlier: state.State):
        path = self.controls.checkpoint.path
        earlier.check_same(self.identity, path)
        first, count = self.controls.first_pass, self.given.settings.passes
        end = first + count if count else math.inf
        if any(a < first or b > end for a, b in earlier.passes):
            wanted = f"{first}-{end - 1}" if count else f"{first} and later"
            raise state.StateError(
                f"{path}: holds passes {state.describe(earlier.passes)}, "
                f"but passes {wanted} are asked for"
            )
        self.done = Done.earlier(earlier)
        self.stopping.spent_before = earlier.seconds
        self.statistics |= self.done.counts
        self.clock.go_on_from(earlier.statistics["seconds"])

    # --- Passes ---

    def numbers(self):
        """Pass numbers to render, until a rule says stop."""
        first, count = self.controls.first_pass, self.given.settings.passes
        done = set(state.numbers(self.done.passes))
        self._check_error()
        for index in range(first, first + count) if count else itertools.count(first):
            if index in done:
                continue
            # Estimates between those that are due are for people: no rendering ends by them.
            due = self.stopping.error_is_due(len(done))
            error = self.statistics["relative_error"] if due else None
            if self.stopping.reached(len(done), error):
                return
            if self.decided.shares.before(index + 1) > LARGEST:
                raise Failed(
                    f"aniso_pm: pass {index} goes beyond sample {LARGEST} of a pixel, the last "
                    "that has a number; go on with another seed"
                )
            yield index
            done.add(index)

    def render_pass(self, index: int):
        """One pass, and what is due after it."""
        assert self.tracer
        with self.stopping.measured():
            traced = self.tracer(index, self._report)
            self.done = self.done.with_pass(index, traced, self.decided.variance)
            self.tracer.unfinished = None
            self.radius = self.tracer.radius
            stored = self.decided.wavefronts.with_stored(self.tracer.photons)
            self.statistics |= {
                **self.done.counts,
                "radius": self.radius,
                "memory_estimate": stored.bytes / memory.GIB,
                "replayed": self.tracer.replayed,
            }
            self._check_error()
            self.clock.lap("film")
            self._report(index, 1)
            self._after_pass(index)

    def forget_passes(self):
        """Forget all passes that are done."""
        self.done = Done.nothing()
        self.clock.seconds.clear()

    def batch(self) -> Batch:
        """The passes since ``forget_passes``."""
        done = self.done
        return Batch(done.passes, done.arrays(), done.counts, dict(self.clock.seconds))

    def add(self, batch: Batch):
        """Passes that were rendered elsewhere, and what is due after them."""
        self.done = self.done.with_batch(batch)
        self.clock.skip()  # the time of those who rendered them counts
        self.clock.go_on_from(batch.seconds)
        last = self.done.passes[-1][1] - 1
        self.radius = bandwidth(self.decided.settled.radius, self.given.settings.alpha, last)
        self.statistics |= {**self.done.counts, "radius": self.radius}
        self._estimate_error()
        self._report(last, 1)
        self._after_pass(last)

    # --- After a pass ---

    def _check_error(self):
        """Estimate the error after each pass, and rarer the more there are, if anybody asks."""
        asked = self.given.settings.target_error or self.controls.progress or self.controls.callback
        if asked and self.stopping.error_is_due(self.passes):
            self._estimate_error()

    def _estimate_error(self):
        if self.passes > 1 and self.done.sums.square is not None:
            mean, self.variance = mean_and_variance(self.done.sums.arrays(), self.passes)
            self.statistics["relative_error"] = relative_standard_error(mean, self.variance)

    def _report(self, index: int, part: float):
        if self.controls.progress is None:
            return
        count, error = self.passes, self.statistics["relative_error"]
        total = self.stopping.expected_total(count, error)
        number = f"pass {index + 1}"
        if self.given.settings.passes:
            number += f"/{self.controls.first_pass + self.given.settings.passes}"
        text = number + (f", error {error:.2%}" if error else "")
        with self.stopping.not_counted():
            self.controls.progress(count + part if part < 1 else count, total, text)
        self.clock.lap("output")

    def report_elsewhere(self, count: int):
        """Tell that ``count`` passes are rendered, not all of which are here."""
        if self.controls.progress:
            error = self.statistics["relative_error"]
            total = self.stopping.expected_total(count, error)
            text = f"{count} passes" + (f", error {error:.2%}" if error else "")
            with self.stopping.not_counted():
                self.controls.progress(count, total, text)

    def _after_pass(self, index: int):
        checkpoint, callback = self.controls.checkpoint, self.controls.callback
        due = checkpoint is not None and checkpoint.due()
        if due or callback:
            films.show(self.film, self.done.sums.film_tensor())
            if due:
                self._estimate_error()
            if self.controls.so_far:
                with self.stopping.not_counted():
                    self.controls.so_far(self.variance, self.done.layers, self.passes)
        if callback:
            with self.stopping.not_counted():
                callback(index, self.film.develop(), dict(self.statistics))
        if due:
            self._save()
        if due or callback:
            self.clock.lap("output")

    def _save(self):
        """State and picture so far to the disk, if there is room; rendering goes on anyway."""
        checkpoint = self.controls.checkpoint
        try:
            checkpoint.write(self._state())
            if checkpoint.on_write:
                with self.stopping.not_counted():
                    checkpoint.on_write()
        except OutputError as error:
            checkpoint.put_off()
            mi.Log(mi.LogLevel.Warn, f"aniso_pm: {error}; rendering goes on")

    def _state(self) -> state.State:
        return state.State(
            self.identity,
            films.describe(self.film),
            self.done.passes,
            self.stopping.spent(),
            self.statistics,
            self.done.arrays(),
            self.decided.settled,
        )

    # --- At the end ---

    def keep_unfinished(self) -> bool:
        """After an interruption: keep whole passes, or the wavefronts of the first one where there
        are none. Is there a picture?"""
        unfinished = self.tracer and self.tracer.unfinished
        if self.done.sums is None and unfinished:
            self.done = Done.part(unfinished)
        return self.done.sums is not None

    def finish(self):
        """The picture into the film, the state to the disk: a picture is not lost because its
        state cannot be kept."""
        self.statistics |= self.done.counts
        if self.done.sums is not None:
            films.show(self.film, self.done.sums.film_tensor())
        if self.done.passes:
            self._estimate_error()
            if self.controls.checkpoint:
                try:
                    self.controls.checkpoint.write(self._state())
                except OutputError as error:
                    failures = filter(None, [self.statistics.get("failure"), str(error)])
                    self.statistics["failure"] = "; ".join(failures)
                    mi.Log(mi.LogLevel.Warn, f"aniso_pm: {error}")

    def rendered(self) -> Rendered:
        """What is left."""
        scene = self.tracer.scene if self.tracer else self.decided.scene
        chosen = replace(scene, footprint=None)
        return Rendered(
            chosen, self.tracer.map, self.radius, self.variance, self.done.layers, self.passes
        )
