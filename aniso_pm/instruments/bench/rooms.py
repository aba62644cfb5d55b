"""Scenes of the benchmark: a closed room, empty or with glass and brushed metal, as dictionaries.

The room is 2 × 2 × 2 around the origin, y up, with a square light under its ceiling.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def _wall(to_world, color, bsdf=None) -> dict[str, Any]:
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or diffuse}


def brushed(alpha_u: float = 0.03, alpha_v: float = 0.3) -> dict[str, Any]:
    """Brushed aluminium, seen from both sides."""
    metal = {"type": "roughconductor", "material": "Al", "alpha_u": alpha_u, "alpha_v": alpha_v}
    return {"type": "twosided", "bsdf": metal}


def room(size: int, **parts) -> dict[str, Any]:
    """All surfaces diffuse, seen by a camera of size × size pixels; parts replace or add shapes."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 75,
            "to_world": T().look_at(origin=[0, 0, 0.97], target=[0, -0.15, 0], up=[0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        },
        "floor": _wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90), [0.6, 0.6, 0.55]),
        "ceiling": _wall(T().translate([0, 1, 0]).rotate([1, 0, 0], 90), [0.7, 0.7, 0.7]),
        "back": _wall(T().translate([0, 0, -1]), [0.6, 0.65, 0.7]),
        "front": _wall(T().translate([0, 0, 1]).rotate([0, 1, 0], 180), [0.5, 0.5, 0.5]),
        "left": _wall(T().translate([-1, 0, 0]).rotate([0, 1, 0], 90), [0.6, 0.2, 0.15]),
        "right": _wall(T().translate([1, 0, 0]).rotate([0, 1, 0], -90), [0.2, 0.5, 0.2]),
        "light": {
            "type": "rectangle",
            "to_world": T().translate([0, 0.98, -0.1]).rotate([1, 0, 0], 90).scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8, 7.5, 7]}},
        },
    } | parts


def glass_and_metal(size: int) -> dict[str, Any]:
    """A glass ball, and a brushed plate that leans against the back wall."""
    T = mi.ScalarTransform4f
    ball = {
        "type": "sphere",
        "center": [0.4, -0.65, -0.1],
        "radius": 0.3,
        "bsdf": {"type": "dielectric", "int_ior": 1.5},
    }
    plate = T().translate([-0.1, -0.3, -0.6]).rotate([1, 0, 0], -20).scale(0.55)
    return room(size, ball=ball, plate=_wall(plate, [], brushed()))


def brushed_back(size: int) -> dict[str, Any]:
    """The whole back wall is brushed metal."""
    return room(size, back=_wall(mi.ScalarTransform4f().translate([0, 0, -1]), [], brushed()))


def brushed_floor(size: int) -> dict[str, Any]:
    """The whole floor is brushed metal."""
    floor = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90)
    return room(size, floor=_wall(floor, [], brushed(0.05, 0.3)))


def brushed_ball(size: int) -> dict[str, Any]:
    """A large ball of brushed metal: lobes of all orientations side by side."""
    ball = {"type": "sphere", "center": [0, -0.2, -0.25], "radius": 0.7, "bsdf": brushed()}
    return room(size, ball=ball)
