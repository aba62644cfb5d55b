"""Where emitters are. A path that takes nothing along but the light of what it meets next goes on
only if that may emit: where all light comes from lamps, next to no ray behind a gather point does.

Lamps are boxes around the shapes that emit, neighbours together where there are many.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own

# Boxes at most, each of which every such ray is tested against.
_MOST = 8
# By how much boxes are larger than shapes, as a share of the largest coordinate: rounding.
_LARGER = 1e-5


@dataclass  # not frozen: Dr.Jit writes back whatever a loop mentions
class Lamps:
    """Corners of boxes (mi.Point3f, one entry each) that hold all surfaces that emit."""

    boxes: tuple[tuple[Any, Any], ...]

    @staticmethod
    def of(scene) -> Lamps | None:
        """Of a scene; None where light may come from anywhere: there is an environment, or a shape
        that does not know its bounds."""
        found = [shape.bbox() for shape in scene.shapes() if shape.emitter() is not None]
        if scene.environment() is not None or not all(box.valid() for box in found):
            return None
        corners = np.array([[box.min, box.max] for box in found], np.float64).reshape(-1, 2, 3)
        groups = [corners] if len(corners) else []
        while 0 < len(groups) < min(_MOST, len(corners)):
            largest = max((g for g in groups if len(g) > 1), key=_spread)
            groups = [g for g in groups if g is not largest] + _halves(largest)
        boxes = []
        for group in groups:
            low, high = group[:, 0].min(0), group[:, 1].max(0)
            more = _LARGER * np.abs([low, high]).max()
            boxes.append(tuple(_point(corner) for corner in (low - more, high + more)))
        return Lamps(tuple(boxes))

    def may_meet(self, ray):
        """May the ray (without end) meet a surface that emits?"""
        o, inverse = mi.Point3f(ray.o), dr.rcp(mi.Vector3f(ray.d))
        met = mi.Bool(False)
        for low, high in self.boxes:
            a, b = (low - o) * inverse, (high - o) * inverse
            near, far = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
            met |= ~(far < dr.maximum(near, 0))  # not a number: along a side of the box
        return met


def _spread(group) -> float:
    return float(np.ptp(group.mean(1), axis=0).max())


def _halves(group) -> list[np.ndarray]:
    """Lamps on either side along the axis on which they lie farthest apart."""
    middles = group.mean(1)
    order = np.argsort(middles[:, np.ptp(middles, axis=0).argmax()], kind="stable")
    return [group[half] for half in np.array_split(order, 2)]


def _point(corner):
    return mi.Point3f(*(own(mi.Float, np.array([x], np.float32)) for x in corner))
