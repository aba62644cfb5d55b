"""Where light paths begin: emitters in proportion to their power, rays from Mitsuba's emitters.

Power differs by orders of magnitude between emitters, and photons of equal flux make the smoothest
estimate. Emitter e is therefore chosen with probability

    p_e = (1 − F) P_e s_e / Σ P s + F / n,

P_e its power from a small pilot, s_e Mitsuba's ``sampling_weight``, F = 0.05: the floor keeps every
emitter in play if the pilot underrates it. Any p > 0 gives the right energy. Delta emitters of
weight 0 are left out, because nothing else finds them either: ``path`` does not see them.

In spectral variants photons and eye paths must carry the same wavelengths λ, while Mitsuba's
emitters draw wavelengths λ' of their own: flux = g L(λ')/p(λ'), g the geometric part. Emitters
also give L(λ')/p(λ') by itself, so that g is known, and with L evaluated at λ the flux is g L(λ).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .ndf import children

_FLOOR = 0.05
_PILOT_RAYS = 256
_PILOT_SEED = 0xE317


@dataclass(frozen=True)
class Emission:
    """Emitters of a scene with the probability of each; None where there is only one.

    textured  in spectral variants: do any emitting surfaces have textures?
    """

    scene: Any
    emitters: Any
    choose: mi.DiscreteDistribution | None
    textured: bool

    def sample_ray(self, time, u1, u2, u3, active=True, wavelengths=None):
        """(ray, flux, emitter) of light paths; see ``mi.Scene.sample_emitter_ray``.

        wavelengths  nm, spectral variants: the ray has these, and the flux is W/nm at them.
        """
        if self.choose is None:
            emitter, chance = dr.gather(mi.EmitterPtr, self.emitters, mi.UInt32(0), active), 1
        else:
            index, u1, chance = self.choose.sample_reuse_pmf(u1, active)
            emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        ray, flux = emitter.sample_ray(time, u1, u2, u3, active)
        if wavelengths is not None:
            flux = self._at(wavelengths, emitter, ray, u1, flux, active)
            ray.wavelengths = wavelengths
        return ray, flux / chance, emitter

    def _at(self, wavelengths, emitter, ray, u, flux, active):
        """Flux of the ray at given wavelengths (see the module's head)."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        if self.textured:  # the ray does not tell where on the texture it starts: look back
            δ = 1e-3 * (1 + dr.max(dr.abs(ray.o)))
            back = mi.Ray3f(ray)
            back.o, back.d, back.maxt = ray.o + ray.d * δ, -ray.d, 2 * δ
            si = self.scene.ray_intersect(back)
        si.wi = dr.select(emitter.is_environment(), ray.d, mi.Vector3f(0, 0, 1))
        si.wavelengths = ray.wavelengths
        # Environment maps draw from D65, and ask for texture coordinates that are not ours to know.
        white = mi.load_dict({"type": "d65"})
        white = white.sample_spectrum(si, mi.sample_shifted(u))[1] / white.eval(si)
        drawn = dr.sum(dr.dispatch(emitter, _spectrum_over_density, si, u, white, active))
        si.wavelengths = wavelengths
        radiance = dr.dispatch(emitter, _spectrum, si, active)
        return radiance * dr.select(drawn > 0, dr.sum(flux) / drawn, 0)


def _spectrum_over_density(emitter, si, u, white, active):
    """L(λ')/p(λ') of the wavelengths si.wavelengths that the emitter has drawn with u.
    white: 1/p(λ') where the emitter draws from D65."""
    if emitter is None:
        return mi.Spectrum(0)
    if emitter.class_name() == "EnvironmentMapEmitter":
        return emitter.eval(si, active) * white
    return emitter.sample_wavelengths(si, u, active)[1]


def _spectrum(emitter, si, active):
    """What the emitter's spectrum is at si.wavelengths; the one that its rays are drawn from."""
    if emitter is None:
        return mi.Spectrum(0)
    found = children(emitter)
    for name in ("intensity", "irradiance", "radiance"):
        if isinstance(found.get(name), mi.Texture):
            return found[name].eval(si, active)
    return emitter.eval(si, active)  # envmap, sunsky


def prepare(scene) -> Emission:
    """Measure the power of every emitter of a scene with at least one.

    Raises ValueError for an emitter that cannot start light paths.
    """
    for emitter in scene.emitters():
        kind = emitter.class_name()
        if kind == "TimedSunskyEmitter":
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a timed_sunsky, from which Mitsuba cannot '
                'trace light (its sample_ray raises); use "sunsky" for one point in time'
            )
        if mi.is_spectral and kind == "Projector":
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a projector, whose light cannot be '
                "evaluated at given wavelengths; use an RGB variant"
            )
    emitters = scene.emitters_dr()
    count = dr.width(emitters)
    varying = int(mi.EmitterFlags.Surface) | int(mi.EmitterFlags.SpatiallyVarying)
    textured = any((e.flags() & varying) == varying for e in scene.emitters())
    lane = dr.arange(mi.UInt32, count * _PILOT_RAYS)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(_PILOT_SEED, count * _PILOT_RAYS)
    emitter = dr.gather(mi.EmitterPtr, emitters, lane // _PILOT_RAYS)
    _, flux = emitter.sample_ray(
        mi.Float(0), sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True
    )
    flux = dr.mean(flux)
    flux = dr.select(dr.isfinite(flux), flux, 0)
    weight = np.array([e.sampling_weight() for e in scene.emitters()])
    delta = np.array([mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in scene.emitters()])
    seen = ~delta | (weight > 0)
    if count == 1:
        return Emission(scene, emitters, None, textured)
    power = dr.block_sum(flux, _PILOT_RAYS).numpy().astype(np.float64) * weight
    share = power / power.sum() if power.sum() > 0 else seen / seen.sum()
    chances = (1 - _FLOOR) * share + _FLOOR * seen / seen.sum()
    choose = mi.DiscreteDistribution(mi.Float(chances.astype(np.float32)))
    return Emission(scene, emitters, choose, textured)


def only_photons_see(emitter):
    """Emitters whose direct light neither emitter sampling nor a ray can find: beams of parallel
    light from a surface (``directionalarea``). Takes mi.EmitterPtr or an mi.Emitter."""
    flags = emitter.flags()
    has = lambda flag: mi.has_flag(flags, flag)  # noqa: E731
    return has(mi.EmitterFlags.DeltaDirection) & has(mi.EmitterFlags.Surface)
