"""Which emitter eye paths ask for direct light: one that may give much at the place.

Mitsuba asks all alike. Here group k of the emitters is drawn at x with the chance

    p_k = (1 − F) w_k/Σ w + F s_k/Σ s,

s_k being the ``sampling_weight`` of its emitters together, and w_k its irradiance at x were nothing
between: Φ/π cos θ cos θ'/d² of flat lamps of power Φ that look the same way, θ and θ' the angles at
x and at the lamp, Φ/Ω cos θ/d² of what shines into a solid angle Ω. The angles are the best that a
sphere around the group allows, d is never less than its radius, and light from far away is as
bright everywhere. Of an environment only that part counts which multiple importance sampling leaves
to this: the rest is better found by the directions in which paths go on [after the importance of
Conty Estévez and Kulla 2018, without their tree]. A group is a single emitter as long as there are
few, or as it is strong; neighbours in a group have the same chance. What stands between x and a
lamp is known in the mean at best (see ``shadows``): F keeps all of them in play. Emitters of weight
0 are never asked, as in ``path``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import number, own
from .emission import Emission, only_photons_see
from .lamps import neighbours

# F, the share of the samples that goes by weights.
_BY_WEIGHT = 0.15
# Groups at most, and those of lights that are far away.
_MOST, _FAR = 12, 4
# Smallest radius of a group, as a share of the scene's.
_SMALLEST = 1e-4
# Emitters of a group whose directions are looked at.
_LOOKED_AT = 16
# From here on directions are alike, or have one in common.
_ALIKE, _COMMON = 1 - 1e-4, 0.1


@dataclass  # not frozen: Dr.Jit writes back whatever a loop mentions
class Group:
    """Emitters that are drawn together. Arrays with one entry, or None.

    first, count  of them in ``DirectLight.members``.
    weight  their part of all weights.
    power   w at a distance of one unit in the middle of the lobe; of far ones anywhere.
    centre, radius  of a sphere around them; None: they are far away.
    axis    of the lobe; None: they shine anywhere.
    cosine  of the angle around the axis that the lobe fills; None: brightness goes with the cosine.
    """

    first: int
    count: int
    weight: Any
    power: Any
    centre: Any = None
    radius: Any = None
    axis: Any = None
    cosine: Any = None

    def irradiance(self, p, n, through):
        """w at points p. n: normal on the side of the viewer; through: what comes from the other
        side counts as well."""
        if self.centre is None:
            if self.axis is None:
                return self.power
            to, near, size = -self.axis, mi.Float(1), mi.Float(0)
        else:
            to = self.centre - p
            near = dr.rsqrt(dr.maximum(dr.squared_norm(to), dr.square(self.radius)))
            to, size = to * near, self.radius * near
        w = self.power * dr.square(near)
        w *= dr.select(through, 1, dr.clip(dr.dot(n, to) + size, 0, 1))
        if self.axis is None or self.centre is None:
            return w
        there = -dr.dot(self.axis, to)
        if self.cosine is not None:
            return dr.select(there + size >= self.cosine, w, 0)
        return w * dr.select(there > 0, dr.minimum(there + 0.5 * size, 1), 0)


@dataclass  # not frozen, as above
class DirectLight:
    """The emitters of a scene.

    groups    of them.
    members   their numbers, group by group.
    group_of  of an emitter, by its registry number; alone: 1/count of that group.
    emitters  mi.EmitterPtr, by number.
    """

    groups: list[Group]
    members: Any
    group_of: Any
    alone: Any
    emitters: Any

    @staticmethod
    def of(scene, emission: Emission | None) -> DirectLight | None:
        """None where there is nothing to choose."""
        emitters = scene.emitters()
        weight = [e.sampling_weight() for e in emitters]
        asked = [k for k, e in enumerate(emitters) if weight[k] > 0 and not only_photons_see(e)]
        if emission is None or len(asked) < 2:
            return None
        all_ = sum(weight[k] for k in asked)
        extent = float(scene.bbox().bounding_sphere().radius)
        groups: list[Group] = []
        members: list[int] = []
        power_of = {k: emission.share[k] / weight[k] for k in asked}
        for numbers in _together(emitters, power_of):
            power = sum(power_of[k] for k in numbers)
            some = [emitters[k] for k in numbers]
            part = sum(weight[k] for k in numbers) / all_
            groups.append(_group(some, len(members), part, power, extent))
            members += numbers
        # As the registry counts them; others are never met.
        ids = dr.reinterpret_array(mi.UInt32, scene.emitters_dr()).numpy()
        group_of, alone = np.zeros(ids.max() + 1, np.uint32), np.zeros(ids.max() + 1, np.float32)
        for k, group in enumerate(groups):
            inside = ids[members[group.first : group.first + group.count]]
            group_of[inside], alone[inside] = k, 1 / group.count
        return DirectLight(
            groups,
            own(mi.UInt32, np.array(members, np.uint32)),
            own(mi.UInt32, group_of),
            own(mi.Float, alone),
            scene.emitters_dr(),
        )

    def begin(self) -> list:
        """Chances before anything was drawn."""
        return [mi.Float(0) for _ in self.groups]

    def chances(self, si, n, through) -> list:
        """p of each group. n, through: as for ``Group.irradiance``."""
        w = [group.irradiance(si.p, n, through) for group in self.groups]
        sum_ = sum(w)
        lit, scale = sum_ > 1e-30, (1 - _BY_WEIGHT) / dr.maximum(sum_, 1e-30)
        found = []
        for group, w_k in zip(self.groups, w, strict=True):
            found.append(
                dr.select(lit, dr.fma(scale, w_k, _BY_WEIGHT * group.weight), group.weight)
            )
        return found

    def sample(self, si, chances, u, active):
        """(direction sample, radiance over its density) as ``mi.Scene.sample_emitter_direction``
        has them, not tested for visibility."""
        first, count = mi.UInt32(0), mi.UInt32(1)
        below, chance, sum_ = mi.Float(0), mi.Float(1), mi.Float(0)
        for group, p in zip(self.groups, chances, strict=True):
            here = (u.x >= sum_) & (p > 0)
            first, count = dr.select(here, group.first, first), dr.select(here, group.count, count)
            below, chance = dr.select(here, sum_, below), dr.select(here, p, chance)
            sum_ += p
        x = dr.clip((u.x - below) / chance, 0, dr.one_minus_epsilon(mi.Float)) * mi.Float(count)
        member = dr.minimum(mi.UInt32(x), count - 1)
        index = dr.gather(mi.UInt32, self.members, first + member, active)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        ds, light = emitter.sample_direction(si, mi.Point2f(x - mi.Float(member), u.y), active)
        chance /= mi.Float(count)
        ds.pdf *= chance
        return ds, light / chance

    def pdf(self, si, chances, ds, active):
        """Of a direction in which an emitter was met, as ``mi.Scene.pdf_emitter_direction``."""
        number = dr.reinterpret_array(mi.UInt32, ds.emitter)
        group = dr.gather(mi.UInt32, self.group_of, number, active)
        chance = mi.Float(0)
        for k, p in enumerate(chances):
            chance = dr.select(group == k, p, chance)
        chance *= dr.gather(mi.Float, self.alone, number, active)
        return ds.emitter.pdf_direction(si, ds, active) * chance


def lit_sides(bsdf, si, ray) -> tuple[Any, Any]:
    """(n, through) of a vertex that the ray has met, as ``Group.irradiance`` has them."""
    n = dr.mulsign(mi.Vector3f(si.n), -dr.dot(ray.d, si.n))
    return n, mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)


def _together(emitters, power: dict[int, float]) -> list[list[int]]:
    """Numbers of emitters that are drawn together: neighbours, but for those that have more than
    their part of all the power. power: of each that is asked."""
    valid = {k: emitters[k].bbox().valid() for k in power}
    far = [[k] for k in power if not valid[k]]
    if len(far) > _FAR:
        far = [[k for group in far for k in group]]
    strong = {k for k in power if valid[k] and power[k] * _MOST > sum(power.values())}
    alone = [[k] for k in sorted(strong, key=lambda k: -power[k])[: _MOST // 2]]
    apart = {group[0] for group in alone}
    near = [k for k in power if valid[k] and k not in apart]
    middles = np.array([emitters[k].bbox().center() for k in near]).reshape(-1, 3)
    groups = neighbours(middles, _MOST - len(far) - len(alone))
    return alone + [[near[k] for k in group] for group in groups] + far


def _group(emitters, first: int, weight: float, power: float, extent: float) -> Group:
    """extent: radius of the scene, in units of which w counts distances. power: on any scale."""
    axis, cosine = _lobe(emitters)
    boxes = [e.bbox() for e in emitters]
    near = all(box.valid() for box in boxes)
    centre = radius = None
    if near:
        low, high = np.min([box.min for box in boxes], 0), np.max([box.max for box in boxes], 0)
        centre = mi.Point3f(*(0.5 * (low + high)).tolist())
        size = 0.5 * float(np.linalg.norm(high - low))
        radius = number(mi.Float, max(size, _SMALLEST * extent))
        power *= extent**2 / (np.pi if cosine is None else 2 * np.pi * (1 - cosine))
    else:
        power /= np.pi * (4 if axis is None else 1)
        power *= float(np.mean([_left_to_us(e) for e in emitters]))
    lobe = None if axis is None else mi.Vector3f(*axis.tolist())
    dr.make_opaque(centre, lobe)
    return Group(
        first,
        len(emitters),
        number(mi.Float, weight),
        number(mi.Float, power),
        centre,
        radius,
        lobe,
        None if cosine is None or axis is None else number(mi.Float, cosine),
    )


def _left_to_us(emitter) -> float:
    """Part of the light of a far emitter that counts here: mean weight of the power heuristic, in
    proportion to the light, at a diffuse surface, whose own density is 1/π at the most."""
    if not emitter.is_environment():
        return 1.0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1024)
    here = dr.zeros(mi.SurfaceInteraction3f, 1024)
    density = emitter.sample_direction(here, sampler.next_2d())[0].pdf.numpy().astype(np.float64)
    return float(np.mean(density**2 / (density**2 + np.pi**-2)))


def _lobe(emitters) -> tuple[np.ndarray | None, float | None]:
    """(axis, cosine) as ``Group`` has them; cosine −1 where there is no axis."""
    if len(emitters) > _LOOKED_AT:
        return None, -1.0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 256)
    time, u1, u2, u3 = mi.Float(0), sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    shapes = [e.get_shape() for e in emitters]
    directions = []
    for emitter, shape in zip(emitters, shapes, strict=True):
        if emitter.is_environment():
            return None, -1.0
        if shape is not None:
            directions.append(np.array(shape.sample_position(time, u2).n).T)
        else:
            directions.append(np.array(emitter.sample_ray(time, u1, u2, u3)[0].d).T)
    d = np.concatenate(directions)
    mean = d.mean(0)
    length = float(np.linalg.norm(mean))
    if None not in shapes:
        return (mean / length, None) if length > _ALIKE else (None, -1.0)
    if length < _COMMON or len(emitters) > 1:
        return None, -1.0
    return mean / length, min(float(np.min(d @ mean)) / length, _ALIKE)
