"""Caustics on glossy surfaces: by photons, and by paths that meet the lamp.

An eye path leaves a glossy vertex x, where all of the BSDF is walked and reflects smoothly, and
comes over nothing but delta lobes (glass, mirrors) to an emitter. Emitter sampling cannot find that
light: the lamp is behind glass. BSDF sampling at x finds it the more rarely the smaller the lamp,
and never where it is a point. Light paths find it easily: they leave a photon at x, and the BSDF
there is summed over photons.

Both are combined as ``path`` combines BSDF and emitter sampling, by the power heuristic [Veach
1997, Sec. 9.2]. p is the density of the direction in BSDF sampling at x; in the place of emitter
sampling stands the density with which it would draw the point on the lamp, were there no glass,

    q = l²/A (lamps of area A, l the length of the path from x),  the emitter's own (environments),
    ∞ (points and single directions),

so that w = p²/(p² + q²) for paths that meet the lamp, 1 − w for photons. Eye path and light path
know the same p and q of the same path, hence each is counted once, whatever the weights. They only
say which way has less noise: how many photons there are is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own

# Stands for infinity, and can be squared.
_DELTA = 1e15


@dataclass  # not frozen: Dr.Jit traverses it
class EmitterDensity:
    """What q of a scene's emitters follows from.

    column      1/A of lamps, _DELTA of points and directions, else 0; by registry number, because
                a call for the area would ask all shapes there are, and not all of them know it.
    surrounded  the scene has an environment.
    """

    column: Any
    surrounded: bool

    @staticmethod
    def of(scene) -> EmitterDensity:
        """Evaluates the areas of lamps."""
        ids = dr.reinterpret_array(mi.UInt32, scene.emitters_dr()).numpy()
        column = np.zeros(ids.max() + 1, np.float32)
        column[ids] = [_of_surface(emitter) for emitter in scene.emitters()]
        return EmitterDensity(own(mi.Float, column), scene.environment() is not None)

    def at(self, emitter, direction, active) -> tuple[Any, Any]:
        """(density, is it per area?) of mi.EmitterPtr; direction: to the emitter."""
        number = dr.reinterpret_array(mi.UInt32, emitter)
        density = dr.gather(mi.Float, self.column, number, active)
        per_area = density < _DELTA
        if self.surrounded:
            far = active & emitter.is_environment()
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d = direction
            of_direction = emitter.pdf_direction(dr.zeros(mi.Interaction3f), ds, far)
            # A black environment map says 0/0.
            of_direction = dr.select(dr.isnan(of_direction), 0, of_direction)
            density = dr.select(far, dr.minimum(of_direction, _DELTA), density)
            per_area &= ~far
        return density, per_area


def _of_surface(emitter) -> float:
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta):
        return _DELTA
    shape = emitter.get_shape()
    return 1 / lamp_area(shape) if shape is not None else 0.0


def lamp_area(shape) -> float:
    """World units squared, above 0."""
    return max(float(mi.Float(shape.surface_area())[0]), 1 / _DELTA)


def seen_from(density, per_area, length):
    """q at the distance ``length`` along the path."""
    return density * dr.select(per_area, dr.square(length), 1)


def by_chance(p, q):
    """w: weight of paths that meet the lamp."""
    return dr.rcp(1 + dr.square(q / p))


def by_photons(p, q):
    """1 − w; 0 where q is 0: no such lamp, or a photon that came another way."""
    return dr.select(q > 0, dr.rcp(1 + dr.square(p / q)), 0)
