"""A rendering that others look at, steer and question while it runs.

The main thread renders (:meth:`Session.run`) and looks between wavefronts and between passes what
is wanted of it; every other method is called from other threads and returns at once, but for
``explain``, which waits for the main thread to answer.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError, is_interrupt, one_line
from ..instruments.explain import explain
from ..pictures.output import OutputError
from ..rendering.film import describe
from .snapshot import Snapshot, status_of

# What may be changed from outside, as parameters of the integrator.
PARAMETERS = ("kernel", "rule", "map", "initial_radius", "layers")
# Seconds between looks at what is wanted, while nothing is rendered.
_TICK = 0.1
_ANSWER = 120.0


class _Stop(KeyboardInterrupt):
    """Ends a rendering as Ctrl-C does: the passes so far stay."""


@dataclass
class _Wanted:
    """What others want; changed under the lock."""

    paused: bool = False
    stop: bool = False
    restart: bool = False
    quit: bool = False


class Session:
    """One scene, rendered again and again, each time until it is done, stopped or begun anew.

    world, camera, integrator  an ``aniso_pm``, and what it renders.
    seed, spp                  as in ``render``.
    save                       writes the picture; returns the names of the files.
    """

    steered = True

    def __init__(
        self, name: str, world, camera, integrator, seed: int, spp: int, save: Callable[[], list]
    ):
        self.name = name
        self._world, self._camera, self._integrator = world, camera, integrator
        self._seed, self._spp, self._save = seed, spp, save
        self._wanted, self._lock = _Wanted(), threading.Lock()
        self._questions: queue.Queue[tuple[tuple[int, int], Future]] = queue.Queue()
        self._film = describe(camera.film())
        self._state, self._message = "starting", ""
        self._progress: tuple[float, float | None] = (0.0, None)
        self._statistics: dict[str, Any] = {}
        self._history: list[tuple[float, float]] = []
        self.snapshot: Snapshot | None = None
        integrator.callback, integrator.progress = self._after_pass, self._after_wavefront

    # --- The main thread ---

    def run(self) -> None:
        """Render until somebody quits. KeyboardInterrupt ends it, with the picture so far saved."""
        while True:
            self._render()
            while not self._take("restart"):
                if self._wanted.quit:
                    return
                self._answer(_TICK)

    def _render(self) -> None:
        self._statistics, self._history, self._progress = {}, [], (0.0, None)
        self._state, self._message = "rendering", ""
        try:
            # The film is developed after each pass; nobody needs it once more.
            self._integrator.render(
                self._world, sensor=self._camera, seed=self._seed, spp=self._spp, develop=False
            )
        except Exception as error:
            if not is_interrupt(error):
                self._state, self._message = "failed", one_line(error)
                return
            interrupted = True
        except KeyboardInterrupt:  # before there was anything
            interrupted = True
        else:
            interrupted = self._integrator.statistics["interrupted"]
        if interrupted and not (self._wanted.stop or self._wanted.restart or self._wanted.quit):
            raise KeyboardInterrupt
        if self._wanted.restart:
            return
        self._take("stop")
        self._state = "stopped" if interrupted else "done"
        if self._integrator.statistics.get("eye_samples"):
            self._statistics = dict(self._integrator.statistics)
            self._message = self._saved()
        else:
            self._message = "there was nothing to save yet"

    def _saved(self) -> str:
        """The picture is saved: what was done, or why not. It is shown all the same."""
        try:
            return "saved: " + ", ".join(str(path) for path in self._save())
        except OutputError as error:
            return f"not saved: {error}; Ctrl-C where it was started tries again"

    def _after_pass(self, index, image, statistics) -> None:
        version = (self.snapshot.version if self.snapshot else 0) + 1
        picture = np.array(image)
        picture = picture if picture.shape[2] >= 3 else np.repeat(picture[..., :1], 3, 2)
        self.snapshot = Snapshot(version, picture[..., :3], dict(self._integrator.layers))
        self._statistics = statistics
        found = status_of(statistics)
        if found["relative_error"]:
            self._history.append((found["seconds"], found["relative_error"]))
        self._obey()

    def _after_wavefront(self, done, total, text) -> None:
        self._progress = (done, total)
        self._obey()

    def _obey(self) -> None:
        self._answer(0)
        while True:
            wanted = self._wanted
            if wanted.stop or wanted.restart or wanted.quit:
                raise _Stop
            if not wanted.paused:
                break
            self._state = "paused"
            self._answer(_TICK)
        self._state = "rendering"

    def _answer(self, patience: float) -> None:
        """One question, if there is one within so many seconds."""
        try:
            pixel, answer = (
                self._questions.get(timeout=patience)
                if patience
                else (self._questions.get_nowait())
            )
        except queue.Empty:
            return
        try:
            index = max(0, self._statistics.get("passes", 1) - 1)
            found = explain(
                self._world,
                pixel,
                self._integrator,
                self._camera,
                self._seed,
                index,
                spp=self._spp,
            )
            answer.set_result(str(found))
        except Exception as error:
            answer.set_exception(error)

    def _take(self, name: str) -> bool:
        """Is it wanted? Then it is no more."""
        with self._lock:
            found = getattr(self._wanted, name)
            setattr(self._wanted, name, False)
            return found

    def _want(self, **changes: bool) -> None:
        with self._lock:
            for name, value in changes.items():
                setattr(self._wanted, name, value)

    # --- Other threads ---

    def pause(self) -> None:
        """Until ``go_on``."""
        self._want(paused=True)

    def go_on(self) -> None:
        """After ``pause``."""
        self._want(paused=False)

    def stop(self) -> None:
        """End the rendering and save what there is."""
        self._want(stop=self._state in ("starting", "rendering", "paused"), paused=False)

    def quit(self) -> None:
        """End the program, with what there is saved."""
        self._want(quit=True, paused=False)

    def restart(self, changes: dict[str, Any]) -> None:
        """Begin again with other values of PARAMETERS. Raises InputError for wrong ones."""
        for name in changes:
            if name not in PARAMETERS:
                raise InputError(f"'{name}' cannot be changed; {', '.join(PARAMETERS)} can")
        try:
            settings = self._integrator.settings.with_(**changes)
        except (ValueError, TypeError) as error:
            raise InputError(one_line(error)) from error
        # The running rendering has taken its own from the integrator when it began.
        self._integrator.settings = settings
        self._want(restart=True, paused=False)

    def explain(self, x: int, y: int) -> str:
        """What ``explain`` says of a pixel. Raises InputError for one that is not there."""
        answer: Future = Future()
        self._questions.put(((x, y), answer))
        try:
            return answer.result(_ANSWER)
        except ValueError as error:
            raise InputError(one_line(error)) from error

    def status(self) -> dict[str, Any]:
        """All that a page shows besides the picture."""
        done, total = self._progress
        found = status_of(self._statistics)
        left = found["seconds"] * (total - done) / done if total and done else None
        settings = self._integrator.settings
        return found | {
            "name": self.name,
            "state": self._state,
            "message": self._message,
            "steered": True,
            "done": done,
            "total": total,
            "left": left if self._state == "rendering" and total and total < 1e6 else None,
            "history": self._history[-2000:],
            "size": self._film["crop_size"],
            "offset": self._film["crop_offset"],
            "version": self.snapshot.version if self.snapshot else 0,
            "layers": self.snapshot.names if self.snapshot else [],
            "parameters": {name: getattr(settings, name) for name in PARAMETERS},
        }
