"""A rendering that runs elsewhere, as its state file tells it."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import InputError
from ..rendering import film as films
from ..rendering.state import State, StateError
from .snapshot import Snapshot, status_of

# Seconds between looks at the file.
_EVERY = 1.0


class Watched:
    """The newest content of a state file. Raises StateError or OSError where there is none."""

    steered = False

    def __init__(self, path: Path):
        self.name, self._path = path.name, path
        self._history: list[tuple[float, float]] = []
        self._seen: tuple[int, int] | None = None
        self._message, self._ended = "", threading.Event()
        self.snapshot: Snapshot | None = None
        mi.set_variant(State.load(path).identity["variant"])
        self._look()

    def run(self) -> None:
        """Look at the file again and again until somebody quits."""
        while not self._ended.wait(_EVERY):
            try:
                self._look()
            except (StateError, OSError) as error:
                # A finished picture loses its state; what was seen of it stays.
                self._message = str(error)

    def _look(self) -> None:
        stat = self._path.stat()
        if self._seen == (stat.st_mtime_ns, stat.st_size):
            return
        state = State.load(self._path)
        film = films.from_description(state.film)
        films.show_array(film, state.arrays["first"])
        image = np.array(film.develop())[..., :3]
        image = image if image.shape[2] == 3 else np.repeat(image[..., :1], 3, 2)
        layers = state.layers()
        variance = state.variance()
        if variance is not None:
            layers["standard_error"] = np.sqrt(variance[..., :3]).astype(np.float32)
        self._statistics, self._film = state.statistics, state.film
        self._parameters = {
            name.removeprefix('parameter "').removesuffix('"'): value
            for name, value in state.identity.items()
            if name.startswith("parameter ")
        }
        found = status_of(state.statistics)
        if found["relative_error"]:
            self._history.append((found["seconds"], found["relative_error"]))
        version = (self.snapshot.version if self.snapshot else 0) + 1
        self.snapshot = Snapshot(version, image, layers)
        self._seen, self._message = (stat.st_mtime_ns, stat.st_size), ""

    def quit(self) -> None:
        """End the program; the rendering goes on."""
        self._ended.set()

    def explain(self, x: int, y: int) -> str:
        """Refused: there is no scene."""
        raise InputError("a state file has no scene; aniso-pm view SCENE.xml explains pixels")

    def status(self) -> dict[str, Any]:
        """As :meth:`session.Session.status`."""
        return status_of(self._statistics) | {
            "name": self.name,
            "state": "watched",
            "message": self._message,
            "steered": False,
            "done": None,
            "total": None,
            "left": None,
            "history": self._history,
            "size": self._film["crop_size"],
            "offset": self._film["crop_offset"],
            "version": self.snapshot.version if self.snapshot else 0,
            "layers": self.snapshot.names if self.snapshot else [],
            "parameters": self._parameters,
        }
