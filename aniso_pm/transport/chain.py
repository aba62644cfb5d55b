"""What an eye path keeps of the glossy vertex behind it (see ``map.glossy_caustics``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map.glossy_caustics import EmitterDensity, by_chance, seen_from


@dataclass
class Chain:
    """What an eye path keeps of its last vertex that was not a delta lobe.

    glossy  glossy caustics are seen there, through the BSDF's walked part.
    bent    there have been delta lobes since.
    pdf     density of the direction in which the path left it.
    length  of the path since, world units.
    """

    glossy: Any
    bent: Any
    pdf: Any
    length: Any

    @staticmethod
    def begin() -> Chain:
        return Chain(mi.Bool(False), mi.Bool(False), mi.Float(1), mi.Float(0))

    def weight(self, drawn: EmitterDensity, ds, active):
        """w of emission that has been met (mi.DirectionSample3f)."""
        active = active & self.glossy & self.bent
        density, per_area = drawn.at(ds.emitter, ds.d, active)
        q = seen_from(density, per_area, self.length)
        return dr.select(active, by_chance(self.pdf, q), 1)

    def leave(self, glossy, pdf, delta, active):
        """The path goes on. glossy: it does so through a walked part on which glossy caustics are
        seen; delta: through a delta lobe."""
        self.bent = dr.select(delta, self.glossy, False)
        starts = active & ~delta
        self.glossy = dr.select(starts, glossy, self.glossy)
        self.pdf = dr.select(starts, pdf, self.pdf)
        self.length = dr.select(starts, 0, self.length)
