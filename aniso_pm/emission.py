"""Where light paths begin: emitters in proportion to their power, rays from Mitsuba's emitters.

Power differs by orders of magnitude between emitters, and photons of equal flux make the smoothest
estimate. Emitter e is therefore chosen with probability

    p_e = (1 − F) P_e s_e / Σ P s + F / n,

P_e its power from a small pilot, s_e Mitsuba's ``sampling_weight``, F = 0.05: the floor keeps every
emitter in play if the pilot underrates it. Any p > 0 gives the right energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_FLOOR = 0.05
_PILOT_RAYS = 256
_PILOT_SEED = 0xE317


@dataclass(frozen=True)
class Emission:
    """Emitters of a scene with the probability of each; None where there is only one."""

    emitters: Any
    choose: mi.DiscreteDistribution | None

    def sample_ray(self, time, u1, u2, u3, active=True):
        """(ray, flux, emitter) of light paths; see ``mi.Scene.sample_emitter_ray``.

        u1 chooses the emitter (and, in spectral variants, wavelengths with what is left of it).
        """
        if self.choose is None:
            emitter, chance = dr.gather(mi.EmitterPtr, self.emitters, mi.UInt32(0), active), 1
        else:
            index, u1, chance = self.choose.sample_reuse_pmf(u1, active)
            emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        ray, flux = emitter.sample_ray(time, u1, u2, u3, active)
        return ray, flux / chance, emitter


def prepare(scene) -> Emission:
    """Measure the power of every emitter of a scene with at least one."""
    emitters = scene.emitters_dr()
    count = dr.width(emitters)
    if count == 1:
        return Emission(emitters, None)
    lane = dr.arange(mi.UInt32, count * _PILOT_RAYS)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(_PILOT_SEED, count * _PILOT_RAYS)
    emitter = dr.gather(mi.EmitterPtr, emitters, lane // _PILOT_RAYS)
    _, flux = emitter.sample_ray(
        mi.Float(0), sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True
    )
    flux = dr.mean(flux)
    flux = dr.select(dr.isfinite(flux), flux, 0)
    weight = dr.gather(mi.EmitterPtr, emitters, dr.arange(mi.UInt32, count)).sampling_weight()
    power = dr.block_sum(flux, _PILOT_RAYS).numpy().astype(np.float64) * mi.Float(weight).numpy()
    total = power.sum()
    share = power / total if total > 0 else np.full(count, 1 / count)
    chances = (1 - _FLOOR) * share + _FLOOR / count
    return Emission(emitters, mi.DiscreteDistribution(mi.Float(chances.astype(np.float32))))


def only_photons_see(emitter):
    """Emitters whose direct light neither emitter sampling nor a ray can find: beams of parallel
    light from a surface (``directionalarea``). Takes mi.EmitterPtr or an mi.Emitter."""
    flags = emitter.flags()
    has = lambda flag: mi.has_flag(flags, flag)  # noqa: E731
    return has(mi.EmitterFlags.DeltaDirection) & has(mi.EmitterFlags.Surface)
