"""Small closed scenes for energy checks, as dictionaries for ``mi.load_dict``.

A room of 2×2×2 around the origin (y up), a light under its ceiling large enough for ``path`` to
converge, and one object. ``regions`` names the shapes whose pixels are averaged apart.
"""

import mitsuba as mi

SIZE = 48


def wall(to_world, color, bsdf=None):
    return {
        "type": "rectangle",
        "to_world": to_world,
        "bsdf": bsdf or {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}},
    }


def room(extra=None, size=SIZE):
    """The empty room: every surface diffuse."""
    T = mi.ScalarTransform4f
    scene = {
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
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        },
        "floor": wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90), [0.6, 0.6, 0.55]),
        "ceiling": wall(T().translate([0, 1, 0]).rotate([1, 0, 0], 90), [0.7, 0.7, 0.7]),
        "back": wall(T().translate([0, 0, -1]), [0.6, 0.65, 0.7]),
        "front": wall(T().translate([0, 0, 1]).rotate([0, 1, 0], 180), [0.5, 0.5, 0.5]),
        "left": wall(T().translate([-1, 0, 0]).rotate([0, 1, 0], 90), [0.6, 0.2, 0.15]),
        "right": wall(T().translate([1, 0, 0]).rotate([0, 1, 0], -90), [0.2, 0.5, 0.2]),
        "light": {
            "type": "rectangle",
            "to_world": T().translate([0, 0.98, -0.1]).rotate([1, 0, 0], 90).scale(0.4),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8, 7.5, 7]}},
        },
    }
    return scene | (extra or {})


def room_with_plate(size=SIZE, bsdf=None):
    """A brushed plate leans against the back wall and shows the room."""
    T = mi.ScalarTransform4f
    plate = bsdf or {
        "type": "roughconductor",
        "material": "Al",
        "alpha_u": 0.05,
        "alpha_v": 0.3,
        "distribution": "beckmann",
    }
    to_world = T().translate([0.05, -0.35, -0.6]).rotate([1, 0, 0], -20).scale(0.55)
    return room(
        {
            "plate": {
                "type": "rectangle",
                "to_world": to_world,
                "bsdf": {"type": "twosided", "bsdf": plate},
            }
        },
        size,
    )


def room_with_ball(size=SIZE):
    """A glass ball above the floor: caustics, refraction, total internal reflection."""
    ball = {
        "type": "sphere",
        "center": [0.1, -0.55, -0.3],
        "radius": 0.35,
        "bsdf": {"type": "dielectric", "int_ior": 1.5},
    }
    return room({"ball": ball}, size)


ROOMS = {"room": room, "plate": room_with_plate, "ball": room_with_ball}
