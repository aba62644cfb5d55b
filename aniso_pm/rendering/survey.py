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
larger the fewer hits they were, or where these are next to none. Nor is a map chosen that misses
what eye paths have met, where they may do without. What the other uses leave to eye
paths bounds their errors from below: where path tracing comes close to that, no map is read. Else
every fourth pair reads maps to compare uses, and all of them that of the use that is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

from ..map.gather_points import take
from ..map.photon_map import PhotonMap, caustics
from ..transport import aim
from ..transport.uses import Use
from .film import noise_share
from .pairs import Seen, pixel_counts
from .plan import PASSES, Found, Plan, within
from .prepared import Prepared
from .reading import Reader, dearer

# The same vertices of paths that go on after they have left gather points.
_GOING_ON = 1.15
# Work of eye paths where receivers are not Lambertian, whose parts they tell apart, so many times
# that where they are.
_ASKS = 1.5
# Work of a pass that is not to be exceeded where passes may have any length (see ``Plan.of``): a
# third of a second.
_LONGEST = 1.5e6
# The caustic map has to promise an error smaller than the global one by so much, path tracing one
# smaller than maps.
_BETTER, _BETTER_ALONE = 0.75, 0.9
# Path tracing has found the caustics if it has so much of their light, by as many hits, or if they
# are less than such a share of the picture's light. With fewer than the last number of hits their
# variance is taken to be larger than it looks.
_FOUND, _FEWEST_HITS, _NOTHING, _HITS = 0.7, 8, 1e-4, 64
# Maps miss light that eye paths have met by so many hits if one of them has less than such a share
# of it, or if they show so few photons, which tell neither noise nor width.
_OFTEN, _MISSED, _FEW_PHOTONS = 16, 0.5, 64
# Path tracing comes close where it promises so many times the error that is left to eye paths, at
# the most: with what photons cost, and with their noise, errors were 1.9 to 50 times as large.
_CLOSE = 1.5
# Chance with which eye paths meet lamps in glossy caustics, about. Photons for these are worth
# their time where such a part of the variance goes: they make passes dearer by a tenth or two.
_CHANCE, _LITTLE = 0.1, 0.03


@dataclass(frozen=True)
class Survey:
    """What was found.

    use          of the map (see ``uses``).
    errors       relative MSE that each use promises, by its name, where there was a choice; None
                 where path tracing has not found what the map holds, or maps miss what it found.
    each         eye samples of a pixel in a pass, in the mean: fewer than asked for where light
                 paths would make a pass too long.
    share        of the eye paths of each pixel that should gather (see ``thinning``).
    light_paths  of a pass; 0 where photons do not show.
    counts       samples of each pixel (see ``allotment``), or None: all alike.
    widths       of the kernels of each pixel, in pixels.
    aim          of light paths (aim.Learned), or None: they begin evenly.
    rare         glossy caustics are photons' (``Decisions.rare``).
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
    rare: tuple[str, ...]
    lobes: float
    map: PhotonMap | None
    points: Any


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
    seen         by the pairs (see ``pairs.look``).
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
        alpha=scene.settings.alpha,
    )
    reader = Reader.of_all(scene, sensor, radius, seed, tiles)
    pilot = _Pilot(scene, sensor, seed, seen, maps, reader, plan_of).with_or_without_glossy()
    if pilot.seen.points is None or not min(map_.stored for map_ in maps):
        return pilot.nothing_to_read()
    return pilot.best_use() if scene.use == "survey" else pilot.given_use()


@dataclass(frozen=True)
class _Use:
    """A use of the map, and how pairs read it.

    maps, points  two maps, and where these are read.
    weigh  gathered light → weight, of each pair.
    work, later  of all pairs, as for ``Plan._of``.
    """

    use: Use
    maps: Any
    points: Any
    weigh: Callable[..., Any]
    work: Any = None
    later: Any = 0.0


@dataclass(frozen=True)
class _Pilot:
    """What was seen, and how plans follow from it.

    scene, sensor, seed, seen, maps  as for ``decide``.
    reader   of photon maps where the pairs gather.
    plan_of  ``Plan.of`` with what is the same for every use.
    """

    scene: Prepared
    sensor: Any
    seed: int
    seen: Seen
    maps: Any
    reader: Reader
    plan_of: Callable[..., Plan]

    def with_or_without_glossy(self) -> _Pilot:
        """The same, without photons for glossy caustics where they would lessen the variance of eye
        paths by little. What meets lamps by chance has the variance L²/chance; L is asked of a map,
        because a pilot's paths may not have met any."""
        seen, scene = self.seen, self.scene
        if not scene.rare or not scene.glossy_is_dispensable:
            return self
        light = seen.own + seen.later + seen.caustic
        weight = seen.tiles.weight(light)
        points = seen.points and take(seen.points, dr.compress(seen.points.glossy))
        if points is not None and dr.width(points.lane) and self.maps[0].stored:
            held = self.reader.light(self.maps[0], points)
            saved = float((weight[:, None] * held**2).mean()) / _CHANCE
            if saved >= _LITTLE * float(within(light, light, weight).mean()):
                return self
        others = seen.points and dr.compress(~seen.points.glossy)
        points = take(seen.points, others) if seen.points and dr.width(others) else None
        own, caustic = seen.own + seen.glossy, seen.caustic - seen.glossy
        seen = replace(seen, own=own, caustic=caustic, points=points)
        scene = replace(scene, rare=())
        return replace(self, seen=seen, scene=scene, reader=replace(self.reader, scene=scene))

    def nothing_to_read(self) -> Survey:
        """No path reads a map, or a map is empty."""
        seen, use = self.seen, self.scene.use
        if use == "survey":
            use = "none" if self.scene.photons_are_dispensable else "caustic"
        light = seen.own + seen.later + (0 if use == "caustic" else seen.caustic)
        weight = seen.tiles.weight(light)
        plan = self.plan_of(use=use, weight=weight, v_own=within(light, light, weight))
        return self._survey(plan, {})

    def given_use(self) -> Survey:
        """The use of the map is not open."""
        read = _Use(self.scene.use, self.maps, self.seen.points, self._weight)
        return self._survey(self._plan(self.reader, read)[0], {}, read)

    def best_use(self) -> Survey:
        """That which promises the least error by what every fourth pair reads, which tells uses
        apart as well as all do; these read for that use alone."""
        if self.scene.photons_are_dispensable and (plan := self._without_reading()):
            return self._survey(plan, {"none": plan.error})
        few = self.reader.of_every_fourth(self.seen.points)
        plan, errors, read = self._compared(few or self.reader)
        if few and read:
            plan = self._plan(self.reader, read)[0]
        return self._survey(plan, errors, read)

    def _compared(self, reader: Reader) -> tuple[Plan, dict[str, float | None], _Use | None]:
        """(best plan, the errors that uses promise, what is to be read for the best)."""
        seen = self.seen
        asks = dearer(seen.points, _ASKS)
        errors: dict[str, float | None] = {}
        first = take(seen.points, dr.compress(~seen.points.later))
        at_first = _Use("global", self.maps, first, self._weight, asks * seen.early)
        best, found, weight = self._plan(reader, at_first)
        read: _Use | None = at_first
        errors["global"] = best.error
        lights = [reader.spread(light) for light in found.maps]
        if self._misses(seen.later + seen.caustic, lights, found.met_by_any, weight):
            errors["global"], best = None, replace(best, error=math.inf)

        # --- The other ones, unless their eye paths alone are too dear ---
        light = seen.own + seen.later
        all_ = light + seen.caustic
        own, going_on, whole = (within(v, v, weight) for v in (seen.own, light, all_))
        alone = partial(self.plan_of, use="none", weight=weight, v_own=own)
        if alone(later=going_on - own).error >= best.error:
            return best, errors, read
        maps, work = [caustics(map_) for map_ in self.maps], _GOING_ON * asks * seen.work
        all_the_way = _Use("caustic", maps, seen.points, lambda _: weight, work, going_on - own)
        plan, found, _ = self._plan(reader, all_the_way)
        errors["caustic"] = plan.error
        lights = [reader.spread(light) for light in found.maps]
        if self._misses(seen.caustic, lights, found.met_by_any, weight):
            errors["caustic"] = None
        elif plan.error < _BETTER * best.error:
            best, read = plan, all_the_way
        if self.scene.photons_are_dispensable:
            errors["none"] = None
            doubt = _doubt(seen.caustic, lights, weight)
            if doubt:
                plan = alone(later=going_on - own + doubt * (whole - going_on))
                errors["none"] = plan.error
                if plan.error < _BETTER_ALONE * best.error:
                    best, read = plan, None
        return best, errors, read

    def _without_reading(self) -> Plan | None:
        """Path tracing, if photons could not better it by much were there no end of them, and were
        they free."""
        seen, asks = self.seen, dearer(self.seen.points, _ASKS)
        light = seen.own + seen.later
        all_ = light + seen.caustic
        weight = seen.tiles.weight(all_)
        own, going_on, whole = (within(v, v, weight) for v in (seen.own, light, all_))
        plan_of = partial(self.plan_of, weight=weight, v_own=own)
        caustic = plan_of(use="caustic", work=_GOING_ON * asks * seen.work, later=going_on - own)
        left = min(plan_of(use="global", work=asks * seen.early).error, caustic.error)

        def close_if_maps_hold(light) -> Plan | None:
            doubt = _doubt(seen.caustic, [light], weight)
            if not doubt:
                return None
            plan = plan_of(use="none", later=going_on - own + doubt * (whole - going_on))
            return plan if plan.error < _CLOSE * left else None

        # A map is asked only where its answer decides.
        if not close_if_maps_hold(seen.caustic):
            return None
        return close_if_maps_hold(self.reader.light(caustics(self.maps[0]), seen.points))

    def _misses(self, light, lights, met_by_any: int, weight) -> bool:
        """Have the two maps too little of ``light``, which eye paths have met, to be chosen? Not
        where photons are needed. lights: of each map, met_by_any: as of ``Found``."""
        if not self.scene.photons_are_dispensable:
            return False
        mean, as_many = _hits(light, weight)
        if mean < _NOTHING or as_many < _OFTEN:
            return False
        least = min(_hits(each, weight)[0] for each in lights)
        return met_by_any < _FEW_PHOTONS or least < _MISSED * mean

    def _weight(self, gathered):
        """Of each pair, by all light there."""
        return self.seen.tiles.weight(self.seen.own + gathered)

    def _plan(self, reader: Reader, read: _Use) -> tuple[Plan, Found, Any]:
        """(the best that can be done with a use of the map, what its pairs find, weight of each of
        all pairs)."""
        own, pairs = self.seen.own, reader.pairs

        def weigh(gathered):
            return read.weigh(reader.spread(gathered))

        found = reader.found(read.maps, read.points, lambda gathered: weigh(gathered)[pairs])
        weight = weigh(found.light)
        plan = self.plan_of(
            tiles=reader.tiles,
            whole=self.seen.work[pairs],
            work=None if read.work is None else read.work[pairs],
            weight=weight[pairs],
            v_own=within(own, own, weight),
            found=found,
            use=read.use,
            later=read.later,
        )
        return plan, found, weight

    def _survey(self, plan: Plan, errors, read: _Use | None = None) -> Survey:
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
            rare=self.scene.rare if plan.use != "none" else (),
            lobes=plan.lobes,
            map=read.maps[0] if read else None,
            points=read.points if read else None,
        )


def _hits(light, weight) -> tuple[float, float]:
    """Of light of pairs: (its mean, relative, and how many hits of equal light are as uneven)."""
    hits = (light * np.sqrt(weight)[:, None]).ravel()
    squares = float((hits**2).sum())
    return float(hits.mean()), float(hits.sum()) ** 2 / squares if squares else 0.0


def _doubt(caustic, maps, weight) -> float | None:
    """By what to multiply the variance that caustics are seen to have in path tracing: what rarely
    hits is noisier than a few hits tell. None where too little was found to tell; 1 where there is
    next to nothing. caustic: found by eye paths; maps: light of each."""
    mean, as_many = _hits(caustic, weight)
    held = [_hits(light, weight)[0] for light in maps]
    # Many hits tell more than a photon that one map has by luck.
    there = min(held) if as_many >= _OFTEN else sum(held) / len(held)
    if there < _NOTHING:
        return 1.0
    if as_many < _FEWEST_HITS or mean < _FOUND * there:
        return None
    return max(1.0, _HITS / as_many)
