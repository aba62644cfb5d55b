"""Pixels that are looked at apart: those that the anisotropic kernel is for, and caustics."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.rendering import film as films
from aniso_pm.rendering.pilot import automatic_radius, camera_rays
from aniso_pm.rendering.prepared import Prepared

WHOLE, ANISOTROPIC, CAUSTIC = "whole", "anisotropic", "caustic"
# Of the light that leaves a pixel's surface, the share that makes it a caustic pixel.
CAUSTIC_SHARE = 0.25
DEFINITIONS = {
    WHOLE: "all pixels",
    ANISOTROPIC: "pixels where at least half of the eye samples gather with a kernel that follows "
    "the lobe of an anisotropic surface",
    CAUSTIC: "pixels that owe at least a quarter of their light (that of the reference) to the "
    "caustic photon map: light that came over glass, mirrors or glossy metal to a diffuse surface, "
    "or over glass and mirrors to metal",
}
# Pixels that are darker than so much of the mean have caustics by the blur of a kernel alone.
_DARK = 0.01
# A region of fewer pixels is left out: its means would say nothing.
MIN_PIXELS = 30
_SPP, _PHOTONS = 16, 400_000


def find(prepared: Prepared, sensor, reference: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Name → mask (y, x) of the regions that this picture has.

    prepared   of the anisotropic kernel with the scene's own parameters.
    reference  (y, x, 3).
    """
    masks = {WHOLE: np.ones(reference.shape[:2], bool)}
    follows, _ = _look(prepared.with_(map="global", final_gather=False), sensor, seed)
    masks[ANISOTROPIC] = follows >= 0.5
    if prepared.deep:
        _, caustic = _look(prepared.with_(map="caustic", final_gather=False), sensor, seed)
        light = _smooth(reference.mean(-1))
        dark = max(_DARK * float(light.mean()), 1e-9)
        masks[CAUSTIC] = _smooth(caustic) > CAUSTIC_SHARE * np.maximum(light, dark)
    return {name: mask for name, mask in masks.items() if mask.sum() >= MIN_PIXELS}


def _look(prepared: Prepared, sensor, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(share of the eye samples whose kernel follows a lobe, light from the photon map) of each
    pixel, by one pass."""
    prepared = prepared.with_(photon_count=_PHOTONS, passes=1, time=0.0, target_error=0.0)
    film = sensor.film()
    film.prepare([])
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(_SPP)
    spp = sampler.sample_count()
    sampler.set_samples_per_wavefront(spp)
    pixels = films.pixel_count(film)
    sampler.seed(seed, pixels * spp)
    lane = dr.arange(mi.UInt32, pixels * spp)
    ray, _, position = films.sample_rays(sensor, sampler, lane // spp, 0.5)
    corner = film.crop_offset()
    width, height = film.crop_size()
    x = np.floor(position.x.numpy()).astype(int) - corner[0]
    y = np.floor(position.y.numpy()).astype(int) - corner[1]
    # Films with a border also sample pixels outside; a wide box filter has rounded positions.
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = np.where(inside, y * width + x, width * height)

    follows, light = np.zeros(len(pixel), bool), np.zeros(len(pixel))
    map_ = prepared.photon_map(seed, 0)
    _, _, points = prepared.trace(sampler, ray)
    if points is not None and map_.stored:
        radius = prepared.settings.initial_radius or automatic_radius(
            prepared, camera_rays(sensor, seed), seed
        )
        for found in prepared.gather(map_, dr.opaque(mi.Float, radius), seed, points):
            lane = found.lane.numpy()
            # Masks of a constant have one entry only.
            some = np.broadcast_to(found.follows.numpy(), lane.shape)
            follows[lane[some]] = True
            value = np.array(found.radiance, np.float64).reshape(-1, len(lane)).mean(0)
            np.add.at(light, lane, np.where(np.isfinite(value), value, 0))
    count = width * height
    samples = np.bincount(pixel, minlength=count + 1)[:count]
    sums = (np.bincount(pixel, w, count + 1)[:count] for w in (follows, light))
    return tuple((s / np.maximum(samples, 1)).reshape(height, width) for s in sums)


def _smooth(image: np.ndarray) -> np.ndarray:
    """Means over 3 × 3 pixels: no pixel is in or out by its noise alone."""
    padded = np.pad(image, 1, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).mean((-1, -2))
