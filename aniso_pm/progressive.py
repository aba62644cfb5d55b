"""Passes: fresh photons and fresh eye paths, accumulated in the film at a shrinking bandwidth.

Probabilistic progressive photon mapping [Knaus and Zwicker 2011]: pass i + 1 uses a kernel whose
area is (i + α)/(i + 1) times that of pass i. Variance grows and bias shrinks so that the mean over
passes converges to the right image. Passes are pure: pass i depends on (scene, parameters, seed, i)
alone.
"""

from __future__ import annotations

import math
import time

import drjit as dr
import mitsuba as mi

from . import film as films
from .errors import is_interrupt
from .pilot import automatic_radius, camera_rays
from .prepared import COLOUR, EYE, PROBE, Prepared, stream_seed

# Eye samples traced at once: bounds memory (about 250 bytes a sample).
WAVEFRONT = 1 << 21

# Passes that make the colours of a spectral picture right within about a percent.
_SPECTRAL_PASSES = 16


def bandwidth(initial_radius: float, alpha: float, index: int) -> float:
    """Kernel radius of pass ``index`` (0-based): r² shrinks by (i + α)/(i + 1) after pass i.

    ∏ (i + α)/(i + 1) for i = 1 … index is Γ(index + 1 + α) / (Γ(1 + α) Γ(index + 2)).
    """
    log_area = math.lgamma(index + 1 + alpha) - math.lgamma(1 + alpha) - math.lgamma(index + 2)
    return initial_radius * math.exp(0.5 * log_area)


def render(scene: Prepared, sensor, seed: int, spp: int, report, statistics: dict):
    """Render all passes into the sensor's film; returns (map, radius) of the last one.

    spp         total over all passes, shared evenly; 0 takes the sampler's own.
    report      called as report(done, total, text) after every wavefront; done and total count
                passes and may be fractions.
    statistics  filled in as rendering goes on.

    Ctrl-C ends rendering: the film then holds all wavefronts that were finished and
    statistics["interrupted"] is True. It is raised on where the film is still empty.
    """
    settings = scene.settings
    clock = _Clock()
    film = sensor.film()
    spp = spp or sensor.sampler().sample_count()
    if spp < settings.passes:
        raise ValueError(
            f"aniso_pm: {spp} samples per pixel cannot be shared by {settings.passes} passes; "
            f'raise the sample count to {settings.passes} or lower the parameter "passes"'
        )
    if not scene.scene.emitters():
        mi.Log(mi.LogLevel.Warn, "aniso_pm: the scene has no emitters; the picture will be black")
    if mi.is_spectral and settings.passes < _SPECTRAL_PASSES:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: all light of a pass shares four wavelengths; {settings.passes} passes will "
            f'give wrong colours, set the parameter "passes" to {_SPECTRAL_PASSES} or more',
        )
    film.prepare([])
    radius0 = settings.initial_radius or automatic_radius(scene, camera_rays(sensor, seed), seed)
    clock.lap("pilot")
    statistics |= {
        "initial_radius": radius0,
        "radius_automatic": settings.initial_radius == 0,
        "photons_emitted": 0,
        "photons_stored": 0,
        "photons_rejected": 0,
        "photons_gathered": 0,
        "eye_samples": 0,
        "eye_samples_rejected": 0,
        "gather_points": 0,
        "gather_points_anisotropic": 0,
        "gather_points_clamped": 0,
        "gather_points_capped": 0,
        "gather_points_degenerate": 0,
        "gather_points_off_surface": 0,
        "passes": 0,
        "spp": 0,
        "interrupted": False,
        "seconds": clock.seconds,
    }
    map_ = radius = None
    try:
        for i in range(settings.passes):
            radius = bandwidth(radius0, settings.alpha, i)
            colour = _wavelength_sample(seed, i)
            wavelengths = films.wavelengths(sensor, colour) if mi.is_spectral else None
            map_ = scene.photon_map(seed, i, map_.stored if map_ else 0, wavelengths)
            statistics["photons_emitted"] += map_.emitted
            statistics["photons_stored"] += map_.stored
            statistics["photons_rejected"] += map_.rejected
            clock.lap("photons")
            share = spp // settings.passes + (i < spp % settings.passes)
            for done in _eye_pass(
                scene, sensor, map_, radius, seed, i, share, colour, statistics, clock
            ):
                report(i + done / share, settings.passes, f"pass {i + 1}/{settings.passes}")
            statistics["radius"] = radius
            statistics["passes"] += 1
    except BaseException as error:
        if not is_interrupt(error) or statistics["spp"] == 0:
            raise
        statistics["interrupted"] = True
    _warn(statistics)
    return map_, radius


def _wavelength_sample(seed: int, index: int) -> float:
    """Which wavelengths pass ``index`` takes: a van der Corput sequence from a random start. Each
    sample stands for four wavelengths a quarter apart, so it needs to cover a quarter only."""
    start = stream_seed(seed, COLOUR) / 2**32
    sequence = int(f"{index:032b}"[::-1], 2) / 2**32
    return (start + sequence / 4) % 1


def _eye_pass(scene: Prepared, sensor, map_, radius, seed, index, spp, colour, statistics, clock):
    """Trace ``spp`` eye samples a pixel against one map, wavefront by wavefront; yields the
    samples a pixel taken so far."""
    film = sensor.film()
    pixels = films.pixel_count(film)
    per_wavefront = max(1, min(spp, WAVEFRONT // pixels))
    # An array, not a number: as a literal it would make every pass compile kernels of its own.
    radius = dr.opaque(mi.Float, radius)
    taken = wavefront = expected = 0
    while taken < spp:
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(min(per_wavefront, spp - taken))
        count = sampler.sample_count()  # samplers may round it up
        sampler.set_samples_per_wavefront(count)
        seed_ = mi.sample_tea_32(stream_seed(seed, EYE, index), wavefront)[0]
        sampler.seed(seed_, pixels * count)

        # --- Eye paths and density estimation ---
        ray, ray_weight, position = films.sample_rays(sensor, sampler, count, colour)
        dr.eval(ray, ray_weight, position)
        probe_seed = mi.sample_tea_32(stream_seed(seed, PROBE, index), wavefront)[0]
        seen = scene.radiance(sampler, ray, map_, radius, probe_seed, expected, clock.lap)
        L = seen.L
        for found in seen.gathered:
            statistics["gather_points"] += dr.width(found.lane)
            statistics["gather_points_anisotropic"] += int(dr.count(found.follows)[0])
            statistics["gather_points_clamped"] += int(dr.count(found.clamped)[0])
            statistics["gather_points_capped"] += int(dr.count(found.capped)[0])
            statistics["gather_points_degenerate"] += int(dr.count(found.degenerate)[0])
            statistics["gather_points_off_surface"] += int(dr.count(found.lost)[0])
            statistics["photons_gathered"] += int(dr.sum(mi.Float64(found.photons))[0])
        expected = sum(dr.width(found.lane) for found in seen.gathered)

        # --- Into the film ---
        finite = dr.all(dr.isfinite(L))
        statistics["eye_samples_rejected"] += dr.width(L) - int(dr.count(finite)[0])
        films.splat(
            film, position, dr.select(finite, L, 0) * ray_weight, seen.valid, count, ray.wavelengths
        )
        clock.lap("film")
        statistics["eye_samples"] += pixels * count
        statistics["spp"] += count
        taken += count
        wavefront += 1
        yield min(taken, spp)


def _warn(statistics):
    emitted = statistics["photons_emitted"]
    if statistics["photons_rejected"] > 1e-3 * emitted:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: {statistics['photons_rejected']} times in {emitted} light paths a flux was "
            "not finite and was dropped; an emitter or a BSDF returns NaN or infinity",
        )
    if statistics["eye_samples_rejected"]:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: {statistics['eye_samples_rejected']} of {statistics['eye_samples']} eye "
            "samples were not finite and count as black",
        )


class _Clock:
    """Wall-clock time of each stage; a lap ends when the work handed to Dr.Jit is done."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, stage: str):
        dr.sync_thread()
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now
