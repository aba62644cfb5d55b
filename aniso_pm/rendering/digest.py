"""What a picture depends on besides the seed, as a dictionary that can be compared entry by entry.

Two renderings belong together (one resumes the other, or both are merged) if these dictionaries
agree; where they do not, the entry that differs has a name that can be said to the user. Large
content is represented by a hash, marked by a leading "#".
"""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import asdict
from typing import Any

import mitsuba as mi
import numpy as np

from .._version import __version__
from .needs import instanced

# Relative difference of radii that counts as none: another machine's pilot may round differently.
_SAME_RADIUS = 0.01
# Normals that Mitsuba computes itself are sums in the order of threads: never twice the same.
_UNSTABLE = "vertex_normals"
# Entries for what a pilot may choose, filled in by ``beginning``.
USE, LOBES = "use of the map", "lobes followed"
RADIUS, COUNT = "initial radius", "photon count"
SAMPLES = "samples per pixel of a pass"


def scene_entries(scene) -> dict[str, str]:
    """Hashes of everything in a scene that rays meet: shapes with their materials, lights.

    Covers values, textures and vertices as ``mi.traverse`` shows them, and the description of
    objects that ``str`` prints, so it does for files and dictionaries alike. Not covered: vertex
    normals (see above).
    """
    found: dict[str, list[str]] = {}
    inside = [shape for _, shape in instanced(scene)]
    outside = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    for thing in [*scene.shapes(), *inside, *outside]:
        name = thing.id()
        if not name or re.fullmatch(r"object_\d+|_unnamed_\d+|_arg_\d+", name):
            name = thing.class_name()
        found.setdefault(f"scene, {name}", []).append(_hash(thing))
    # Their order may depend on addresses in memory.
    return {name: "#" + "".join(sorted(hashes)) for name, hashes in found.items()}


# What is left of its description, as a camera prints it.
_DEFAULT_SAMPLER = "IndependentSampler[\n    base_seed = 0\n    \n    \n    \n  ]"


def camera_entries(sensor, with_sampler: bool = True) -> dict[str, Any]:
    """Camera, film and, if it matters, sampler, without the number of samples. Without it the
    camera counts as one with Mitsuba's default sampler."""
    film = sensor.film()
    return {
        "film size": "x".join(str(n) for n in film.size()),
        "film": "#" + _digest(str(film)),
        "camera": "#" + _hash(sensor, with_sampler),
    }


def identity(prepared, sensor, seed: int, samples_per_pass: str) -> dict[str, Any]:
    """Everything that a pass depends on but its number. What a pilot may choose (USE and the other
    entries above) is filled in by ``beginning``. ``max_memory`` is left out: smaller wavefronts
    draw other random numbers, but passes remain independent of each other, so that machines of any
    size may add to one picture."""
    elsewhere = ("passes", "time", "target_error", "initial_radius", "photon_count", "max_memory")
    parameters = {
        f'parameter "{name}"': value
        for name, value in (
            asdict(prepared.settings) | {"hide_emitters": prepared.hide_emitters}
        ).items()
        if name not in elsewhere
    }
    return {
        "version of aniso_pm": __version__,
        "variant": mi.variant(),
        "seed": seed,
        "samples per pass": samples_per_pass,
        **parameters,
        **camera_entries(sensor),
        **scene_entries(prepared.scene),
    }


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """One short text for each entry that differs, in the order of the entries."""
    result = []
    for name in there | here:
        a, b = there.get(name), here.get(name)
        if a == b:
            continue
        if name == RADIUS and a and b and math.isclose(a, b, rel_tol=_SAME_RADIUS):
            continue
        if a is None or b is None:
            result.append(f"{name} is only in {'the other' if b is None else 'this'} one")
        elif str(a).startswith("#"):
            result.append(f"{name} has changed")
        else:
            result.append(f"{name} was {a}, is {b}")
    return result


def _hash(thing, with_sampler: bool = True) -> str:
    text = re.sub(r"(sample_count|samples_per_wavefront|wavefront_size) = \d+", "", str(thing))
    if not with_sampler:
        text = re.sub(r"sampler = \w+ ?\[[^]]*\]", f"sampler = {_DEFAULT_SAMPLER}", text)
    pieces: list[str | bytes] = [text]
    parameters = mi.traverse(thing)
    for index, key in enumerate(parameters.keys()):
        value = parameters[key]
        if key.endswith(_UNSTABLE):
            continue
        # Names of anonymous objects are addresses; the order of keys is fixed.
        pieces.append(f"{index} {key.rpartition('.')[2]}")
        pieces.append(_content(value))
    return _digest(*pieces)


def _content(value) -> bytes:
    try:
        array = np.ascontiguousarray(value)
    except Exception:
        return str(value).encode()
    return array.tobytes() if array.dtype != object else str(value).encode()


def _digest(*pieces: str | bytes) -> str:
    sha = hashlib.sha256()
    for piece in pieces:
        data = piece.encode() if isinstance(piece, str) else piece
        sha.update(len(data).to_bytes(8, "little") + data)
    return sha.hexdigest()[:16]
