"""How wide a pixel is where an eye path reads the photon map, and what that means for kernels.

Light that changes within a pixel's footprint is averaged anyway, so a kernel narrower than that
only sees fewer photons; one much wider blurs. With f the footprint at a gather point (world units,
the width of a pixel there, measured along the path), and r the bandwidth of the pass, the kernel's
radius is

    r(p) = clip(1.75 f r_i/r_0, l_i r_i, r_i),      l_i = max(1/(i + 1), 1/5),

r_i the bandwidth of pass i (0-based). The first pass has r_0 everywhere, and all passes together
have at least its photons in every kernel. The schedule of the passes shrinks all of it alike, so
that the mean over passes converges as before; r_i is a function of i alone.

On the gallery the best single radius is 1.3 to 2.6 footprints, whatever the density of photons.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

# Kernel radius in widths of a pixel.
WIDTHS = 1.75
# Least share of a pass's bandwidth, however late the pass.
LEAST = 0.2


@dataclass  # not frozen: Dr.Jit traverses it
class Footprint:
    """Bandwidth of a gather point as a share of that of its pass.

    start   at the camera; ``spread`` per world unit of path.
    least   smallest share in this pass, above 0 and at most 1.
    """

    start: Any
    spread: Any
    least: Any

    def share(self, distance):
        """Of a gather point that is ``distance`` world units of path from the camera."""
        return dr.clip(dr.fma(self.spread, distance, self.start), self.least, 1)


def of(sensor, radius: float) -> Footprint:
    """Footprints of the pixels of a sensor, seen in its middle, for the first pass.

    radius  bandwidth of the first pass, world units.
    """
    centre, aperture = mi.Point2f(0.5), mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    ray, _ = sensor.sample_ray(time, mi.Float(0.5), centre, aperture)
    size = sensor.film().size()
    # Neighbours along both axes: the wider one counts.
    start = spread = mi.Float(0)
    for step in (mi.Vector2f(1 / size[0], 0), mi.Vector2f(0, 1 / size[1])):
        beside, _ = sensor.sample_ray(time, mi.Float(0.5), centre + step, aperture)
        start = dr.maximum(start, dr.norm(beside.o - ray.o))
        spread = dr.maximum(spread, dr.norm(beside.d - ray.d))
    scale = WIDTHS / radius
    found = Footprint(start * scale, spread * scale, mi.Float(1))
    dr.make_opaque(found.start, found.spread, found.least)
    return found


def in_pass(footprint: Footprint | None, index: int) -> Footprint | None:
    """The same in pass ``index`` (0-based); None stays None."""
    if footprint is None:
        return None
    return replace(footprint, least=dr.opaque(mi.Float, least_share(index)))


def least_share(index: int) -> float:
    """Smallest share of the bandwidth of pass ``index`` (0-based) that a kernel may have."""
    return max(1 / (index + 1), LEAST)
