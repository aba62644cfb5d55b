"""What stratified pairs of eye paths see before the first pass: a few of them all that a survey
goes by, many of them which pixels need more samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..map.spectra import channel_mean
from ..transport.survey_parts import Parts
from ..transport.thinning import Thinning
from . import footprint
from .allotment import FEW
from .film import rays_through
from .plan import LEAST_SHARE, STRATIFIED, Plan, within
from .prepared import PILOT, PILOT_FINE, PILOT_PAIRS, Prepared, stream_seed
from .reading import pairwise
from .tiles import COARSE, FINE, SAMPLES, Tiles, smooth

# Work of an eye path: of its first ray, of a vertex.
_CAMERA, _VERTEX = 0.3, 0.4


@dataclass(frozen=True)
class Seen:
    """What the pairs of eye paths saw, as (pairs, 2) but work, early (pairs).

    own      light that every use leaves to eye paths.
    later    light that the global map has, the caustic one not.
    caustic  light that both have; glossy: the part of it that is glossy caustics.
    work     of the whole path; early: of the path up to its first gathered part.
    points   where they gather, or None.
    tiles    of the pairs.
    """

    own: np.ndarray
    later: np.ndarray
    caustic: np.ndarray
    glossy: np.ndarray
    work: np.ndarray
    early: np.ndarray
    points: Any
    tiles: Tiles


def look(scene: Prepared, sensor, seed: int) -> Seen:
    """Trace the pairs. scene: as for ``survey.decide``."""
    tiles = Tiles.of(sensor, COARSE)
    sampler, ray, _, _ = _pairs(sensor, tiles, seed, PILOT_PAIRS)
    scene = replace(scene, footprint=footprint.of(sensor, 1.0))  # measures paths
    vertices = early = mi.Float(0)

    def watch():
        nonlocal vertices, early
        vertices, early = (dr.zeros(mi.Float, tiles.lanes) for _ in range(2))

        def see(lane, depth, si, bsdf, bs, active, scattered):
            dr.scatter_add(vertices, mi.Float(1), lane, active)
            dr.scatter_add(early, mi.Float(1), lane, active & ~scattered)

        return see

    # In closed rooms paths leave many: when there is no room, all of them are traced again.
    room = 8 * tiles.lanes if scene.use == "survey" else 0
    L, _, points = scene.trace(sampler, ray, room, watch=watch)
    later = caustic = glossy = mi.Float(0)
    if isinstance(L, Parts):
        L, later, caustic, glossy = L.radiance, L.later, L.caustic, L.glossy
    none = dr.zeros(mi.Float, tiles.lanes)
    later, caustic, glossy = (pairwise(v + none) for v in (later, caustic, glossy))
    own = pairwise(channel_mean(L) + none) - later
    work, early = (_VERTEX * pairwise(v).mean(1) + _CAMERA for v in (vertices, early))
    return Seen(own, later, caustic + glossy, glossy, work, early, points, tiles)


def pixel_counts(plan: Plan, scene: Prepared, sensor, seed: int) -> np.ndarray | None:
    """Samples of each pixel: where they differ most is a matter of a few pixels, so that many eye
    paths look, and nothing is gathered."""
    if plan.each < FEW:
        return None
    fine, coarse = Tiles.of(sensor, FINE), plan.tiles
    sampler, ray, pixel, sample = _pairs(sensor, fine, seed, PILOT_FINE)
    # Traced as in the passes, which replay what is recorded here.
    scene = replace(scene, chosen=plan.use, lobes_matter=scene.worth_following(plan.lobes))
    scene = replace(scene, footprint=footprint.of(sensor, 1.0))
    few = dr.opaque(mi.Float, LEAST_SHARE, fine.lanes // SAMPLES)
    thinning = None
    if plan.share.min() < 1:
        each = dr.opaque(mi.UInt32, SAMPLES, fine.lanes)
        place = sample + dr.opaque(mi.UInt32, 0)  # not the sampler's own variable: as in passes
        thinning = Thinning.of_pass(few, seed, pixel, place, each)
    L, _, _ = scene.trace(sampler, ray, thinning=thinning)
    own = pairwise(channel_mean(L) + dr.zeros(mi.Float, fine.lanes))
    weight = fine.weight(own + coarse.refined(plan.gathered, fine)[:, None])
    noise = STRATIFIED * within(own, own, weight) + coarse.refined(plan.noise, fine)
    work = coarse.refined(smooth(coarse.grid(plan.path_work)).ravel(), fine)
    return fine.counts(noise, work, plan.each)


def _pairs(sensor, tiles: Tiles, seed: int, stream: int):
    """(sampler, rays, half of a pair as a pixel of its own, sample in it) of all tiles' pairs."""
    sampler = mi.load_dict({"type": "owen_sobol"})
    lane = dr.arange(mi.UInt32, tiles.lanes)
    pixel, sample = lane // SAMPLES, lane % SAMPLES
    sampler.begin(stream_seed(seed, PILOT, stream), pixel, sample)
    ray, _ = rays_through(sensor, sampler, tiles.positions(sensor, seed, sampler), 0.5)
    dr.eval(ray)  # as in passes
    return sampler, ray, pixel, sample
