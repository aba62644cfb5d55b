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

from typing import Any

import drjit as dr
import mitsuba as mi

# Stands for infinity, and can be squared.
_DELTA = 1e15


def emitter_density(emitter, direction, active) -> tuple[Any, Any]:
    """(1/A or the density of a direction or _DELTA, is that per area?) of mi.EmitterPtr; direction:
    to the emitter."""
    flags = emitter.flags()
    far = mi.has_flag(flags, mi.EmitterFlags.Infinite)
    delta = mi.has_flag(flags, mi.EmitterFlags.Delta)
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d = direction
    of_direction = emitter.pdf_direction(dr.zeros(mi.Interaction3f), ds, active & far & ~delta)
    area = emitter.get_shape().surface_area()
    per_area = ~far & ~delta
    density = dr.select(far, of_direction, dr.rcp(area))
    return dr.select(delta, _DELTA, dr.minimum(density, _DELTA)), per_area


def seen_from(density, per_area, length):
    """q at the distance ``length`` along the path."""
    return density * dr.select(per_area, dr.square(length), 1)


def by_chance(p, q):
    """w: weight of paths that meet the lamp."""
    return dr.rcp(1 + dr.square(q / p))


def by_photons(p, q):
    """1 − w; 0 where q is 0, which marks photons that came another way."""
    return dr.select(q > 0, dr.rcp(1 + dr.square(p / q)), 0)
