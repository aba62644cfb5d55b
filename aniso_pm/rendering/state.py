"""The state of an unfinished rendering on disk: passes done, their sums, what they depend on.

Format: a NumPy archive (.npz) of the arrays first, square, cross (see ``accumulate``), layers where
there are any (see ``layered``), those of what a pilot has chosen (see ``settled``) with "chosen, "
before their names, and "header", JSON text with the format's version, the identity (see
``digest``), the passes as half-open ranges, statistics, the seconds spent, the rest of what was
chosen, and a SHA-256 of all that. Files appear whole or not at all and are never trusted: what is
truncated, altered or of another version is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..pictures import output
from ..transport.layers import parse
from .accumulate import mean_and_variance, relative_standard_error
from .digest import differences
from .layered import develop
from .settled import Settled

VERSION = 3
_N = TypeVar("_N", int, float)
_OPTIONAL = ("layers", "denoising")
_CHOSEN = "chosen, "
# What a pass counts.
COUNTS = (
    "photons_emitted",
    "photons_stored",
    "photons_rejected",
    "photons_gathered",
    "eye_samples",
    "eye_samples_rejected",
    "gather_points",
    "gather_points_anisotropic",
    "gather_points_clamped",
    "gather_points_capped",
    "gather_points_degenerate",
    "gather_points_off_surface",
    "spp",
)


# Fields of a State that its header holds as they are.
_IN_HEADER = ("identity", "film", "passes", "seconds", "statistics")


class StateError(ValueError):
    """A state cannot be used: it is damaged, or belongs to another rendering."""


@dataclass
class State:
    """Passes that were rendered.

    identity    what every pass depends on but its number (``digest.identity``).
    film        what ``film.from_description`` makes a film from.
    passes      half-open ranges of pass numbers, ascending, disjoint and not touching.
    seconds     rendering time spent on them.
    statistics  of the renderer, over these passes.
    arrays      ``Sums.arrays()``, and the sums of layers that were asked for (``layered``).
    settled     what a pilot has chosen, or parameters have given.
    """

    identity: dict[str, Any]
    film: dict[str, Any]
    passes: list[list[int]]
    seconds: float
    statistics: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(repr=False)
    settled: Settled = field(repr=False)

    @property
    def count(self) -> int:
        """Number of passes."""
        return sum(end - start for start, end in self.passes)

    def variance(self) -> np.ndarray | None:
        """Variance of the picture, height × width × channels; None with one pass."""
        return mean_and_variance(self.arrays, self.count)[1] if self.count > 1 else None

    def relative_error(self) -> float | None:
        """Of the picture, as statistics have it; None with one pass."""
        if self.count < 2:
            return None
        return relative_standard_error(*mean_and_variance(self.arrays, self.count))

    def layer_sums(self) -> dict[str, np.ndarray]:
        """The sums of layers; see ``layered``."""
        return {name: self.arrays[name] for name in _OPTIONAL if name in self.arrays}

    def layers(self) -> dict[str, np.ndarray]:
        """The layers that were asked for; see ``layered.develop``."""
        sums = self.layer_sums()
        if not sums:
            return {}
        names = parse(self.identity['parameter "layers"'])
        return develop(names, sums, self.count, self.film["filter"])

    def save(self, path: Path) -> None:
        """Write atomically, down to the disk. Raises ``output.OutputError``."""
        chosen, per_pixel = self.settled.packed()
        arrays = self.arrays | {_CHOSEN + name: array for name, array in per_pixel.items()}
        header = {name: getattr(self, name) for name in _IN_HEADER} | {"chosen": chosen}
        header = output.plain(header) | {"format": "aniso_pm state", "version": VERSION}
        header["sha256"] = _checksum(header, arrays)
        entries: dict[str, Any] = {"header": np.array(json.dumps(header, ensure_ascii=False))}
        entries |= arrays
        with output.replacing(path) as partial, open(partial, "wb") as file:
            np.savez(file, **entries)

    @staticmethod
    def load(path: Path) -> State:
        """Read and verify. Raises StateError in one sentence, FileNotFoundError if it is absent."""
        data = Path(path).read_bytes()
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                header = json.loads(str(archive["header"]))
                arrays = {name: archive[name] for name in archive if name != "header"}
            version, checksum = header["version"], header.pop("sha256")
        except Exception as error:
            whole = zipfile.is_zipfile(io.BytesIO(data))
            reason = "damaged, or of something else" if whole else "cut short, or of another kind"
            raise StateError(f"{path}: not a whole state file ({reason})") from error
        if version != VERSION:
            raise StateError(f"{path}: state format {version}; this version reads {VERSION}")
        if checksum != _checksum(header, arrays):
            raise StateError(f"{path}: checksum mismatch, damaged")
        names = [name for name in arrays if name.startswith(_CHOSEN)]
        chosen = {name.removeprefix(_CHOSEN): arrays.pop(name) for name in names}
        settled = Settled.unpacked(header["chosen"], chosen)
        values = {name: header[name] for name in _IN_HEADER}
        return State(**values, arrays=arrays, settled=settled)

    def check_same(self, identity: dict[str, Any], name: Any) -> None:
        """Raise StateError naming what differs unless this state's passes are passes of
        ``identity``."""
        found = differences(self.identity, identity)
        if found:
            more = f" and {len(found) - 4} more" if len(found) > 4 else ""
            raise StateError(f"{name}: belongs to another rendering: {'; '.join(found[:4])}{more}")


def merge(states: dict[str, State]) -> State:
    """One state of all passes; ``states`` by the names to call them in messages.

    Raises StateError if they belong to different renderings or share a pass.
    """
    (first_name, first), *others = states.items()
    passes = list(first.passes)
    arrays = dict(first.arrays)
    statistics, seconds = first.statistics, first.seconds
    for name, state in others:
        state.check_same(first.identity, f"{name} and {first_name}")
        common = next((n for n in numbers(state.passes) if _holds(passes, n)), None)
        if common is not None:
            raise StateError(f"{name}: pass {common} is already in the states before it")
        later = state.passes[-1][1] > max(end for _, end in passes)
        both = statistics, state.statistics
        statistics = _merged(*(both if later else reversed(both)))
        passes += state.passes
        arrays = {k: v + state.arrays[k] for k, v in arrays.items()}
        seconds += state.seconds
    ranges = joined(passes)
    total = State(first.identity, first.film, ranges, seconds, statistics, arrays, first.settled)
    return replace(total, statistics=statistics | {"relative_error": total.relative_error()})


def numbers(passes):
    """All pass numbers of half-open ranges."""
    return (n for start, end in passes for n in range(start, end))


def extended(passes: list[list[int]], number: int) -> list[list[int]]:
    """The ranges with one more pass."""
    return joined([*passes, [number, number + 1]])


def missing(passes, first: int, count: int) -> list[list[int]]:
    """Ranges of those passes from ``first`` to ``first + count - 1`` that are not in ``passes``."""
    found, at = [], first
    for start, end in [*joined(passes), [first + count, first + count]]:
        if start > at:
            found.append([at, min(start, first + count)])
        at = max(at, end)
    return [[a, b] for a, b in found if a < b]


def describe(passes) -> str:
    """ "0-7, 16-23": ranges of pass numbers for people."""
    return ", ".join(f"{a}-{b - 1}" if b - a > 1 else f"{a}" for a, b in passes) or "none"


def _merged(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Statistics over the passes of both: counts and seconds add up, they were interrupted if
    either was, everything else is that of ``b``, which has the last pass."""
    counts = {name: a.get(name, 0) + b.get(name, 0) for name in (*COUNTS, "passes")}
    seconds = added(a.get("seconds", {}), b.get("seconds", {}))
    interrupted = a.get("interrupted", False) or b.get("interrupted", False)
    return a | b | counts | {"seconds": seconds, "interrupted": interrupted}


def added(a: dict[str, _N], b: dict[str, _N]) -> dict[str, _N]:
    """Sums by name."""
    return {name: a.get(name, 0) + b.get(name, 0) for name in a | b}


def _holds(passes, number: int) -> bool:
    return any(start <= number < end for start, end in passes)


def joined(passes) -> list[list[int]]:
    """Disjoint ranges in order, those that touch as one."""
    result: list[list[int]] = []
    for start, end in sorted(map(list, passes)):
        if result and result[-1][1] == start:
            result[-1][1] = end
        else:
            result.append([start, end])
    return result


def _checksum(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    sha = hashlib.sha256(json.dumps(header, sort_keys=True, ensure_ascii=False).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype} {array.shape}".encode())
        sha.update(array.data)
    return sha.hexdigest()


@dataclass
class Checkpoint:
    """Where and how often a rendering keeps its state.

    path     the state file.
    every    seconds between two writes (and never more than a twentieth of the time is spent on
             writing); the state is also written at the end and after an interruption.
    resume   start from the file if it is there.
    on_write  called after each write but the last, e.g. to write the picture so far: the film
              holds it.
    """

    path: Path
    every: float = 30.0
    resume: bool = False
    on_write: Callable[[], Any] | None = None

    def __post_init__(self):
        self.path = Path(self.path)
        self._written = time.perf_counter()
        self._cost = 0.0

    def start(self) -> State | None:
        """The state to go on from, if that is wanted and there is one."""
        self._written = time.perf_counter()
        if not self.resume:
            return None
        try:
            return State.load(self.path)
        except FileNotFoundError:
            return None
        except StateError as error:
            raise StateError(f"{error}; delete it to start afresh") from error
        except OSError as error:
            raise StateError(f"cannot read '{self.path}': {error.strerror or error}") from error

    def put_off(self) -> None:
        """The next write is to come as late as if this one had succeeded."""
        self._written = time.perf_counter()

    def due(self) -> bool:
        return time.perf_counter() - self._written > max(self.every, 20 * self._cost)

    def write(self, state: State) -> None:
        began = time.perf_counter()
        state.save(self.path)
        self._written = time.perf_counter()
        self._cost = self._written - began
