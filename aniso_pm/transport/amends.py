"""What ``sample_ray`` of Mitsuba's emitters gets wrong, found by what they do, and made good.

* ``sphere.sample_position`` of Mitsuba 3.9 returns the normal before ``to_world`` with the point
  after it, so that a sphere that is turned sends half of its light into itself. Emission around
  the normal n has to be turned by the matrix A of the points p: A n = ±(p − c)/r for all samples.
* ``directionalarea`` keeps the area that its shape had when it was loaded. Flux has to be
  multiplied by the area now over the area then.
* Emitters infinitely far away keep the bounding sphere that the scene had when it was loaded, so
  that after shapes have moved, light and shadow rays begin at a wrong distance. ``set_scene``
  tells them.
* Meshes that Mitsuba has merged have no bounding box, which lights around the scene aim at.

Nothing is done about emitters that do it right, whatever their version.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .rays import MITSUBA_OFFSET

# What rounding of points and normals may come to.
_WRONG = 1e-3


@dataclass(frozen=True)
class Amends:
    """Columns with an entry for each emitter.

    x, y, z  columns of the matrix that turns directions, the identity where they are right.
    centre   of the sphere that emits, world units.
    radius   world units; 0: the ray is right as it is.
    factor   of the flux.
    """

    x: Any
    y: Any
    z: Any
    centre: Any
    radius: Any
    factor: Any

    def __call__(self, emitter: Any, ray, flux, active=True):
        """(ray, flux) put right. emitter: index among the scene's emitters."""
        radius = dr.gather(mi.Float, self.radius, emitter, active)
        turned = active & (radius > 0)
        column = lambda values: dr.gather(mi.Vector3f, values, emitter, turned)  # noqa: E731
        d = column(self.x) * ray.d.x + column(self.y) * ray.d.y + column(self.z) * ray.d.z
        # From the side of the surface that the ray leaves to
        centre = mi.Point3f(column(self.centre))
        out = dr.normalize(ray.o - centre)
        p = centre + radius * out
        o = p + out * dr.mulsign(MITSUBA_OFFSET * (1 + dr.max(dr.abs(p))), dr.dot(out, d))
        ray = mi.Ray3f(ray)
        ray.o, ray.d = dr.select(turned, o, ray.o), dr.select(turned, d, ray.d)
        return ray, flux * dr.gather(mi.Float, self.factor, emitter, active)


def amends(scene, evaluated: Container[int] = ()) -> Amends | None:
    """What the emitters of a scene need; None if all of them do right. evaluated: addresses of
    those whose textures Mitsuba does not draw from."""
    emitters = scene.emitters()
    turns = np.tile(np.eye(3), (len(emitters), 1, 1))
    centre, radius = np.zeros((len(emitters), 3)), np.zeros(len(emitters))
    factor = np.ones(len(emitters))
    for k, emitter in enumerate(emitters):
        shape = emitter.get_shape()
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
            emitter.set_scene(scene)
        if shape is None:
            continue
        # (Of a texture that is drawn from, points and normals are looked up by its coordinates.)
        drawn = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
        drawn &= emitter.ptr not in evaluated
        if shape.class_name() == "Sphere" and not drawn:
            turns[k], box = _turn(shape), shape.bbox()
            if np.abs(turns[k] - np.eye(3)).max() > _WRONG:
                centre[k], radius[k] = np.array(box.center()), 0.5 * box.extents()[0]
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
            factor[k] = _area_now_over_then(emitter, shape)
    if not radius.any() and np.abs(factor - 1).max(initial=0) < _WRONG:
        return None
    vector = lambda rows: mi.Vector3f(rows.T.astype(np.float32))  # noqa: E731
    x, y, z = (vector(turns[:, :, k]) for k in range(3))
    number = lambda values: mi.Float(values.astype(np.float32))  # noqa: E731
    found = Amends(x, y, z, vector(centre), number(radius), number(factor))
    dr.make_opaque(found.x, found.y, found.z, found.centre, found.radius, found.factor)
    return found


def _turn(sphere) -> np.ndarray:
    """The matrix A that takes the normals of samples of a sphere to where their points are."""
    u = mi.Point2f(np.random.default_rng(0).uniform(0, 1, (2, 64)).astype(np.float32))
    sample = sphere.sample_position(mi.Float(0), u)
    box = sphere.bbox()
    out = (np.array(sample.p).T - np.array(box.center())) / (0.5 * box.extents()[0])
    normal = np.array(sample.n).T * (-1 if sphere.has_flipped_normals() else 1)
    return np.linalg.lstsq(normal, out, rcond=None)[0].T


def _area_now_over_then(emitter, shape) -> float:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    _, flux = emitter.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    _, exitance = emitter.sample_wavelengths(si, mi.Float(0.5))
    then = dr.sum(flux)[0] / max(dr.sum(exitance)[0], 1e-30)
    return float(shape.surface_area()[0] / then) if then > 0 else 1.0


def repair_bounds(scene):
    """Give every mesh its bounding box.

    Mitsuba merges meshes that share a BSDF and leaves the merged one without a bounding box. The
    scene then seems smaller than it is, or infinite: lights that surround the scene aim their
    photons elsewhere and there is no extent to choose a bandwidth from.
    """
    broken = [shape for shape in scene.shapes() if not shape.bbox().valid()]
    for shape in broken:
        parameters = mi.traverse(shape)
        if "vertex_positions" in parameters:
            parameters.set_dirty("vertex_positions")
            parameters.update()
    if broken:
        scene.parameters_changed()
        for emitter in scene.emitters():
            emitter.set_scene(scene)
