"""Emitters that light paths cannot start at, or not in agreement with what eye paths see.

Where Mitsuba's own emitter sampling (what ``path`` shows) and its ``sample_ray`` disagree, or the
former disagrees with what rays meet, and nothing here can decide or mend it, the scene is refused
in one sentence that says what to do instead.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .amends import is_turned
from .ndf import children

_ROUNDING = 1e-3


def refuse(scene):
    """Raise ValueError for the first emitter of a scene that cannot start light paths."""
    for emitter in scene.emitters():
        kind = emitter.class_name()
        if kind == "TimedSunskyEmitter":
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a timed_sunsky, from which Mitsuba cannot '
                'trace light (its sample_ray raises); use "sunsky" for one point in time'
            )
        if mi.is_spectral and kind == "Projector":
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a projector, whose light cannot be '
                "evaluated at given wavelengths; use an RGB variant"
            )
        lengths = _scales(emitter)
        if kind in ("Projector", "DirectionalEmitter") and np.abs(lengths - 1).max() > _ROUNDING:
            refuse_scale(emitter)
        if kind == "SpotLight" and np.ptp(lengths) > _ROUNDING * lengths.max():
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a spot with a "to_world" that scales '
                "unevenly, under which Mitsuba's light paths and its emitter sampling disagree; "
                "leave only rotations, mirrorings and one scale for all axes"
            )
        shape = emitter.get_shape()
        varies = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
        if varies and shape is not None and shape.class_name() == "Sphere" and is_turned(shape):
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" has a texture on a sphere with a "to_world" '
                "that turns or mirrors it, where Mitsuba's own sampling looks at other points of "
                "the texture than its rays do; leave only scale and translation, or use a mesh"
            )


def refuse_scale(emitter):
    """Raise the ValueError about a ``to_world`` that scales."""
    raise ValueError(
        f'aniso_pm: emitter "{emitter.id()}" has a "to_world" that scales, under which Mitsuba\'s '
        "own sampling is wrong (directions that are not of unit length, or another brightness); "
        "leave only rotations (about axes of length 1) and mirrorings (scale by -1)"
    )


def _scales(emitter) -> np.ndarray:
    """Factors by which an emitter's ``to_world`` scales; 1 without one."""
    to_world = children(emitter).get("to_world")
    if to_world is None:
        return np.ones(3)
    matrix = np.array(to_world.matrix, dtype=np.float64).reshape(4, 4, -1)[:3, :3, 0]
    return np.linalg.svd(matrix, compute_uv=False)
