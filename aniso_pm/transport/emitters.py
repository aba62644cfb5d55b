"""Emitters that light paths cannot start at, or not in agreement with what eye paths see.

Where Mitsuba's own emitter sampling (what ``path`` shows) and its ``sample_ray`` disagree, or the
former disagrees with what rays meet, and nothing here can decide or mend it, the scene is refused
in one sentence that says what to do instead.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import Unsupported
from ..ndf import children

_ROUNDING = 1e-3


def refuse(scene):
    """Raise Unsupported for the first emitter of a scene that cannot start light paths."""
    for emitter in scene.emitters():
        kind = emitter.class_name()
        if kind == "TimedSunskyEmitter":
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" is a timed_sunsky, from which Mitsuba cannot '
                'trace light (its sample_ray raises); use "sunsky" for one point in time'
            )
        if mi.is_spectral and kind == "Projector":
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" is a projector, whose light cannot be '
                "evaluated at given wavelengths; use an RGB variant"
            )
        if mi.is_spectral and kind == "SpotLight":
            texture = children(emitter).get("texture")
            if texture is not None and texture.class_name() != "UniformSpectrum":
                raise Unsupported(
                    f'aniso_pm: emitter "{emitter.id()}" is a spot with a "texture", whose light '
                    "cannot be evaluated at given wavelengths; use an RGB variant"
                )
        radiance = children(emitter).get("radiance")
        if isinstance(radiance, mi.Texture) and radiance.class_name() == "MeshAttribute":
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" has a mesh_attribute for its radiance, by '
                "which Mitsuba cannot draw light paths; use a bitmap"
            )
        lengths = _scales(emitter)
        if kind in ("Projector", "DirectionalEmitter") and np.abs(lengths - 1).max() > _ROUNDING:
            refuse_scale(emitter)
        if kind == "SpotLight" and np.ptp(lengths) > _ROUNDING * lengths.max():
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" is a spot with a "to_world" that scales '
                "unevenly, under which Mitsuba's light paths and its emitter sampling disagree; "
                "leave only rotations, mirrorings and one scale for all axes"
            )
        varies = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
        shape = emitter.get_shape()
        if varies and shape is not None and _strays(shape):
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" has a texture on the shape "{shape.id()}", '
                "where Mitsuba's emitter sampling finds other points, or the other side, than rays "
                "meet; give the shape texture coordinates that do not overlap, and neither "
                '"flip_normals" nor, on a sphere or cylinder, a "to_world" that turns or mirrors'
            )
        if shape is not None and shape.class_name() == "Cylinder" and _lies(shape)[1]:
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" is on a cylinder with a "to_world" that '
                "mirrors it, where Mitsuba's emitter sampling finds the other side than rays meet; "
                'leave the mirroring out (scale by -1), and give "flip_normals" the other value'
            )


def refuse_scale(emitter):
    """Raise Unsupported about a ``to_world`` that scales."""
    raise Unsupported(
        f'aniso_pm: emitter "{emitter.id()}" has a "to_world" that scales, under which Mitsuba\'s '
        "own sampling is wrong (directions that are not of unit length, or another brightness); "
        "leave only rotations (about axes of length 1) and mirrorings (scale by -1)"
    )


def _scales(emitter) -> np.ndarray:
    """Factors by which an emitter's ``to_world`` scales; 1 without one."""
    to_world = children(emitter).get("to_world")
    if to_world is None:
        return np.ones(3)
    matrix = np.array(to_world.matrix, dtype=np.float64).reshape(4, 4, -1)[:3, :3, 0]
    return np.linalg.svd(matrix, compute_uv=False)


def _strays(shape) -> bool:
    """Does Mitsuba find other points of a shape by texture coordinates than have them? Of textured
    emitters it draws texture coordinates."""
    if isinstance(shape, mi.Mesh) and not shape.has_vertex_texcoords():
        return True
    near, other_side = _lies(shape)
    return near < 0.97 or other_side  # edges and poles


def _lies(shape) -> tuple[float, bool]:
    """Of points of a shape that are looked up by texture coordinates: how many lie where they
    should, and do normals there point to the other side?"""
    u = mi.Point2f(np.random.default_rng(0).uniform(0, 1, (2, 256)).astype(np.float32))
    sample = shape.sample_position(mi.Float(0), u)
    found = shape.eval_parameterization(sample.uv)
    size = dr.norm(mi.Vector3f(shape.bbox().extents()))
    near = found.is_valid() & (dr.norm(found.p - sample.p) < 0.01 * size)
    cosine = dr.select(near, dr.dot(found.n, sample.n), 0)
    return float(dr.mean(dr.select(near, 1.0, 0.0))[0]), bool(dr.sum(cosine)[0] < 0)
