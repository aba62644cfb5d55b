"""Where light paths begin: emitters in proportion to their power, rays from Mitsuba's emitters.

Power differs by orders of magnitude between emitters, and photons of equal flux make the smoothest
estimate. Emitter e is therefore chosen with probability

    p_e = (1 − F) P_e s_e / Σ P s + F / n,

P_e its power from a small pilot, s_e Mitsuba's ``sampling_weight``, F = 0.05: the floor keeps every
emitter in play if the pilot underrates it. Any p > 0 gives the right energy. Delta emitters of
weight 0 are left out, because nothing else finds them either: ``path`` does not see them.

Environments (``constant``, ``envmap``, ``sunsky``, …) give the direction only, by the emitter
sampling that eye paths use: ω with density p(ω) and weight L(ω)/p(ω), seen from the centre c of the
scene's bounding sphere, of radius R. The origin is ours, uniform on the disc across ω,

    o = c + R (ω + D(ξ)),   D ⊥ ω,   Φ = π R² L(ω)/p(ω),

so that light paths carry what eye paths see, however the environment is turned or mirrored.
(``envmap.sample_ray`` of Mitsuba 3.9 puts that disc across the direction before ``to_world``.)

In spectral variants photons and eye paths must carry the same wavelengths λ, while Mitsuba's
emitters draw wavelengths λ' of their own: flux = g L(λ')/p(λ'), g the geometric part. Emitters
also give L(λ')/p(λ') by itself, so that g is known, and with L evaluated at λ the flux is g L(λ).
Environments are sampled at λ to begin with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own
from ..errors import Unsupported, one_line
from ..map.spectra import channel_mean
from ..ndf import children
from .amends import Amends, amends
from .emitters import refuse, refuse_scale
from .focus import Discs, Focus

_FLOOR = 0.05
_PILOT_RAYS = 256
_PILOT_SEED = 0xE317


@dataclass(frozen=True)
class Environment:
    """The emitter that surrounds a scene, and the scene's bounding sphere (world units). discs:
    where its rays begin, or None: anywhere."""

    emitter: Any
    centre: Any
    radius: Any
    discs: Discs | None = None

    @staticmethod
    def of(scene) -> Environment:
        return Environment(scene.environment(), *_sphere(scene))

    def sample_ray(self, time, u1, u2, u3, active=True, wavelengths=None):
        """(ray, flux) as ``mi.Emitter.sample_ray`` has them, from the direction's sampling (see
        the module's head). wavelengths  nm, spectral variants; None draws them with u1."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(u3))
        si.p, si.time = self.centre, time
        weight = mi.Spectrum(1)
        if mi.is_spectral and wavelengths is None:
            wavelengths, weight = mi.sample_rgb_spectrum(mi.sample_shifted(u1))
        if mi.is_spectral:
            si.wavelengths = wavelengths
        ds, radiance = self.emitter.sample_direction(si, u3, active)
        if self.discs is not None:
            across, spread = self.discs.sample(u2, ds.d)
            weight = weight * spread
        else:
            offset = mi.warp.square_to_uniform_disk_concentric(u2)
            across = mi.Frame3f(ds.d).to_world(mi.Vector3f(offset.x, offset.y, 0))
        origin = self.centre + self.radius * (ds.d + across)
        ray = mi.Ray3f(origin, -ds.d, time, si.wavelengths)
        return ray, radiance * weight * (dr.pi * dr.square(self.radius))

    def scaling(self) -> float:
        """How far directions that the emitter samples are from unit length, at most: not at all
        unless its ``to_world`` scales."""
        ray, _ = self.sample_ray(mi.Float(0), *_random(_PILOT_RAYS))
        return float(dr.max(dr.abs(dr.norm(ray.d) - 1))[0])

    def own_brightness(self) -> float:
        """Light in the middle of the scene by the emitter's own sample_ray, as a multiple of what
        it should be: four times the share that passes within half a radius, 1 where its discs lie
        across the rays (within about 1 %)."""
        ray, flux = self.emitter.sample_ray(mi.Float(0), *_random(1 << 16))
        distance = dr.norm(dr.cross(self.centre - ray.o, ray.d))
        flux = channel_mean(flux)
        inside = dr.select(distance < 0.5 * self.radius, flux, 0)
        return 4 * float((dr.sum(inside) / dr.sum(flux))[0])


def _sphere(scene):
    """Centre and radius of the scene's bounding sphere, world units, a little wider."""
    sphere = scene.bbox().bounding_sphere()
    centre, radius = mi.Point3f(sphere.center), mi.Float(sphere.radius * (1 + 1e-4))
    dr.make_opaque(centre, radius)
    return centre, radius


def _random(count: int):
    """The numbers that a ray takes: u1, u2, u3."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(_PILOT_SEED, count)
    return sampler.next_1d(), sampler.next_2d(), sampler.next_2d()


@dataclass(frozen=True)
class Emission:
    """Emitters of a scene with the probability of each; None where there is only one.

    textured     in spectral variants: do any emitting surfaces have textures?
    environment  Environment, or None where nothing surrounds the scene.
    amends       what the emitters' own rays need to be right, or None.
    share        of the power, of each emitter.
    members      addresses of the emitters: Dr.Jit traces calls for those of all living scenes.
    evaluated    addresses of the surfaces with a texture that Mitsuba cannot draw from.
    suns         where rays of emitters begin that are infinitely far in one direction, or None:
                 anywhere.
    """

    scene: Any
    emitters: Any
    choose: mi.DiscreteDistribution | None
    textured: bool
    environment: Environment | None
    amends: Amends | None = None
    share: tuple[float, ...] = ()
    members: frozenset[int] = frozenset()
    evaluated: frozenset[int] = frozenset()
    suns: Discs | None = None

    @property
    def from_outside(self) -> bool:
        """Is there light from infinitely far away?"""
        return any(_is_far(e) for e in self.scene.emitters())

    def focused(self, focus: Focus | None) -> Emission:
        """The same light, most of it begun above a part of the scene (see ``focus``)."""
        if focus is None:
            return self
        discs = Discs.of(focus, *_sphere(self.scene))
        far = np.array([_is_far(e) for e in self.scene.emitters()])
        around = self.environment and replace(self.environment, discs=discs)
        suns = discs if any(_is_sun(e) for e in self.scene.emitters()) else None
        found = replace(self, environment=around, suns=suns)
        if self.choose is None:
            return found
        # What each gives to that part.
        share = np.array(self.share) * np.where(far, discs.weight, 1)
        seen = self.choose.pmf.numpy() > 0
        return replace(found, choose=_chances(share, seen))

    def sample_ray(self, time, u1, u2, u3, active=True, wavelengths=None):
        """(ray, flux, emitter) of light paths; see ``mi.Scene.sample_emitter_ray``.

        wavelengths  nm, spectral variants: the ray has these, and the flux is W/nm at them.
        """
        if self.choose is None:
            index, chance = mi.UInt32(0), 1
        else:
            index, u1, chance = self.choose.sample_reuse_pmf(u1, active)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        ray, flux = self._leave(index, emitter, time, u1, u2, u3, active, wavelengths)
        return ray, flux / chance, emitter

    def _leave(self, index, emitter, time, u1, u2, u3, active, wavelengths):
        """(ray, flux) from given emitters, ``index`` among all. What surrounds the scene goes a way
        of its own; scenes without the one or the other do not trace it."""
        if self.environment is None:
            return self._from_surfaces(index, emitter, time, u1, u2, u3, active, wavelengths)
        if self.choose is None:
            return self.environment.sample_ray(time, u1, u2, u3, active, wavelengths)
        around = emitter.is_environment()
        near, flux = self._from_surfaces(
            index, emitter, time, u1, u2, u3, active & ~around, wavelengths
        )
        far, flux_far = self.environment.sample_ray(time, u1, u2, u3, active & around, wavelengths)
        return dr.select(around, far, near), dr.select(around, flux_far, flux)

    def _from_surfaces(self, index, emitter, time, u1, u2, u3, active, wavelengths):
        """(ray, flux) from emitters inside the scene, or infinitely far in one direction."""
        leave = partial(_leave_one, self.members, self.evaluated)
        ray, flux = dr.dispatch(emitter, leave, time, u1, u2, u3, active)
        if self.suns is not None:
            sun = _is_sun(emitter)
            across, spread = self.suns.sample(u2, ray.d)
            origin = self.suns.centre + self.suns.radius * (across - ray.d)
            ray.o, flux = dr.select(sun, origin, ray.o), flux * dr.select(sun, spread, 1)
        if self.amends is not None:
            ray, flux = self.amends(index, ray, flux, active)
        if wavelengths is not None:
            flux = self._at(wavelengths, emitter, ray, u1, flux, active)
            ray.wavelengths = wavelengths
        return ray, flux

    def _at(self, wavelengths, emitter, ray, u, flux, active):
        """Flux of the ray at given wavelengths (see the module's head)."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        if self.textured:  # the ray does not tell where on the texture it starts: look back
            δ = 1e-3 * (1 + dr.max(dr.abs(ray.o)))
            back = mi.Ray3f(ray)
            back.o, back.d, back.maxt = ray.o + ray.d * δ, -ray.d, 2 * δ
            si = self.scene.ray_intersect(back)
        si.wi = mi.Vector3f(0, 0, 1)
        si.wavelengths = ray.wavelengths
        over_density = partial(_spectrum_over_density, self.members)
        drawn = dr.sum(dr.dispatch(emitter, over_density, si, u, active))
        si.wavelengths = wavelengths
        radiance = dr.dispatch(emitter, partial(_spectrum, self.members), si, active)
        return radiance * dr.select(drawn > 0, dr.sum(flux) / drawn, 0)


def _leave_one(members, evaluated, emitter, time, u1, u2, u3, active):
    """(ray, flux) of Mitsuba's emitters; of the evaluated ones by a point that is uniform on the
    shape, a direction by the cosine, and the radiance there."""
    if emitter is None or emitter.ptr not in members:
        return dr.zeros(mi.Ray3f), mi.Spectrum(0)
    if emitter.ptr not in evaluated:
        return emitter.sample_ray(time, u1, u2, u3, active)
    sample = emitter.get_shape().sample_position(time, u2, active)
    si = mi.SurfaceInteraction3f(sample, dr.zeros(mi.Color0f))
    si.wi = mi.warp.square_to_cosine_hemisphere(u3)
    flux = emitter.eval(si, active) * (dr.pi / sample.pdf)
    return si.spawn_ray(si.to_world(si.wi)), flux


def _cannot_be_drawn(emitter) -> bool:
    """Does Mitsuba draw no points by the texture of this surface? (Checkerboards, for example.)"""
    shape = emitter.get_shape()
    if not (_varies(emitter) or emitter.class_name() in ("SpotLight", "Projector")):
        return False
    try:
        emitter.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    except RuntimeError as error:
        if mi.is_spectral or shape is None:
            raise Unsupported(
                f'aniso_pm: emitter "{emitter.id()}" has a texture from which Mitsuba cannot draw '
                f"({one_line(error)}); use a bitmap{' or an RGB variant' if shape else ''}"
            ) from error
        return True
    return False


def _varies(emitter) -> bool:
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def _spectrum_over_density(members, emitter, si, u, active):
    """L(λ')/p(λ') of the wavelengths si.wavelengths that the emitter has drawn with u."""
    if emitter is None or emitter.ptr not in members or emitter.is_environment():
        return mi.Spectrum(0)
    return emitter.sample_wavelengths(si, u, active)[1]


def _spectrum(members, emitter, si, active):
    """What the emitter's spectrum is at si.wavelengths; the one that its rays are drawn from."""
    if emitter is None or emitter.ptr not in members or emitter.is_environment():
        return mi.Spectrum(0)
    found = children(emitter)
    for name in ("intensity", "irradiance", "radiance"):
        if isinstance(found.get(name), mi.Texture):
            return found[name].eval(si, active)
    return emitter.eval(si, active)


def prepare(scene) -> Emission:
    """Measure the power of every emitter of a scene with at least one.

    Raises Unsupported for an emitter that cannot start light paths.
    """
    refuse(scene)
    environment = None
    if scene.environment() is not None:
        environment = Environment.of(scene)
        if environment.scaling() > 1e-3:
            refuse_scale(scene.environment())
    emitters = scene.emitters_dr()
    count = dr.width(emitters)
    textured = any(e.get_shape() is not None and _varies(e) for e in scene.emitters())
    members = frozenset(e.ptr for e in scene.emitters())
    evaluated = frozenset(e.ptr for e in scene.emitters() if _cannot_be_drawn(e))
    found = amends(scene, evaluated)
    all_ = Emission(
        scene, emitters, None, textured, environment, found, members=members, evaluated=evaluated
    )
    if count == 1:
        return all_
    weight = np.array([e.sampling_weight() for e in scene.emitters()])
    delta = np.array([mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in scene.emitters()])
    seen = ~delta | (weight > 0)
    alike = mi.DiscreteDistribution(dr.ones(mi.Float, count))
    even = replace(all_, choose=alike)
    index = dr.arange(mi.UInt32, count * _PILOT_RAYS) // _PILOT_RAYS
    emitter = dr.gather(mi.EmitterPtr, emitters, index)
    u1, u2, u3 = _random(count * _PILOT_RAYS)
    _, flux = even._leave(index, emitter, mi.Float(0), u1, u2, u3, True, None)
    flux = channel_mean(flux)
    flux = dr.select(dr.isfinite(flux), flux, 0)
    power = dr.block_sum(flux, _PILOT_RAYS).numpy().astype(np.float64) * weight
    share = power / power.sum() if power.sum() > 0 else seen / seen.sum()
    return replace(even, choose=_chances(share, seen), share=tuple(share.tolist()))


def _chances(share, seen) -> mi.DiscreteDistribution:
    """Of the emitters, from their shares of the power; seen: those that have any light."""
    chances = (1 - _FLOOR) * share / share.sum() + _FLOOR * seen / seen.sum()
    return mi.DiscreteDistribution(own(mi.Float, chances.astype(np.float32)))


def _is_far(emitter) -> bool:
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)


def _is_sun(emitter):
    """Light from infinitely far in one direction. Takes mi.EmitterPtr or an mi.Emitter."""
    flags = emitter.flags()
    has = lambda flag: mi.has_flag(flags, flag)  # noqa: E731
    return has(mi.EmitterFlags.Infinite) & has(mi.EmitterFlags.DeltaDirection)


def only_photons_see(emitter):
    """Emitters whose direct light neither emitter sampling nor a ray can find: beams of parallel
    light from a surface (``directionalarea``). Takes mi.EmitterPtr or an mi.Emitter."""
    flags = emitter.flags()
    has = lambda flag: mi.has_flag(flags, flag)  # noqa: E731
    return has(mi.EmitterFlags.DeltaDirection) & has(mi.EmitterFlags.Surface)
