"""The bandwidth of the first pass, from a small pilot of photons and eye paths.

Every eye path that reaches a receiver widens its disc by factors of √2 until it holds enough pilot
photons. A median of these radii, scaled to the photons of a full pass, is the bandwidth: robust
from a coin to a stadium, because it looks at the densities where the camera does. Each point counts
by the light that it receives: a caustic on a dark floor sets the bandwidth, not the floor.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from . import density
from .film import one_each, rays_through, wavelengths
from .prepared import PILOT, Prepared, stream_seed

# Photons inside the cut kernel that the bandwidth aims at, in the median of the light.
PHOTONS_PER_KERNEL = 60
# Range of the automatic number of light paths: the most take half a gigabyte.
FEWEST, MOST = 10_000, 5_000_000
# Light paths and eye paths of the pilot, and photons that a disc must hold to be measured.
_PATHS, _RAYS, _ENOUGH = 50_000, 4096, 16
# Smallest share of eye paths that gather, smallest number of them in a pixel and pass, and the work
# of an eye path and the photons of a pass without gathering.
_LEAST_SHARE, _GATHERS_PER_PIXEL, _REST = 1 / 8, 2, 1.5
# Range of radii as shares of the scene's extent: 1e-5 · √2^27 = 0.1.
_SMALLEST, LARGEST, _STEPS = 1e-5, 0.1, 27


def camera_rays(sensor, seed: int):
    """Rays through random points of the film's crop window."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(stream_seed(seed, PILOT, 2), _RAYS)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, _ = sensor.sample_ray(
        mi.Float(sensor.shutter_open()), mi.Float(0.5), sampler.next_2d(), aperture
    )
    return one_each(ray, _RAYS)


def settle(scene: Prepared, sensor, seed: int, samples: int, count=None, radius=None):
    """(light paths per pass, bandwidth of the first pass): what is not given is chosen.

    samples: eye samples of a pass.
    """
    if not count or not radius:
        rays = camera_rays(sensor, seed)
        count = count or automatic_photon_count(scene, rays, seed, samples)
        radius = radius or automatic_radius(scene.with_(photon_count=count), rays, seed)
    return count, radius


def share_of_gathers(scene: Prepared, sensor, radius: float, seed: int, samples: int) -> float:
    """Share of the eye paths that gather (see ``eye.Thinning``), from pairs of eye paths in pixels.

    With the variance V_g of what is gathered and V_r of all the rest within a pixel, and the work
    C_g of a gather and C_r of everything else for an eye path, variance times work,
    (V_r + V_g/q)(C_r + q C_g), is smallest at q² = V_g C_r / (V_r C_g). Work is counted.

    samples: eye samples of a pixel in a pass, of which four at least shall gather.
    """
    least = max(_LEAST_SHARE, min(1.0, _GATHERS_PER_PIXEL / samples))
    if least == 1:
        return 1.0
    colours = wavelengths(sensor, 0.5) if mi.is_spectral else None
    pilot = scene.with_(photon_count=_PATHS)
    map_ = pilot.photon_map(stream_seed(seed, PILOT), 0, wavelengths=colours)
    if map_.stored == 0:
        return 1.0
    # A pilot's photons are too few for the bandwidth of the pass.
    wider = math.sqrt(max(1.0, scene.settings.photon_count / map_.emitted))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(stream_seed(seed, PILOT, 3), _RAYS)
    size = sensor.film().crop_size()
    corner = mi.Point2f(mi.ScalarPoint2f(sensor.film().crop_offset()))
    lane = dr.arange(mi.UInt32, _RAYS // 2)
    a, b = mi.sample_tea_32(lane, stream_seed(seed, PILOT, 4))
    pixel = mi.Point2f(a % size[0], b % size[1])
    pixel = dr.gather(mi.Point2f, pixel, dr.arange(mi.UInt32, _RAYS) // 2)
    ray, _ = rays_through(sensor, sampler, corner + pixel + sampler.next_2d(), 0.5)
    L, _, points = scene.trace(sampler, ray)
    if points is None:
        return 1.0
    light = dr.zeros(mi.Float, _RAYS)
    photons = 0.0
    r = dr.opaque(mi.Float, wider * radius)
    for found in scene.gather(map_, r, seed, points, colours):
        dr.scatter_add(light, dr.mean(found.radiance), found.lane)
        photons += float(dr.sum(mi.Float(found.photons))[0])
    gathered = np.nan_to_num(light.numpy()).reshape(-1, 2)
    rest = np.nan_to_num(dr.mean(L).numpy() + np.zeros(_RAYS)).reshape(-1, 2)
    level = (gathered + rest).mean(1)
    weight = 1 / (level**2 + (0.1 * np.quantile(level, 0.5)) ** 2 + 1e-30)
    within = lambda v: float(np.mean(weight * (v[:, 0] - v[:, 1]) ** 2))  # noqa: E731
    V_g, V_r = within(gathered), within(rest)
    C_g = dr.width(points.lane) / _RAYS * (0.8 + photons / dr.width(points.lane) / 40)
    share = math.sqrt(V_g * _REST / (V_r * C_g)) if V_r > 0 else 1.0
    # In steps, so that machines whose arithmetic differs in the last digits agree.
    return min(16, math.ceil(16 * max(least, share))) / 16


def _weighted_median(radii) -> float:
    """Median with weights 1/r² (proportional to the density of photons, hence to the light that
    the point receives): half of the light is estimated at smaller radii, half at larger ones."""
    radii = np.sort(radii)
    light = np.cumsum(radii.astype(np.float64) ** -2)
    return float(radii[np.searchsorted(light, 0.5 * light[-1])])


def photons_per_path(scene: Prepared, seed: int) -> float:
    """Photons that a light path leaves in the mean."""
    map_ = scene.with_(photon_count=_PATHS).photon_map(stream_seed(seed, PILOT), 0)
    return map_.stored / max(map_.emitted, 1)


def automatic_radius(scene: Prepared, rays, seed: int) -> float:
    """Bandwidth (world units) at which kernels hold PHOTONS_PER_KERNEL photons in the median.

    rays: any number of camera rays. The seeds are the pilot's own. Returns a hundredth of the
    scene's extent where there is nothing to gather, and never more than a tenth of it.
    """
    extent = scene.extent
    pilot = scene.with_(photon_count=min(scene.settings.photon_count, _PATHS))
    map_ = pilot.photon_map(stream_seed(seed, PILOT), 0)
    if map_.stored == 0:
        return 0.01 * extent
    count = dr.width(rays)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(stream_seed(seed, PILOT, 1), count)
    _, _, points = scene.trace(sampler, rays)
    if points is None:
        return 0.01 * extent
    count = dr.width(points.lane)
    radius = dr.full(mi.Float, _SMALLEST * extent, count)
    looking = dr.full(mi.Bool, True, count)
    dr.eval(looking, radius)
    for _ in range(_STEPS):
        disc = density.disc(points.n, radius)
        _, found = density.estimate(map_, points, disc, radius, scene.gather_depth, looking)
        # The number of photons grows with the area, which makes the last step exact.
        exact = radius * dr.sqrt(_ENOUGH / mi.Float(dr.maximum(found, 1)))
        enough = looking & (found >= _ENOUGH)
        looking &= ~enough
        radius = dr.select(enough, exact, dr.select(looking, radius * math.sqrt(2), radius))
        dr.eval(looking, radius)
        if not dr.any(looking):
            break
    median = _weighted_median(radius.numpy())
    more_photons = scene.settings.photon_count / pilot.settings.photon_count
    return min(median * math.sqrt(PHOTONS_PER_KERNEL / _ENOUGH / more_photons), LARGEST * extent)


def automatic_photon_count(scene: Prepared, rays, seed: int, eye_samples: int) -> int:
    """Light paths per pass that are about as much work as its eye samples, two digits.

    Work is counted, not timed, so that every machine chooses the same: one unit for an eye sample
    and for each of its gather points, one for a light path and for each photon that it leaves. Both
    means are the pilot's.

    rays: camera rays. eye_samples: of a pass. Returns FEWEST where there is nothing to gather.
    """
    pilot = scene.with_(photon_count=_PATHS)
    map_ = pilot.photon_map(stream_seed(seed, PILOT), 0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(stream_seed(seed, PILOT, 1), dr.width(rays))
    _, _, points = scene.trace(sampler, rays)
    if points is None or map_.stored == 0:
        return FEWEST
    gathers = dr.width(points.lane) / dr.width(rays)
    balanced = eye_samples * (1 + gathers) / (1 + map_.stored / map_.emitted)
    digits = 1 - int(math.log10(balanced))
    return int(min(max(round(balanced, digits), FEWEST), MOST))
