"""Small scenes as dictionaries for ``mi.load_dict``, at any scale and anywhere."""

from __future__ import annotations

import mitsuba as mi
import numpy as np


def grey(value):
    return {"type": "rgb", "value": value}


def diffuse(value=0.6):
    return {"type": "diffuse", "reflectance": grey(value)}


def film(width=24, height=24):
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


class Place:
    """Where the room stands: x → scale · x + offset."""

    def __init__(self, scale=1.0, offset=0.0):
        self.scale, self.offset = scale, offset

    def __call__(self, transform=None):
        T = mi.ScalarTransform4f
        place = T().translate([self.offset] * 3).scale(self.scale)
        return place @ transform if transform is not None else place

    def point(self, *p):
        return [self.scale * c + self.offset for c in p]


def plate(place, bsdf=None):
    """A brushed plate that leans against the back wall."""
    T = mi.ScalarTransform4f
    to_world = T().translate([0.05, -0.35, -0.6]).rotate([1, 0, 0], -20).scale(0.55)
    bsdf = bsdf or {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3}
    return {
        "type": "rectangle",
        "to_world": place(to_world),
        "bsdf": {"type": "twosided", "bsdf": bsdf},
    }


def ball(place, bsdf, center=(0.3, -0.6, 0.0), radius=0.35):
    return {
        "type": "sphere",
        "to_world": place(mi.ScalarTransform4f().translate(list(center)).scale(radius)),
        "bsdf": bsdf,
    }


def room(extra=None, place=None, size=24, light=8.0, albedo=0.6, without=()):
    """A closed room of 2×2×2 around the origin with a lamp under the ceiling. extra: a function of
    the place that returns more objects; ``without`` names objects to leave out."""
    T, place = mi.ScalarTransform4f, place or Place()

    def wall(transform, value):
        return {"type": "rectangle", "to_world": place(transform), "bsdf": diffuse(value)}

    camera = T().look_at(origin=[0, 0, 0.97], target=[0, -0.15, 0], up=[0, 1, 0])
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 75,
            "near_clip": 1e-4 * place.scale,
            "far_clip": 1e4 * place.scale,
            # Scaling a sensor is refused: only its origin moves.
            "to_world": T().translate(place.point(0, 0, 0.97))
            @ T().translate([0, 0, -0.97])
            @ camera,
            "film": film(size, size),
            "sampler": {"type": "independent"},
        },
        "floor": wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90), albedo),
        "ceiling": wall(T().translate([0, 1, 0]).rotate([1, 0, 0], 90), 1.1 * albedo),
        "back": wall(T().translate([0, 0, -1]), albedo),
        "front": wall(T().translate([0, 0, 1]).rotate([0, 1, 0], 180), 0.8 * albedo),
        "left": wall(T().translate([-1, 0, 0]).rotate([0, 1, 0], 90), 0.7 * albedo),
        "right": wall(T().translate([1, 0, 0]).rotate([0, 1, 0], -90), 0.5 * albedo),
        "light": {
            "type": "rectangle",
            "to_world": place(T().translate([0, 0.98, -0.1]).rotate([1, 0, 0], 90).scale(0.4)),
            "bsdf": diffuse(0.0),
            "emitter": {"type": "area", "radiance": grey(light)},
        },
    }
    scene |= extra(place) if extra else {}
    return {name: value for name, value in scene.items() if name not in without}


def mesh(name, vertices, faces, bsdf, uv=None):
    """A mesh of the given triangles with the BSDF (a dictionary)."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh(
        name, len(vertices), len(faces), has_vertex_texcoords=uv is not None, props=properties
    )
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    return made
