"""What pairs of eye paths tell before the first pass: how the map is best used, how many of them
should gather, how many light paths they are worth, how wide kernels should be, and which pixels
need more samples.

Two independent means a, b over k = 4 stratified samples of one pixel are read from two independent
photon maps A, B. With the gathered light g and all the rest l, weighted by 1/(mean² + floor²) so
that errors are relative,

    V_r = k⟨(l_a − l_b)²⟩/2                    of an eye path, without what it gathers,
    V_g = k⟨(g_aA − g_bA)(g_aB − g_bB)⟩/2      of a gather, were there no end of photons,
    V_gp = k⟨(g_aA − g_bA)²⟩/2 − V_g           of a gather, by the photons that it alone meets,
    V_p = ⟨(g_aA − g_aB)(g_bA − g_bB)⟩/2       of photons that a pixel's samples share.

A pass of n eye samples a pixel, of which a share q gathers, and N light paths (N_0 in the pilot)
has the variance A/n + B/N, A = V_r + V_g/q, B = N_0 (V_p + V_gp/(q n)) (the noise of eye paths
being what the film's filter leaves of it, that of shared photons the root of it), and costs
n P (C + q C_g) + N C_p, P the number of pixels. For given n, variance times cost is smallest at

    q² = C (V_g + V_gp)/(V_r C_g),        N² = n² P (C + q C_g) B / (A C_p),

and with samples of a pixel in proportion to √((V_r + (V_g + V_gp)/q)/C) there, C the work of an eye
path of that pixel. Costs are counted, not timed, so that every machine decides alike.

*Widths of kernels.* All this is gathered with kernels of several widths w, in pixels. B falls as
1/w². With D = g(8) − g(4) the product D_aA D_bB has neither the noise of eye paths nor of photons
in it: its mean is the square of what bias changes from 4 to 8 pixels. Bias grows as w² where light
is smooth and as √w in the mean around an edge; between them, as w^1.5,

    bias²(w) = ⟨D D'⟩ (w/4)³/(2^1.5 − 1)²,    so    w⁵ = 2 B₁/(3 M N) · 4³ (2^1.5 − 1)²/⟨D D'⟩

makes bias² + B₁/(w² M N) smallest after M = 32 passes. Means are taken over tiles and their
neighbours.

*Use of the map.* Where it is open (``Prepared.undecided``), the eye paths of the pilot go on as in
path tracing and tell apart what each use leaves to them (see ``eye.Parts``). The use of the least

    bias² + (A/n + B/N) (n P (C + q C_g) + N C_p) / (M n P C_0)

is chosen, its error after the work of M passes of path tracing, C_0 for each path. Path tracing
finds some caustics by rare hits that a pilot may miss, so that their variance seems small; it is
chosen only where it has found the caustics that the map holds, by many hits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import aim, arrays, eye, footprint, photons
from .allotment import LEAST
from .film import noise_share, rays_through, wavelengths
from .prepared import PILOT, Prepared, stream_seed
from .spectra import channel_mean
from .tiles import COARSE, FINE, SAMPLES, Tiles, smooth

# Widths of kernels that are compared, and the range of those that are chosen, in pixels.
_NARROW, _WIDE = 0.5 * footprint.TRIED, footprint.TRIED
_THINNEST, _WIDEST = 1.0, 32.0
# Passes that the widths are right for, however many there will be: passes add up.
_PASSES = 32
# Smallest share of eye paths that gather.
_LEAST_SHARE = 1 / 8
# Work of an eye path: of its first ray, of a vertex.
_CAMERA, _VERTEX = 0.3, 0.4
# Work of a gather, each photon it meets, a light path, a photon it leaves; an eye path is about 1.
_GATHER, _MET, _LIGHT_PATH, _LEFT = 1.2, 1 / 40, 0.6, 0.4
# Variance of an eye sample among a few hundred stratified ones, as a share of that among SAMPLES:
# 0.59 among 52 and falling, in direct light.
_STRATIFIED = 0.45
# Work of a pass that is not to be exceeded where passes may have any length: a third of a second.
_LONGEST = 1.5e6
# Rounds in which the decisions, each of which depends on the others, settle.
_ROUNDS = 4
# Variance beyond the first gathered part, where stratification does less, as such a share.
_LATER_STRATIFIED = 0.85
# Another use of the map than "global" has to promise an error smaller by so much.
_BETTER = 0.9
# Path tracing has found the caustics if it has so much of their light, by as many hits.
_FOUND, _HITS = 0.7, 64


@dataclass(frozen=True)
class Survey:
    """What was found.

    use          of the map (see ``eye``).
    errors       relative MSE that each use promises, by its name, where there was a choice; None
                 where path tracing has not found what the map holds.
    each         eye samples of a pixel in a pass, in the mean: fewer than asked for where light
                 paths would make a pass too long.
    share        of the eye paths of each pixel that should gather (see ``eye.Thinning``).
    light_paths  of a pass; 0 where photons do not show.
    counts       samples of each pixel (see ``allotment``), or None: all alike.
    widths       of the kernels of each pixel, in pixels.
    aim          of light paths (aim.Learned), or None: they begin evenly.
    map, points  a map of that use, and where eye paths read it (GatherPoints); None where none do.
    """

    use: str
    errors: dict[str, float | None]
    each: int
    share: np.ndarray
    light_paths: float
    counts: np.ndarray | None
    widths: np.ndarray
    aim: aim.Learned | None
    map: photons.PhotonMap | None
    points: Any


def look(
    scene: Prepared, sensor, radius, seed: int, each: int, exactly: bool, maps, light_paths
) -> Survey:
    """Trace the pairs, and decide.

    scene        where the use of the map is open: with ``chosen`` "survey".
    radius       bandwidth of the first pass, world units, if it is given: all kernels have it.
    each, exactly  see ``pilot.settle``.
    maps         two independent photon maps of as many light paths, or empty ones.
    light_paths  of a pass if they are given, else 0 or None.
    """
    tiles = Tiles.of(sensor, COARSE)
    seen = _trace(scene, sensor, tiles, seed)
    read = partial(_read, scene, sensor, radius, seed, tiles)
    filtered = noise_share(sensor.film())
    longest = math.inf if exactly or scene.settings.passes else _LONGEST
    # What uses are compared after: the work of path tracing, whatever the length of their passes.
    total = _PASSES * each * tiles.pixels * float(seen.work.mean())
    given = radius is None, light_paths, filtered, total, seen.work
    decide = partial(_Plan.of, longest, each, tiles, *given)
    if seen.points is None or not min(map_.stored for map_ in maps):
        use = scene.use
        if use == "survey":
            use = "none" if scene.photons_are_dispensable else "caustic"
        light = seen.own + seen.later + (0 if use == "caustic" else seen.caustic)
        weight = tiles.weight(light)
        plan = decide(use, weight, _within(light, light, weight))
        return plan.survey({}, pixel_counts(plan, scene, sensor, seed), None, None)
    own = seen.own
    weigh = lambda gathered: tiles.weight(own + gathered)  # noqa: E731
    if scene.use != "survey":
        found = read(maps, seen.points, weigh)
        weight = weigh(found.light)
        plan = decide(scene.use, weight, _within(own, own, weight), found)
        return plan.survey({}, pixel_counts(plan, scene, sensor, seed), maps[0], seen.points)

    # --- The global map ---
    first = eye.take(seen.points, dr.compress(~seen.points.caustic))
    found = read(maps, first, weigh)
    weight = weigh(found.light)
    v_own = _within(own, own, weight)
    best = decide("global", weight, v_own, found, work=seen.early)
    errors: dict[str, float | None] = {"global": best.error}
    chosen, limit = (maps[0], first), _BETTER * best.error

    # --- The other ones, unless their eye paths alone are too dear ---
    light = own + seen.later
    more = _within(light, light, weight) - v_own
    bare = decide("none", weight, v_own, later=more)
    if bare.error < limit:
        maps = [photons.caustics(map_) for map_ in maps]
        any_ = replace(seen.points, caustic=dr.full(mi.Bool, False, dr.width(seen.points.lane)))
        found = read(maps, any_, lambda _: weight)
        plan = decide("caustic", weight, v_own, found, later=more)
        errors["caustic"] = plan.error
        if plan.error < limit:
            best, chosen, limit = plan, (maps[0], any_), plan.error
        if scene.photons_are_dispensable:
            errors["none"] = None
            if _has_found(seen.caustic, found.light, weight):
                light = light + seen.caustic
                more = _within(light, light, weight) - v_own
                plan = decide("none", weight, v_own, later=more)
                errors["none"] = plan.error
                if plan.error < limit:
                    best, chosen = plan, (None, None)
    return best.survey(errors, pixel_counts(best, scene, sensor, seed), *chosen)


def pixel_counts(plan: _Plan, scene: Prepared, sensor, seed: int) -> np.ndarray | None:
    """Samples of each pixel: where they differ most is a matter of a few pixels, so that many eye
    paths look, and nothing is gathered."""
    if plan.each * LEAST < 1:
        return None
    fine, coarse = Tiles.of(sensor, FINE), plan.tiles
    sampler, ray, lane = _pairs(sensor, fine, seed, 5)
    # Kernels as those of the passes, which leave gather points.
    scene = replace(scene, chosen=plan.use, footprint=footprint.of(sensor, 1.0))
    few = dr.full(mi.Float, _LEAST_SHARE, fine.lanes)
    thinning = eye.Thinning.of(few, seed, lane, lane) if plan.share.min() < 1 else None
    L, _, _ = scene.trace(sampler, ray, thinning=thinning)
    own = _pairwise(channel_mean(L) + dr.zeros(mi.Float, fine.lanes))
    weight = fine.weight(own + coarse.refined(plan.gathered, fine)[:, None])
    noise = _STRATIFIED * _within(own, own, weight) + coarse.refined(plan.noise, fine)
    work = coarse.refined(smooth(coarse.grid(plan.path_work)).ravel(), fine)
    return fine.counts(noise, work, plan.each)


def _pairs(sensor, tiles: Tiles, seed: int, stream: int):
    """(sampler, rays, lanes) of the pairs of all tiles."""
    sampler = mi.load_dict({"type": "owen_sobol"})
    lane = dr.arange(mi.UInt32, tiles.lanes)
    sampler.begin(stream_seed(seed, PILOT, stream), lane // SAMPLES, lane % SAMPLES)
    ray, _ = rays_through(sensor, sampler, tiles.positions(sensor, seed, sampler), 0.5)
    return sampler, ray, lane


@dataclass(frozen=True)
class _Seen:
    """What the pairs of eye paths saw, as (pairs, 2) but work, early (pairs).

    own      light that every use leaves to eye paths.
    later    light that the global map has, the caustic one not.
    caustic  light that both have.
    work     of the whole path; early: of the path up to its first gathered part.
    points   where they gather, or None.
    """

    own: np.ndarray
    later: np.ndarray
    caustic: np.ndarray
    work: np.ndarray
    early: np.ndarray
    points: Any


def _trace(scene: Prepared, sensor, tiles: Tiles, seed: int) -> _Seen:
    sampler, ray, _ = _pairs(sensor, tiles, seed, 3)
    scene = replace(scene, footprint=footprint.of(sensor, 1.0))  # measures paths
    vertices, early = (dr.zeros(mi.Float, tiles.lanes) for _ in range(2))

    def see(lane, depth, si, bsdf, bs, active, scattered):
        dr.scatter_add(vertices, mi.Float(1), lane, active)
        dr.scatter_add(early, mi.Float(1), lane, active & ~scattered)

    room = 3 * tiles.lanes if scene.use == "survey" else 0
    L, _, points = scene.trace(sampler, ray, room, see=see)
    later = caustic = mi.Float(0)
    if isinstance(L, eye.Parts):
        L, later, caustic = L.radiance, L.later, L.caustic
    none = dr.zeros(mi.Float, tiles.lanes)
    later, caustic = _pairwise(later + none), _pairwise(caustic + none)
    own = _pairwise(channel_mean(L) + none) - later
    work, early = (_VERTEX * _pairwise(v).mean(1) + _CAMERA for v in (vertices, early))
    return _Seen(own, later, caustic, work, early, points)


@dataclass(frozen=True)
class _Found:
    """What a use of the map gives to the pairs: light from map a, b through narrow kernels and
    through wide ones, (pairs, 2); photons that an eye path meets, gather points that it leaves;
    light paths and photons of a map; how to aim those."""

    a: np.ndarray
    b: np.ndarray
    wide_a: np.ndarray
    wide_b: np.ndarray
    met: float
    points: float
    emitted: int
    stored: int
    aim: aim.Learned | None

    @property
    def light(self) -> np.ndarray:
        return 0.5 * (self.wide_a + self.wide_b)


def _read(scene: Prepared, sensor, radius, seed: int, tiles: Tiles, maps, points, weigh) -> _Found:
    """weigh: pairs of gathered light → weight of each pair."""
    colours = wavelengths(sensor, 0.5) if mi.is_spectral else None
    lanes = tiles.lanes
    found: list[Any] = []
    for width in (_NARROW, _WIDE) if not radius else (1.0, 1.0):
        size = radius
        if not radius:  # kernels as wide as they are told to be
            size = 0.1 * scene.extent
            free = footprint.of(sensor, size, width)
            free = replace(free, least=dr.opaque(mi.Float, 1e-6))
            scene = replace(scene, footprint=free)
        scores: list[Any] = [None, None]
        if found:
            weight = weigh(0.5 * (found[0][0][0] + found[0][1][0]))
            weight = arrays.own(mi.Float, np.repeat(weight, 2 * SAMPLES).astype(np.float32))
            scores = [(dr.zeros(mi.Float, max(map_.stored, 1)), weight) for map_ in maps]
        gather = partial(_gathered, scene, size, seed, points, colours, lanes)
        found.append([gather(*each) for each in zip(maps, scores, strict=True)])
    (a, met), (b, _) = found[0]
    (wide_a, _), (wide_b, _) = found[1]
    each = dr.width(points.lane) / lanes
    learned = _learned(maps, [column for column, _ in scores])
    return _Found(a, b, wide_a, wide_b, met, each, maps[0].emitted, maps[0].stored, learned)


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
    work = _LIGHT_PATH + _LEFT * photons_left
    numbers = np.stack([map_.origins.numbers for map_ in maps])
    return aim.learn(numbers, np.array(scores), work, photons_left)


def _has_found(caustic, light, weight) -> bool:
    """Have eye paths found the caustics of the map, by enough hits?"""
    root = np.sqrt(weight)[:, None]
    hits, there = (caustic * root).ravel(), float((light * root).mean())
    squares = float((hits**2).sum())
    enough = squares == 0 or float(hits.sum()) ** 2 >= _HITS * squares
    return enough and float(hits.mean()) >= _FOUND * there


@dataclass(frozen=True)
class _Plan:
    """The best that can be done with a use of the map; see the module's head and ``Survey``. share
    and widths are those of tiles, error is the relative MSE, work that of a pass; path_work (of an
    eye path), gathered (light) and noise (variance of gathers) are those of pairs."""

    tiles: Tiles
    use: str
    each: int
    share: np.ndarray
    light_paths: float
    widths: np.ndarray
    error: float
    work: float
    path_work: np.ndarray
    gathered: np.ndarray
    noise: np.ndarray
    aim: aim.Learned | None = None

    @staticmethod
    def of(longest: float, each: int, *given, **more) -> _Plan:
        """Of passes whose work is ``longest`` at most, if they can be that short."""
        plan = _Plan._of(each, *given, **more)
        if plan.work > longest and each > 1:
            plan = _Plan._of(max(1, int(each * longest / plan.work)), *given, **more)
        return plan

    @staticmethod
    def _of(
        each: int,
        tiles: Tiles,
        choose: bool,
        light_paths: int | None,
        filtered: float,
        total: float,
        whole,
        use: str,
        weight,
        v_own,
        found: _Found | None = None,
        later: Any = 0.0,
        work: Any = None,
    ) -> _Plan:
        """
        choose  widths of kernels.
        filtered  variance of eye paths that the film leaves (``film.noise_share``).
        total   work after which ``error`` is that of the mean over all passes.
        whole   work of path tracing.
        v_own   of an eye path, without what it gathers; later: what it has more because it goes on
                beyond the first gathered part.
        found   in the map; None: there is none.
        work    of an eye path; None: of path tracing.
        """
        work = whole if work is None else work
        v_eye = _STRATIFIED * float(v_own.mean()) + _LATER_STRATIFIED * float(np.mean(later))
        v_eye = filtered * max(v_eye, 0.0)
        if found is None:
            pass_ = each * tiles.pixels * float(work.mean())
            error = v_eye / each * pass_ / total
            share = np.full(1, 1.0 if use == "none" else _LEAST_SHARE)
            nothing = np.zeros(len(whole))
            return _Plan(
                tiles, use, each, share, 0.0, np.ones(1), error, pass_, work, nothing, nothing
            )

        # --- Variances and bias² of each pair, relative to the light there ---
        a, b, emitted = found.a, found.b, found.emitted
        v_gather = tiles.trusted(filtered * _within(a, b, weight))
        shared, alone = _of_photons(found.wide_a - found.wide_b, weight)
        mid_shared, mid_alone = _of_photons(a - b, weight)
        alone, mid_alone = filtered * alone, filtered * mid_alone
        # Neighbours have these in common, as far as kernels reach: a few pixels.
        root = math.sqrt(filtered)
        shared, mid_shared = root * shared, root * mid_shared
        v_alone, v_shared = tiles.trusted(mid_alone), tiles.trusted(mid_shared)
        changed_a, changed_b = found.wide_a - a, found.wide_b - b
        change = changed_a[:, 0] * changed_b[:, 1] + changed_a[:, 1] * changed_b[:, 0]
        change *= 0.5 * weight

        # --- Decisions ---
        share, paths = np.ones(len(whole)), float(light_paths or 5 * emitted)
        narrow, wide = (_NARROW, _WIDE) if choose else (1.0, 1.0)
        widths = np.full(len(whole), narrow)
        eye_work = float(work.mean())
        light, met = _LIGHT_PATH + _LEFT * found.stored / emitted, found.met
        aimed = 1.0
        if found.aim:
            light, met = light * found.aim.work, met * found.aim.photons
            aimed = found.aim.variance
        for _ in range(_ROUNDS):
            own = 1 / (share * each)
            # A pass that a pixel reads less than once counts when it is read.
            often = np.maximum(1, own)
            b_1 = wide**2 * (often * shared + own * alone)
            b_1 += narrow**2 * (often * mid_shared + own * mid_alone)
            b_1 *= 0.5 * emitted * aimed
            if choose:
                widths = _widths(tiles, b_1, change, _PASSES * paths).ravel()
            area = float(np.mean((widths / narrow) ** 2))
            thinner = (narrow / widths) ** 2 * aimed * emitted / paths
            gather = _GATHER * found.points + _MET * met * area * paths / emitted
            if v_eye > 0:
                worth = eye_work / (v_eye * gather)
                share = np.sqrt((v_gather + v_alone * thinner) * worth)
                # Less than one in a pass: then a gather is alone with what it would share.
                more = np.sqrt((v_gather + (v_alone + v_shared) * thinner) * worth)
                share = np.where(share * each < 1, np.minimum(more, 1 / each), share)
            # In steps, so that machines whose arithmetic differs in the last digits agree.
            share = np.ceil(16 * np.clip(share, _LEAST_SHARE, 1)) / 16
            eye_noise = max(v_eye + float((v_gather / share).mean()), 1e-30)
            gather *= float(share.mean())
            by_photons = max(0.0, float((b_1 / widths**2).mean()))
            if not light_paths:
                costs = (eye_work + gather) / (light * tiles.pixels)
                paths = max(each * tiles.pixels * math.sqrt(by_photons * costs / eye_noise), 1.0)
        pass_ = each * tiles.pixels * (eye_work + gather) + paths * light
        error = (eye_noise / each + by_photons / paths) * pass_ / total
        error += _bias2(float(np.mean(change * (widths / _NARROW) ** 3))) if choose else 0.0
        noise = (v_gather + v_alone * thinner) / (filtered * share)
        return _Plan(
            tiles,
            use,
            each,
            share,
            paths,
            widths,
            error,
            pass_,
            work + gather,
            found.light.mean(1),
            noise,
            found.aim,
        )

    def survey(self, errors, counts, map_, points) -> Survey:
        share, widths = (
            self.tiles.to_pixels(self.tiles.grid(v)) if v.size > 1 else v
            for v in (self.share, self.widths)
        )
        return Survey(
            self.use,
            errors,
            self.each,
            share,
            self.light_paths,
            counts,
            widths,
            self.aim,
            map_,
            points,
        )


def _bias2(change: float) -> float:
    """From the square of what changes between kernels of 4 and 8 pixels."""
    return max(change, 0.0) / (2**1.5 - 1) ** 2


def _widths(tiles: Tiles, photons, change, light_paths: float) -> np.ndarray:
    """Of kernels in each tile, in pixels (see the module's head). photons: B₁ of each pair."""
    photons = smooth(tiles.grid(photons))
    photons = np.maximum(photons, 1e-3 * max(float(photons.mean()), 1e-30))
    error = tiles.uncertainty(change)
    bias2 = (2**1.5 - 1) ** -2 * (np.maximum(smooth(tiles.grid(change)), 0) + error)
    fifth = 2 * photons * _NARROW**3 / (3 * light_paths * np.maximum(bias2, 1e-30))
    return np.clip(fifth**0.2, _THINNEST, _WIDEST)


def _gathered(scene, radius, seed, points, colours, lanes, map_, scores):
    """(light of pairs, photons an eye path meets)."""
    light, met = dr.zeros(mi.Float, lanes), 0.0
    r = dr.opaque(mi.Float, radius)
    for found in scene.gather(map_, r, seed, points, colours, scores) if map_.stored else ():
        dr.scatter_add(light, channel_mean(found.radiance), found.lane)
        met += float(dr.sum(mi.Float(found.photons))[0]) / lanes
    return _pairwise(light), met


def _pairwise(values) -> np.ndarray:
    """Means over SAMPLES lanes, (pairs, 2), finite, double precision."""
    values = np.nan_to_num(values.numpy().astype(np.float64), posinf=0, neginf=0)
    return values.reshape(-1, 2, SAMPLES).mean(-1)


def _within(v, w, weight):
    """Of a single sample: half the product of differences within each pair."""
    return 0.5 * SAMPLES * weight * (v[:, 0] - v[:, 1]) * (w[:, 0] - w[:, 1])


def _of_photons(difference, weight):
    """Variance by photons, of what all samples of a pixel share and of what each has alone.
    difference: between the two maps."""
    shared = 0.5 * weight * difference[:, 0] * difference[:, 1]
    return shared, SAMPLES * (0.25 * weight * (difference**2).sum(1) - shared)
