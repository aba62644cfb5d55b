"""Passes: fresh photons and fresh eye paths, accumulated in the film at a shrinking bandwidth.

Probabilistic progressive photon mapping [Knaus and Zwicker 2011]: pass i + 1 uses a kernel whose
area is (i + α)/(i + 1) times that of pass i. Variance grows and bias shrinks so that the mean over
passes converges to the right image. Passes are pure: pass i depends on (scene, parameters, seed, i)
alone.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from . import density, eye, photons
from .needs import Needs, read_scene
from .settings import Settings

# Eye samples traced at once: bounds memory (about 250 bytes a sample).
WAVEFRONT = 1 << 21
# Photons inside the cut kernel that the automatic bandwidth aims at, in the median gather point.
PHOTONS_PER_KERNEL = 60
# The pilot that finds it: light paths, eye paths, photons that a disc must hold.
_PILOT_PHOTONS, _PILOT_RAYS, _PILOT_ENOUGH = 50_000, 4096, 16
_EYE, _PROBE, _PHOTONS, _PILOT = range(4)  # streams of random numbers


class Unsupported(ValueError):
    """The variant or the scene asks for something that this integrator does not do."""


@dataclass
class Scene:
    """A Mitsuba scene with what was found out about it once."""

    scene: Any
    needs: Needs
    settings: Settings
    hide_emitters: bool

    def with_(self, **changes) -> Scene:
        """The same scene with some parameters changed."""
        return replace(self, settings=self.settings.with_(**changes))

    @property
    def follow_lobes(self) -> bool:
        return self.settings.kernel == "anisotropic" and len(self.needs.lobes) > 0

    @property
    def deep(self) -> bool:
        return len(self.needs.chains) > 0

    @property
    def options(self) -> density.KernelOptions:
        s = self.settings
        return density.KernelOptions(
            self.follow_lobes, s.rule, s.size, s.epsilon, s.guard, s.max_aspect
        )

    @property
    def gather_depth(self) -> int:
        """The limit that ``density.estimate`` has to test photons against: none if there is no
        limit, or if all gather points lie at the first vertex and the map keeps the limit."""
        return self.settings.max_depth if self.settings.max_depth > 0 and self.deep else 0


def prepare(scene, settings: Settings, hide_emitters: bool) -> Scene:
    """Read the scene. Raises Unsupported with one sentence where it cannot be rendered."""
    if mi.is_spectral:
        raise Unsupported(
            f'aniso_pm: variant "{mi.variant()}" is not supported (photons and eye paths would '
            "have to share wavelengths); choose llvm_ad_rgb, llvm_ad_mono or their cuda_ twins"
        )
    if mi.is_polarized:
        raise Unsupported(
            f'aniso_pm: variant "{mi.variant()}" is not supported (photons carry no '
            "polarisation); choose llvm_ad_rgb or another unpolarized variant"
        )
    try:
        needs = read_scene(scene)
    except ValueError as error:
        raise Unsupported(str(error)) from None
    return Scene(scene, needs, settings, hide_emitters)


def bandwidth(initial_radius: float, alpha: float, index: int) -> float:
    """Kernel radius of pass ``index`` (0-based): r² shrinks by (i + α)/(i + 1) after pass i."""
    log_area = sum(math.log((i + alpha) / (i + 1)) for i in range(1, index + 1))
    return initial_radius * math.exp(0.5 * log_area)


def stream_seed(seed: int, stream: int, index: int = 0) -> int:
    """Seed of an independent stream of random numbers, by rounds of a block cipher (TEA)."""
    return mi.sample_tea_32(mi.sample_tea_32(seed, 4 * index + stream)[0], 0x5EED)[0]


def photon_map(scene: Scene, seed: int, index: int, expected: int = 0) -> photons.PhotonMap:
    """Photon map of pass ``index``; empty where nothing in the scene could use one."""
    settings = scene.settings
    limit = settings.depth_limit
    if limit < 3 or not scene.needs.receivers or not scene.scene.emitters():
        return photons.PhotonMap(0, 0, 0, None, None)
    return photons.build_map(
        scene.scene,
        settings.photon_count,
        stream_seed(seed, _PHOTONS, index),
        min(limit - 1, 0xFFFFFFFF),
        settings.rr_depth,
        expected,
    )


def automatic_radius(scene: Scene, sensor, seed: int) -> float:
    """Bandwidth at which the median gather point has PHOTONS_PER_KERNEL photons in its disc.

    A pilot photon map and a few thousand eye paths, with seeds of their own. Every gather point
    widens its disc by factors of √2 until it holds enough pilot photons; the radius is then scaled
    to the photons of a full pass. Returns a hundredth of the scene's extent where there is nothing
    to gather, and never more than a tenth of it.
    """
    extent = float(dr.norm(scene.scene.bbox().extents()))
    pilot = scene.with_(photon_count=min(scene.settings.photon_count, _PILOT_PHOTONS))
    pilot_map = photon_map(pilot, stream_seed(seed, _PILOT), 0)
    if pilot_map.stored == 0:
        return 0.01 * extent
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(stream_seed(seed, _PILOT, 1), _PILOT_RAYS)
    ray, _ = sensor.sample_ray_differential(
        mi.Float(sensor.shutter_open()), mi.Float(0.5), sampler.next_2d(), mi.Point2f(0.5)
    )
    _, _, points = _walk(scene, sampler, ray, mi.Bool(True))
    radius = dr.full(mi.Float, 1e-5 * extent, _PILOT_RAYS)
    looking = mi.Bool(points.active)
    dr.eval(points, looking, radius)
    for _ in range(27):  # 1e-5 · √2^27 = 0.1
        kernel = density.disc(points.n, radius)
        _, count = density.estimate(pilot_map, points, kernel, radius, scene.gather_depth, looking)
        looking &= count < _PILOT_ENOUGH
        # Exact once it holds enough: the count grows with the area.
        found = dr.sqrt(_PILOT_ENOUGH / mi.Float(dr.maximum(count, 1)))
        radius = dr.select(
            looking, radius * dr.sqrt(2), dr.select(count > 0, radius * found, radius)
        )
        dr.eval(looking, radius)
        if not dr.any(looking):
            break
    lanes = dr.compress(points.active)
    if dr.width(lanes) == 0:
        return 0.01 * extent
    median = float(dr.median(dr.gather(mi.Float, radius, lanes))[0])
    more_photons = scene.settings.photon_count / pilot.settings.photon_count
    scale = math.sqrt(PHOTONS_PER_KERNEL / _PILOT_ENOUGH / more_photons)
    return min(median * scale, 0.1 * extent)


def render(scene: Scene, sensor, seed: int, spp: int, report) -> dict:
    """Render all passes into the sensor's film and return the statistics.

    spp is the total over all passes, shared evenly; 0 takes the sampler's own. report(done, total,
    text) is called after every pass. Ctrl-C ends rendering after the pass in progress; the film
    then holds the passes so far and statistics["interrupted"] is True.
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
    film.prepare([])
    radius0 = settings.initial_radius or automatic_radius(scene, sensor, seed)
    clock.lap("pilot")
    statistics = {
        "initial_radius": radius0,
        "radius_automatic": settings.initial_radius == 0,
        "photons_emitted": 0,
        "photons_stored": 0,
        "photons_rejected": 0,
        "eye_samples": 0,
        "gather_points": 0,
        "gather_points_anisotropic": 0,
        "gather_points_bounded": 0,
        "photons_gathered": 0,
        "eye_samples_rejected": 0,
        "passes": 0,
        "spp": 0,
        "interrupted": False,
    }
    stored = 0
    try:
        for i in range(settings.passes):
            radius = bandwidth(radius0, settings.alpha, i)
            map_ = photon_map(scene, seed, i, stored)
            stored = map_.stored
            statistics["photons_emitted"] += map_.emitted
            statistics["photons_stored"] += map_.stored
            statistics["photons_rejected"] += map_.rejected
            clock.lap("photons")
            share = spp // settings.passes + (i < spp % settings.passes)
            statistics["spp"] += _eye_pass(
                scene, sensor, film, map_, radius, seed, i, share, statistics, clock
            )
            statistics["radius"] = radius
            statistics["passes"] += 1
            report(i + 1, settings.passes, f"pass {i + 1}/{settings.passes}")
    except KeyboardInterrupt:
        if statistics["passes"] == 0:
            raise
        statistics["interrupted"] = True
    statistics["seconds"] = clock.seconds
    _warn(statistics)
    return statistics


def estimate_radiance(scene: Scene, map_, radius: float, sampler, ray, active):
    """(radiance, valid) along camera rays with a given map, as one computation graph."""
    L, valid, points = _walk(scene, sampler, ray, active)
    if map_.stored:
        L += _gather(scene, map_, radius, sampler, points)[0]
    return L, valid


def _walk(scene: Scene, sampler, ray, active):
    settings = scene.settings
    return eye.walk(
        scene.scene,
        sampler,
        ray,
        settings.depth_limit,
        settings.rr_depth,
        scene.hide_emitters,
        scene.follow_lobes,
        scene.deep,
        active,
    )


def _gather(scene: Scene, map_, radius, sampler, points):
    """(reflected radiance, photons, kernel follows a lobe, kernel was bounded) at gather points."""
    kernel, follows = density.kernels(points, radius, scene.options)
    L, count = density.estimate(map_, points, kernel, radius, scene.gather_depth, points.active)
    if scene.settings.edge_compensation:
        lit = points.active & (count > 0)
        L *= density.probe_surface(scene.scene, sampler, points, kernel, radius, lit)
    return L, count, follows, follows & kernel.bounded


def _eye_pass(scene, sensor, film, map_, radius, seed, index, spp, statistics, clock) -> int:
    """Trace ``spp`` eye samples a pixel against one map; returns the samples really taken."""
    size = film.crop_size()
    border = film.rfilter().border_size() if film.sample_border() else 0
    pixels = (size.x + 2 * border) * (size.y + 2 * border)
    per_wavefront = max(1, min(spp, WAVEFRONT // pixels))
    taken = wavefront = 0
    while taken < spp:
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(min(per_wavefront, spp - taken))
        count = sampler.sample_count()  # samplers may round it up
        sampler.set_samples_per_wavefront(count)
        seed_ = mi.sample_tea_32(stream_seed(seed, _EYE, index), wavefront)[0]
        sampler.seed(seed_, pixels * count)

        ray, ray_weight, position = eye.sample_rays(sensor, film, sampler, count)
        L, valid, points = _walk(scene, sampler, ray, mi.Bool(True))
        dr.eval(L, valid, points, ray_weight, position, ray.wavelengths)
        clock.lap("eye")

        # Only lanes that have a gather point go on.
        lanes = dr.compress(points.active) if map_.stored else mi.UInt32()
        if dr.width(lanes) > 0:
            found = eye.take_lanes(points, lanes)
            probes = mi.load_dict({"type": "independent"})
            probes.seed(
                mi.sample_tea_32(stream_seed(seed, _PROBE, index), wavefront)[0], dr.width(lanes)
            )
            indirect, photon_count, follows, bounded = _gather(scene, map_, radius, probes, found)
            gathered = dr.zeros(mi.Spectrum, dr.width(L))
            dr.scatter(gathered, indirect, lanes)
            # One kernel for all of it: a reduction by itself would run the whole gather again.
            dr.eval(gathered, photon_count, follows, bounded)
            L += gathered
            statistics["gather_points"] += dr.width(lanes)
            statistics["gather_points_anisotropic"] += int(dr.count(follows)[0])
            statistics["gather_points_bounded"] += int(dr.count(bounded)[0])
            statistics["photons_gathered"] += int(dr.sum(mi.Float64(photon_count))[0])
        clock.lap("gather")

        finite = dr.all(dr.isfinite(L))
        statistics["eye_samples_rejected"] += dr.width(L) - int(dr.count(finite)[0])
        _splat(film, position, dr.select(finite, L, 0) * ray_weight, valid, ray.wavelengths, count)
        clock.lap("film")
        statistics["eye_samples"] += pixels * count
        taken += count
        wavefront += 1
    return taken


def _splat(film, position, L, valid, wavelengths, spp):
    block = film.create_block()
    block.set_coalesce(block.coalesce() and spp >= 4)
    alpha = dr.select(valid, mi.Float(1), mi.Float(0))
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        channels = film.prepare_sample(
            L, wavelengths, block.channel_count(), weight=mi.Float(1), alpha=alpha
        )
    else:
        rgb = mi.Color3f(L.x) if mi.is_monochromatic else L
        channels = [rgb.x, rgb.y, rgb.z]
        if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
            channels.append(alpha)
        channels.append(mi.Float(1))
    block.put(position, channels)
    film.put_block(block)
    film.schedule_storage()
    dr.eval()


def _warn(statistics):
    emitted = statistics["photons_emitted"]
    if statistics["photons_rejected"] > 1e-3 * emitted:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: {statistics['photons_rejected']} of {emitted} light paths had a flux that "
            "is not finite and were dropped; an emitter or a BSDF returns NaN or infinity",
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
