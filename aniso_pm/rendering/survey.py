"""What pairs of eye paths tell before the first pass: how the map is best used, how many of them
should gather, how many light paths they are worth, how wide kernels should be, and which pixels
need more samples.

How variances become decisions is told in ``plan``.

*Use of the map.* Where it is open (``Prepared.undecided``), the eye paths of the pilot go on as in
path tracing and tell apart what each use leaves to them (see ``survey_parts``). That of the least

    bias² + (A/n + B/N) (n P (C + q C_g) + N C_p) / (M n P C_0)

is chosen, its error after the work of M passes of path tracing, C_0 for each path. Path tracing
finds some caustics by rare hits that a pilot may miss, so that their variance seems small; it is
chosen only where it has found the caustics that the map holds, their variance taken to be the
larger the fewer hits they were, or where these are next to none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import arrays
from ..map.gather_points import take
from ..map.photon_map import PhotonMap, caustics, thinned
from ..map.spectra import channel_mean
from ..transport import aim
from ..transport.survey_parts import Parts
from ..transport.thinning import Thinning
from ..transport.uses import Use
from . import footprint
from .allotment import FEW
from .film import noise_share, rays_through, wavelengths
from .plan import (
    LEAST_SHARE,
    LEFT,
    LIGHT_PATH,
    NARROW,
    PASSES,
    STRATIFIED,
    WIDE,
    Found,
    Plan,
    within,
)
from .prepared import PILOT, PILOT_FINE, PILOT_PAIRS, Prepared, stream_seed
from .tiles import COARSE, FINE, SAMPLES, Tiles, smooth

# Work of an eye path: of its first ray, of a vertex.
_CAMERA, _VERTEX = 0.3, 0.4
# The same vertices of paths that go on after they have left gather points.
_GOING_ON = 1.15
# Work where receivers are not Lambertian, so many times that where they are: of gathers, each
# photon of which asks the BSDF, and of eye paths, which tell its parts apart.
_ASKS_GATHER, _ASKS_PATH = 2.0, 1.5
# Work of a pass that is not to be exceeded where passes may have any length (see ``Plan.of``): a
# third of a second.
_LONGEST = 1.5e6
# Photons that a map shows to the widest kernels of all pairs, at the most: more of them take longer
# and tell nothing new. One gather point in so many is asked how many there would be.
_MET_BY_ALL, _ASKED = 2e6, 16
# Light paths of a map that are left at least.
_FEWEST = 2000
# The caustic map has to promise an error smaller than the global one by so much.
_BETTER = 0.9
# Path tracing has found the caustics if it has so much of their light, by as many hits, or if they
# are less than such a share of the picture's light. With fewer than the last number of hits their
# variance is taken to be larger than it looks.
_FOUND, _FEWEST_HITS, _NOTHING, _HITS = 0.7, 8, 1e-4, 64


@dataclass(frozen=True)
class Survey:
    """What was found.

    use          of the map (see ``uses``).
    errors       relative MSE that each use promises, by its name, where there was a choice; None
                 where path tracing has not found what the map holds.
    each         eye samples of a pixel in a pass, in the mean: fewer than asked for where light
                 paths would make a pass too long.
    share        of the eye paths of each pixel that should gather (see ``thinning``).
    light_paths  of a pass; 0 where photons do not show.
    counts       samples of each pixel (see ``allotment``), or None: all alike.
    widths       of the kernels of each pixel, in pixels.
    aim          of light paths (aim.Learned), or None: they begin evenly.
    lobes        part of the error that kernels make which follow lobes.
    map, points  a map of that use, and where eye paths read it (GatherPoints); None where none do.
    """

    use: Use
    errors: dict[str, float | None]
    each: int
    share: np.ndarray
    light_paths: float
    counts: np.ndarray | None
    widths: np.ndarray
    aim: aim.Learned | None
    lobes: float
    map: PhotonMap | None
    points: Any


@dataclass(frozen=True)
class Seen:
    """What the pairs of eye paths saw, as (pairs, 2) but work, early (pairs).

    own      light that every use leaves to eye paths.
    later    light that the global map has, the caustic one not.
    caustic  light that both have.
    work     of the whole path; early: of the path up to its first gathered part.
    points   where they gather, or None.
    tiles    of the pairs.
    """

    own: np.ndarray
    later: np.ndarray
    caustic: np.ndarray
    work: np.ndarray
    early: np.ndarray
    points: Any
    tiles: Tiles


def look(scene: Prepared, sensor, seed: int) -> Seen:
    """Trace the pairs. scene: as for ``decide``."""
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

    room = 3 * tiles.lanes if scene.use == "survey" else 0
    L, _, points = scene.trace(sampler, ray, room, watch=watch)
    later = caustic = mi.Float(0)
    if isinstance(L, Parts):
        L, later, caustic = L.radiance, L.later, L.caustic
    none = dr.zeros(mi.Float, tiles.lanes)
    later, caustic = _pairwise(later + none), _pairwise(caustic + none)
    own = _pairwise(channel_mean(L) + none) - later
    work, early = (_VERTEX * _pairwise(v).mean(1) + _CAMERA for v in (vertices, early))
    return Seen(own, later, caustic, work, early, points, tiles)


def decide(
    scene: Prepared,
    sensor,
    radius,
    seed: int,
    each: int,
    seen: Seen,
    maps,
    light_paths,
) -> Survey:
    """What follows from what the pairs saw and what they read.

    scene        where the use of the map is open: with ``chosen`` "survey".
    radius       bandwidth of the first pass, world units, if it is given: all kernels have it.
    each         see ``pilot.settle``.
    seen         by the pairs (see ``look``).
    maps         two independent photon maps of as many light paths, or empty ones.
    light_paths  of a pass if they are given, else 0 or None.
    """
    tiles = seen.tiles
    longest = _LONGEST if scene.settings.endless else math.inf
    # What uses are compared after: the work of path tracing, whatever the length of their passes.
    total = PASSES * each * tiles.pixels * float(seen.work.mean())
    plan_of = partial(
        Plan.of,
        longest,
        each,
        tiles=tiles,
        choose=radius is None,
        light_paths=light_paths,
        filtered=noise_share(sensor.film()),
        total=total,
        whole=seen.work,
    )
    read = partial(_read, scene, sensor, radius, seed, tiles)
    pilot = _Pilot(scene, sensor, seed, seen, maps, read, plan_of)
    if seen.points is None or not min(map_.stored for map_ in maps):
        return pilot.nothing_to_read()
    return pilot.best_use() if scene.use == "survey" else pilot.given_use()


@dataclass(frozen=True)
class _Pilot:
    """What was seen, and how plans follow from it.

    scene, sensor, seed, seen, maps  as for ``decide``.
    read     ``_read`` of these, a function of maps, points and weigh.
    plan_of  ``Plan.of`` with what is the same for every use.
    """

    scene: Prepared
    sensor: Any
    seed: int
    seen: Seen
    maps: Any
    read: Callable[..., Found]
    plan_of: Callable[..., Plan]

    def nothing_to_read(self) -> Survey:
        """No path reads a map, or a map is empty."""
        seen, use = self.seen, self.scene.use
        if use == "survey":
            use = "none" if self.scene.photons_are_dispensable else "caustic"
        light = seen.own + seen.later + (0 if use == "caustic" else seen.caustic)
        weight = seen.tiles.weight(light)
        plan = self.plan_of(use=use, weight=weight, v_own=within(light, light, weight))
        return self._survey(plan, {}, None, None)

    def given_use(self) -> Survey:
        """The use of the map is not open."""
        found, plan_of, _ = self._of_reading(self.seen.points)
        plan = plan_of(use=self.scene.use, found=found)
        return self._survey(plan, {}, self.maps[0], self.seen.points)

    def best_use(self) -> Survey:
        """That which promises the least error."""
        seen = self.seen
        first = take(seen.points, dr.compress(~seen.points.later))
        found, plan_of, weight = self._of_reading(first)
        asks = _dearer(seen.points, _ASKS_PATH)
        best = plan_of(use="global", found=found, work=asks * seen.early)
        errors: dict[str, float | None] = {"global": best.error}
        read: tuple[Any, Any] = self.maps[0], first

        # --- The other ones, unless their eye paths alone are too dear ---
        light = seen.own + seen.later
        later = within(light, light, weight) - within(seen.own, seen.own, weight)
        if plan_of(use="none", later=later).error >= best.error:
            return self._survey(best, errors, *read)
        maps = [caustics(map_) for map_ in self.maps]
        found = self.read(maps, seen.points, lambda _: weight)
        work = _GOING_ON * asks * seen.work
        plan = plan_of(use="caustic", found=found, later=later, work=work)
        errors["caustic"] = plan.error
        if plan.error < _BETTER * best.error:
            best, read = plan, (maps[0], seen.points)
        if self.scene.photons_are_dispensable:
            errors["none"] = None
            doubt = _doubt(seen.caustic, found.light, weight)
            if doubt:
                all_ = light + seen.caustic
                of_caustics = within(all_, all_, weight) - within(light, light, weight)
                plan = plan_of(use="none", later=later + doubt * of_caustics)
                errors["none"] = plan.error
                if plan.error < best.error:
                    best, read = plan, (None, None)
        return self._survey(best, errors, *read)

    def _of_reading(self, points) -> tuple[Found, Callable[..., Plan], Any]:
        """(what is found at the points, plans, weight of each pair) that go by all light there."""
        own, weigh = self.seen.own, self.seen.tiles.weight
        found = self.read(self.maps, points, lambda gathered: weigh(own + gathered))
        weight = weigh(own + found.light)
        plan_of = partial(self.plan_of, weight=weight, v_own=within(own, own, weight))
        return found, plan_of, weight

    def _survey(self, plan: Plan, errors, map_, points) -> Survey:
        share, widths = (
            plan.tiles.to_pixels(plan.tiles.grid(v)) if v.size > 1 else v
            for v in (plan.share, plan.widths)
        )
        return Survey(
            use=plan.use,
            errors=errors,
            each=plan.each,
            share=share,
            light_paths=plan.light_paths,
            counts=pixel_counts(plan, self.scene, self.sensor, self.seed),
            widths=widths,
            aim=plan.aim,
            lobes=plan.lobes,
            map=map_,
            points=points,
        )


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
    own = _pairwise(channel_mean(L) + dr.zeros(mi.Float, fine.lanes))
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


def _read(scene: Prepared, sensor, radius, seed: int, tiles: Tiles, maps, points, weigh) -> Found:
    """weigh: pairs of gathered light → weight of each pair."""
    colours = wavelengths(sensor, 0.5) if mi.is_spectral else None
    lanes = tiles.lanes
    kernels = [_kernels(scene, sensor, radius, width) for width in (NARROW, WIDE)]
    asked = take(points, dr.arange(mi.UInt32, -(-dr.width(points.lane) // _ASKED)) * _ASKED)
    dr.eval(asked)  # so that the kernel is that of all points
    # Scored without weight: one kernel serves all gathers.
    unweighted = dr.opaque(mi.Float, 0, lanes)
    few = _gathered(
        *kernels[0], seed, asked, colours, lanes, maps[0], _scores(maps[0], unweighted)
    )[2]
    most = float(few.mean()) * _ASKED * lanes * (1 if radius else (WIDE / NARROW) ** 2)
    if most > _MET_BY_ALL:
        left = int(maps[0].emitted * _MET_BY_ALL / most)
        maps = [thinned(map_, max(left, _FEWEST)) for map_ in maps]

    found: list[Any] = []
    weight = unweighted
    for scene_, size in kernels:
        if found:
            weight = weigh(0.5 * (found[0][0][0] + found[0][1][0]))
            weight = arrays.own(mi.Float, np.repeat(weight, 2 * SAMPLES).astype(np.float32))
        scores = [_scores(map_, weight) for map_ in maps]
        gather = partial(_gathered, scene_, size, seed, points, colours, lanes)
        found.append([gather(*each) for each in zip(maps, scores, strict=True)])
    (a, over_lobes, met), (b, _, _) = found[0]
    (wide_a, _, _), (wide_b, _, _) = found[1]
    dearer = _dearer(points, _ASKS_GATHER)
    here = dr.zeros(mi.Float, lanes)
    dr.scatter_add(here, mi.Float(1), points.lane)
    met, each = dearer * met, dearer * _pairwise(here).mean(1)
    learned = _learned(maps, [column for column, _ in scores])
    emitted, stored = maps[0].emitted, maps[0].stored
    return Found(a, b, wide_a, wide_b, over_lobes, met, each, emitted, stored, learned)


def _dearer(points, times: float) -> float:
    """``times`` where no receiver is Lambertian, 1 where all are."""
    if points.lambertian is None or not dr.width(points.lambertian):
        return 1.0
    return 1 + (times - 1) * (1 - float(dr.mean(mi.Float(points.lambertian))[0]))


def _scores(map_: PhotonMap, weight):
    """As ``Prepared.gather`` has them."""
    return dr.opaque(mi.Float, 0, max(map_.stored, 1)), weight


def _kernels(scene: Prepared, sensor, radius, width: float) -> tuple[Prepared, float]:
    """The scene, and a bandwidth, with which kernels have the given radius, or are as wide as they
    are told to be, in pixels."""
    if radius:
        return scene, radius
    size = 0.1 * scene.extent
    free = footprint.of(sensor, size, width)
    assert free  # else a radius is given (see ``pilot.settle``)
    return replace(scene, footprint=replace(free, least=dr.opaque(mi.Float, 1e-6))), size


def _learned(maps, columns) -> aim.Learned | None:
    """How light paths should be aimed, from the scores of the photons of two maps."""
    scores, left = [], []
    for map_, column in zip(maps, columns, strict=True):
        if not map_.stored:
            return None
        path, score = map_.origins.path.numpy(), np.nan_to_num(column.numpy(), posinf=0)
        scores.append(np.bincount(path, score, map_.emitted))
        left.append(np.bincount(path, minlength=map_.emitted))
    photons_left = np.array(left, np.float64)
    work = LIGHT_PATH + LEFT * photons_left
    numbers = np.stack([map_.origins.numbers for map_ in maps])
    return aim.learn(numbers, np.array(scores), work, photons_left)


def _doubt(caustic, light, weight) -> float | None:
    """By what to multiply the variance that caustics are seen to have in path tracing: what rarely
    hits is noisier than a few hits tell. None where too little was found to tell; 1 where there is
    next to nothing. caustic: found by eye paths; light: of the map."""
    root = np.sqrt(weight)[:, None]
    hits, there = (caustic * root).ravel(), float((light * root).mean())
    if there < _NOTHING:
        return 1.0
    squares = float((hits**2).sum())
    as_many = float(hits.sum()) ** 2 / squares if squares else 0.0
    if as_many < _FEWEST_HITS or float(hits.mean()) < _FOUND * there:
        return None
    return max(1.0, _HITS / as_many)


def _gathered(scene, radius, seed, points, colours, lanes, map_, scores):
    """(light of pairs, the part of it that has come over lobes, photons an eye path meets)."""
    light, over_lobes, met = (dr.zeros(mi.Float, lanes) for _ in range(3))
    r = dr.opaque(mi.Float, radius)
    for found in scene.gather(map_, r, seed, points, colours, scores) if map_.stored else ():
        radiance = channel_mean(found.radiance)
        dr.scatter_add(light, radiance, found.lane)
        dr.scatter_add(over_lobes, radiance, found.lane, found.follows)
        dr.scatter_add(met, mi.Float(found.photons), found.lane)
    return _pairwise(light), _pairwise(over_lobes), _pairwise(met).mean(1)


def _pairwise(values) -> np.ndarray:
    """Means over SAMPLES lanes, (pairs, 2), finite, double precision."""
    values = np.nan_to_num(values.numpy().astype(np.float64), posinf=0, neginf=0)
    return values.reshape(-1, 2, SAMPLES).mean(-1)
