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

# Boxes at most, each of which every such ray is tested against.
_MOST = 8
# By how much boxes are larger than shapes, as a share of the scene's largest coordinate: rounding.
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
        whole = scene.bbox()
        more = _LARGER * np.abs([whole.min, whole.max]).max() if found else 0
        boxes = []
        for group in neighbours(corners.mean(1), _MOST):
            low, high = corners[group, 0].min(0) - more, corners[group, 1].max(0) + more
            boxes.append((mi.Point3f(*low.tolist()), mi.Point3f(*high.tolist())))
        dr.make_opaque(boxes)
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


def neighbours(points: np.ndarray, most: int) -> list[list[int]]:
    """Numbers of the points (n, 3) in ``most`` groups, or n if these are fewer: the group that
    reaches farthest along an axis is cut into halves, again and again."""
    groups = [list(range(len(points)))] if len(points) else []
    while 0 < len(groups) < min(most, len(points)):
        reach = [np.ptp(points[group], axis=0) for group in groups]
        # Points at one place are told apart as well.
        sizes = [r.max() if len(g) > 1 else -1 for r, g in zip(reach, groups, strict=True)]
        at = int(np.argmax(sizes))
        group, axis = groups.pop(at), int(np.argmax(reach[at]))
        group.sort(key=lambda k: (points[k, axis], k))
        groups += [group[: len(group) // 2], group[len(group) // 2 :]]
    return groups
