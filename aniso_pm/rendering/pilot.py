"""The bandwidth of the first pass, from a small pilot of photons and eye paths.

Every eye path that reaches a receiver widens its disc by factors of 2 until it holds enough pilot
photons. A median of these radii, scaled to the photons of a full pass, is the bandwidth: robust
from a coin to a stadium, because it looks at the densities where the camera does. Each point counts
by the light that it receives: a caustic on a dark floor sets the bandwidth, not the floor.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..map import density
from ..map.gather_points import take
from ..map.photon_map import EMPTY
from ..transport import shadows
from ..transport.focus import Focus, find
from . import footprint, pairs, survey
from .film import one_each, sample_ray, wavelengths
from .prepared import PILOT, PILOT_CAMERA, PILOT_EYE, PILOT_SHADOWS, Prepared, stream_seed
from .settled import Settled

# Photons inside the cut kernel that the bandwidth aims at, in the median of the light.
PHOTONS_PER_KERNEL = 60
# Range of the automatic number of light paths: the most take half a gigabyte.
FEWEST, MOST = 10_000, 5_000_000
# Light paths and eye paths of the pilot, and photons that a disc must hold to be measured.
_PATHS, _RAYS, _ENOUGH = 50_000, 4096, 16
# Light paths for which the bandwidth is chosen before their number is.
USUAL = 250_000
# Range of radii as shares of the scene's extent: 1.2e-5 · 2^13 = 0.1.
_SMALLEST, LARGEST, _STEPS = 1.2e-5, 0.1, 14


def camera_rays(sensor, seed: int):
    """Rays through random points of the film's crop window."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, stream_seed(seed, PILOT, PILOT_CAMERA)), _RAYS)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    ray, _ = sample_ray(sensor, time, mi.Float(0.5), sampler.next_2d(), aperture)
    return one_each(ray, _RAYS)


def look_for_shadows(scene: Prepared, sensor) -> Prepared:
    """The same scene with emitters drawn by what is seen of them. The same for every seed, since
    passes of several renderings are merged."""
    if scene.direct is None:
        return scene
    rays = camera_rays(sensor, 0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, stream_seed(0, PILOT, PILOT_SHADOWS)), _RAYS)
    return replace(scene, direct=shadows.look(scene.scene, scene.direct, sampler, rays))


def settle(scene: Prepared, sensor, seed: int, each: int) -> Settled:
    """What the parameters do not give is chosen, by a function of scene, parameters and seed.

    each  eye samples of a pixel in a pass; where passes go on without end, there may be fewer.
    """
    colours = wavelengths(sensor, 0.5) if mi.is_spectral else None
    count, radius = scene.settings.photon_count, scene.settings.initial_radius
    if scene.undecided:
        scene = replace(scene, chosen="survey")
    seen = pairs.look(scene, sensor, seed)
    focus = _focus(scene, seen.points)
    scene = scene.focused(focus)
    pilot = scene.with_(photon_count=_PATHS)
    maps = [
        pilot.photon_map(stream_seed(seed, PILOT), k, 0, colours, remember=True)
        if scene.needs_map
        else EMPTY
        for k in (0, 1)
    ]
    tried = radius
    if not radius and maps[0].stored and footprint.of(sensor, 1.0) is None:
        # Nothing says how wide pixels are: one radius for all.
        usual = scene.with_(photon_count=count or USUAL)
        tried = automatic_radius(usual, camera_rays(sensor, seed), seed, maps[0])
    found = survey.decide(scene, sensor, tried or None, seed, each, seen, maps, count)
    count = count or min(max(_rounded(found.light_paths), FEWEST), MOST)
    # Aimed photons are closer together where they show.
    worth = count / found.aim.variance if found.aim else count
    radius = radius or radius_at(found.points, found.map, scene, worth)
    return Settled(
        use=found.use,
        errors=found.errors,
        count=count,
        radius=radius,
        each=found.each,
        share=found.share.astype(np.float32),
        counts=None if found.counts is None else found.counts.astype(np.uint32),
        widths=found.widths.astype(np.float32),
        aim=found.aim,
        lobes=found.lobes,
        rare=found.rare,
        focus=focus if found.use != "none" else None,
    )


def _focus(scene: Prepared, points) -> Focus | None:
    """The part of the scene that light from outside is to meet: where eye paths gather, be it
    behind glass or in a mirror. points: GatherPoints or None."""
    if points is None or not (scene.emission and scene.emission.from_outside):
        return None
    return find(np.array(points.p).T.astype(np.float64), 0.5 * scene.extent)


def _gather_points(scene: Prepared, rays, seed: int):
    """GatherPoints of these camera rays, or None."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, stream_seed(seed, PILOT, PILOT_EYE)), dr.width(rays))
    return scene.trace(sampler, rays)[2]


def _rounded(number: float) -> int:
    """To two digits, so that machines whose arithmetic differs in the last ones agree."""
    return int(round(number, 1 - int(math.log10(number)))) if number >= 1 else 0


def _weighted_median(radii) -> float:
    """Median with weights 1/r² (proportional to the density of photons, hence to the light that
    the point receives): half of the light is estimated at smaller radii, half at larger ones."""
    radii = np.sort(radii)
    light = np.cumsum(radii.astype(np.float64) ** -2)
    return float(radii[np.searchsorted(light, 0.5 * light[-1])])


def photons_per_path(scene: Prepared, seed: int) -> float:
    """Photons that a light path leaves in the mean."""
    # Not replayed: nobody may have seen yet whether Dr.Jit can record this scene.
    pilot = scene.thawed().with_(photon_count=_PATHS)
    map_ = pilot.photon_map(stream_seed(seed, PILOT), 0)
    return map_.stored / max(map_.emitted, 1)


def automatic_radius(scene: Prepared, rays, seed: int, map_=None) -> float:
    """As :func:`radius_at`, for what any number of camera rays see. map_: a pilot's, if there is
    one."""
    if map_ is None:
        pilot = scene.with_(photon_count=min(scene.settings.photon_count, _PATHS))
        map_ = pilot.photon_map(stream_seed(seed, PILOT), 0)
    points = _gather_points(scene, rays, seed) if map_.stored else None
    return radius_at(points, map_, scene, scene.settings.photon_count)


@dr.syntax
def _widened(photons_in, radius):
    """Radii at which discs hold _ENOUGH photons, from the smallest ones on."""
    looking = dr.full(mi.Bool, True, dr.width(radius))
    step = mi.UInt32(0)
    while looking:
        found = photons_in(radius, looking)
        # The number of photons grows with the area, which makes the last step exact.
        exact = radius * dr.sqrt(_ENOUGH / mi.Float(dr.maximum(found, 1)))
        enough = looking & (found >= _ENOUGH)
        step += 1
        looking &= ~enough & (step < _STEPS)
        radius = dr.select(enough, exact, dr.select(looking, 2 * radius, radius))
    return radius


def radius_at(points, map_, scene: Prepared, light_paths: float) -> float:
    """Bandwidth (world units) at which kernels hold PHOTONS_PER_KERNEL photons of so many light
    paths, in the median over gather points (GatherPoints or None).

    Returns a hundredth of the extent of the scene (or of its part that light from outside is to
    meet) where there is nothing to gather (1 where there are no shapes), and never more than a
    tenth of it.
    """
    extent = min(scene.extent, 2 * scene.focus.radius) if scene.focus else scene.extent
    if points is None or not map_.stored:
        return 0.01 * extent if math.isfinite(extent) else 1.0
    count = dr.width(points.lane)
    if count > _RAYS:
        points = take(points, dr.arange(mi.UInt32, _RAYS) * (count // _RAYS))
        count = _RAYS
    smallest = dr.opaque(mi.Float, _SMALLEST * extent)

    def photons_in(radius, active):
        disc = density.disc(points.n, radius)
        return density.estimate(map_, points, disc, radius, scene.gather_depth, active)[1]

    radius = _widened(photons_in, smallest + dr.zeros(mi.Float, count))
    median = _weighted_median(radius.numpy())
    more_photons = light_paths / map_.emitted
    return min(median * math.sqrt(PHOTONS_PER_KERNEL / _ENOUGH / more_photons), LARGEST * extent)
