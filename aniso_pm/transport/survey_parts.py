"""What the survey's eye paths tell apart.

They walk with use "caustic" (see ``uses``). What is found beyond a gathered part would be the map's
with use "global"; what is found over walked parts beyond a gathered part is in both maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map.spectra import channel_mean


@dataclass
class Parts:
    """What the survey's eye paths see.

    radiance  as with use "caustic": W/m²/sr.
    later     the part of it that was found beyond a gathered part, which the global map has:
              radiance in the mean over channels.
    caustic   what was found over walked parts beyond a gathered part, which both maps have.
    glossy    what they have of glossy caustics.
    """

    radiance: Any
    later: Any
    caustic: Any
    glossy: Any


@dataclass
class Apart:
    """What one path keeps, one lane a path.

    later, caustic, glossy  see ``Parts``.
    throughput  of emission at the next vertex over walked parts beyond a gathered one.
    before      had the path left a gathered part before its last vertex?
    """

    later: Any
    caustic: Any
    throughput: Any
    before: Any
    glossy: Any

    @staticmethod
    def begin() -> Apart:
        return Apart(mi.Float(0), mi.Float(0), mi.Spectrum(0), mi.Bool(False), mi.Float(0))

    def emission(self, emission, β, active):
        """Emission found at a vertex, weighted. β: throughput with which the picture gets it."""
        self.later[active & self.before] += channel_mean(β * emission)
        self.caustic[active & self.before] += channel_mean(self.throughput * emission)

    def leave_to_maps(self, radiance, active):
        """Light that maps have on glossy surfaces (see ``glossy_caustics``)."""
        self.glossy[active] += channel_mean(radiance)

    def direct_light(self, light, f, whole, active):
        """Light by emitter sampling where the path has left a gathered part. f, whole: value of the
        BSDF's gathered part, and of all of it."""
        self.later[active] += channel_mean(f * light)
        self.caustic[active] += channel_mean((whole - f) * light)

    def scatter(self, β_walked, scattered):
        """The path goes on. β_walked: its throughput over the walked part; scattered: had it left a
        gathered part before?"""
        self.before = mi.Bool(scattered)  # not the same array, which changes in place
        self.throughput = dr.select(scattered, β_walked, 0)

    def parts(self, radiance) -> Parts:
        return Parts(radiance, self.later, self.caustic, self.glossy)
