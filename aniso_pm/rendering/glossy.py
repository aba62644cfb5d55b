"""Are photons wanted for caustics on glossy surfaces (see ``map.glossy_caustics``)?

Not where paths that bounce off a glossy surface meet the lamps often enough by themselves: with p
the peak density of the reflected direction and q that of drawing the lamp, they do if p/q is no
less than OFTEN. Of anisotropic microfacets p = 1/(4π α_u α_v), from their D(z) = 1/(π α_u α_v).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import one_line
from ..map.glossy_caustics import lamp_area
from ..map.receivers import may_shine
from ..ndf import roughness_source
from .needs import Needs, emitter_name, surfaces

# p/q from which chance is good enough: photons are worth their time below.
OFTEN = 0.25
# p where roughness cannot be read.
_UNKNOWN = 10.0
# Directions that an environment is asked for.
_DIRECTIONS = 256


def rarely_met(scene, needs: Needs, gather_roughness: float) -> list[str]:
    """The emitters that are rarely met by paths over glossy surfaces; [] where there is none, or no
    glass or mirror that casts caustics."""
    if not needs.casting or not needs.glossy or needs.unseen:
        return []
    shapes = []
    for _, shape in surfaces(scene):
        bsdf = shape.bsdf()
        if bsdf is not None and may_shine(bsdf, gather_roughness):
            shapes.append((_middle(shape), _peak(bsdf)))
    return [emitter_name(e) for e in scene.emitters() if _is_rare(e, shapes)]


def _is_rare(emitter, shapes) -> bool:
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta):
        return True
    if emitter.is_environment():
        density = _of_environment(emitter)
        return any(p < OFTEN * density for _, p in shapes)
    shape = emitter.get_shape()
    if shape is None:
        return False
    area, middle = lamp_area(shape), _middle(shape)
    away = ((p, np.sum((place - middle) ** 2)) for place, p in shapes)
    return any(p * area < OFTEN * squared for p, squared in away)


def _of_environment(emitter) -> float:
    """Density (1/sr) with which most of the light is drawn: the median over the directions."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _DIRECTIONS)
    it = dr.zeros(mi.SurfaceInteraction3f, _DIRECTIONS)
    try:
        ds, _ = emitter.sample_direction(it, sampler.next_2d())
    except RuntimeError as error:
        mi.Log(mi.LogLevel.Debug, f"aniso_pm: no direction of an environment: {one_line(error)}")
        return 0.0
    return float(np.median(ds.pdf.numpy()))


def _middle(shape) -> np.ndarray:
    return np.array(shape.bbox().center(), np.float64).ravel()


def _peak(bsdf) -> float:
    """p of a BSDF: of the glossiest part that can be read."""
    source = roughness_source(bsdf)
    if source is None:
        return _UNKNOWN
    u, v = (float(mi.Float(a)[0]) for a in source(dr.zeros(mi.SurfaceInteraction3f), True))
    return 1 / (4 * math.pi * u * v)
