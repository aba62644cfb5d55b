"""How wide a pixel is where an eye path reads the photon map, and what that means for kernels.

With f the footprint of a pixel at a gather point (world units, its width there, measured along the
path), w the width of the kernel in pixels (``survey`` finds it pixel by pixel), and r_i the
bandwidth of pass i (0-based, see ``schedule``), the kernel's radius is

    r(p) = clip(w f r_i/r_0, min(l_i, 8 f/r_0) r_i, 4 r_i),      l_i = 1/max(16, i + 1).

Where photons hardly reach what the camera sees, l_i r_i may be wider than the picture; eight pixels
are the widest that pilots try.
Everything shrinks from pass to pass, so that the mean over passes converges as with one radius; r_i
and l_i are functions of i alone, however many passes there will be: passes that were rendered apart
add up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own
from .film import sample_ray

# Widest kernels, in pixels, that pilots have tried (see ``survey``).
TRIED = 8.0
# Kernels of the first passes may be narrower than the bandwidth by so much at least, kernels of all
# passes wider.
_LEAST, _MOST = 16, 4


@dataclass  # not frozen: Dr.Jit traverses it
class Footprint:
    """Bandwidth of a gather point as a share of that of its pass.

    start   width of a pixel at the camera, ``spread`` per world unit of path, both as a share of
            r_0.
    least   smallest share in this pass where that is less than TRIED pixels, above 0, at most 1.
    widths  of kernels in pixels: one number, or one for each pixel.
    pixel   of each eye path; None where there is one width.
    """

    start: Any
    spread: Any
    least: Any
    widths: Any
    pixel: Any = None

    def share(self, distance, lane, widest=math.inf):
        """Of a gather point of eye path ``lane``, ``distance`` world units of path from the
        camera. widest: that a kernel shall be, in pixels."""
        width = self.widths
        if self.pixel is not None:
            width = dr.gather(mi.Float, width, dr.gather(mi.UInt32, self.pixel, lane))
        width = dr.minimum(width, widest)
        pixel = dr.fma(self.spread, distance, self.start)
        return dr.clip(width * pixel, dr.minimum(self.least, TRIED * pixel), _MOST)

    def in_pass(self, index: int) -> Footprint:
        """The same in pass ``index`` (0-based)."""
        return replace(self, least=dr.opaque(mi.Float, least_share(index)))

    def seen_by(self, pixel) -> Footprint:
        """The same for eye paths of these pixels (UInt32)."""
        return replace(self, pixel=pixel) if dr.width(self.widths) > 1 else self


def of(sensor, radius: float, widths=1.0) -> Footprint | None:
    """Footprints of the pixels of a sensor, seen in its middle; kernels that are never narrower
    until ``in_pass`` says by how much. None where pixels have no width: all rays are one
    (``radiancemeter``), or the sensor chooses them without the film (``distant``).

    radius  bandwidth r_0 of the first pass, world units.
    widths  of kernels in pixels: a number or a flat array, one for each sampled pixel.
    """
    centre, aperture = mi.Point2f(0.5), mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    size = sensor.film().crop_size()  # what positions are relative to
    # Neighbours along both axes: the wider one counts. To one side: a ``batch`` of sensors may meet
    # in the middle. No farther than to the border, in films of one pixel.
    ray, _ = sample_ray(sensor, time, mi.Float(0.5), centre, aperture)
    start = spread = mi.Float(0)
    for axis in (0, 1):
        step = min(1 / size[axis], 0.5)
        to = mi.Point2f(0.5 + step, 0.5) if axis == 0 else mi.Point2f(0.5, 0.5 + step)
        beside, _ = sample_ray(sensor, time, mi.Float(0.5), to, aperture)
        pixel = 1 / size[axis] / step
        start = dr.maximum(start, pixel * dr.norm(beside.o - ray.o))
        spread = dr.maximum(spread, pixel * dr.norm(beside.d - ray.d))
    if float(start[0]) == 0 and float(spread[0]) == 0:
        return None
    unit = dr.rcp(dr.opaque(mi.Float, radius))
    width = own(mi.Float, np.array(widths, np.float32))
    found = Footprint(start * unit, spread * unit, mi.Float(1), width)
    dr.make_opaque(found.start, found.spread, found.least, found.widths)
    return found


def least_share(index: int) -> float:
    """Smallest share of the bandwidth of pass ``index`` (0-based) that a kernel may have."""
    return 1 / max(_LEAST, index + 1)
