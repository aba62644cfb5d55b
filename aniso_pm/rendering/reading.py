"""What pairs of eye paths read from two photon maps.

Light through kernels of two widths, photons met, and how light paths should be aimed at what was
read: everything that plans go by (see ``plan.Found``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import arrays
from ..map.gather_points import take
from ..map.photon_map import PhotonMap, thinned
from ..map.spectra import channel_mean
from ..transport import aim
from . import footprint
from .film import wavelengths
from .plan import LEFT, LIGHT_PATH, NARROW, WIDE, Found
from .prepared import Prepared
from .tiles import SAMPLES, Tiles

# Work of gathers where receivers are not Lambertian, each photon of which asks the BSDF, so many
# times that where they are.
_ASKS = 2.0
# Photons that a map shows to the kernels of all pairs, at the most: more of them take longer and
# tell nothing new. One gather point in so many is asked how many there would be.
_MET_BY_ALL, _ASKED = 2e6, 16
# Light paths of a map that are left at least.
_FEWEST = 2000
# Gather points that tell something, of a part of the pairs.
_TELL = 500


@dataclass(frozen=True)
class Reader:
    """scene, sensor, radius, seed: as for ``survey.decide``.

    all_tiles  of all pairs of eye paths; tiles: of those that read, pairs: their indices. Gather
               points are given of all pairs; what is read are values of those that read.
    """

    scene: Prepared
    sensor: Any
    radius: Any
    seed: int
    all_tiles: Tiles
    tiles: Tiles
    pairs: np.ndarray

    @staticmethod
    def of_all(scene: Prepared, sensor, radius, seed: int, tiles: Tiles) -> Reader:
        return Reader(scene, sensor, radius, seed, tiles, tiles, np.arange(tiles.pairs))

    def of_every_fourth(self, points) -> Reader | None:
        """None where these tell nothing: then all read."""
        found = self.all_tiles.every_fourth()
        few = found and replace(self, tiles=found[0], pairs=found[1])
        return few if few and dr.width(few._own(points).lane) >= _TELL else None

    def spread(self, light) -> np.ndarray:
        """Of pairs that read, as of all."""
        if self.tiles is self.all_tiles:
            return light
        return self.tiles.refined(light.mean(1), self.all_tiles)[:, None]

    def light(self, map_: PhotonMap, points) -> np.ndarray:
        """Of a map, through wide kernels, of each pair."""
        points = self._own(points)
        wide = self._kernels(WIDE)
        (map_,) = self._few_enough([map_], points, wide, 1.0)
        return self._gathered(wide, points, map_, self._scores(map_))[0]

    def found(self, maps, points, weigh) -> Found:
        """weigh: pairs of gathered light → weight of each pair."""
        points = self._own(points)
        kernels = [self._kernels(width) for width in (NARROW, WIDE)]
        wider = 1.0 if self.radius else (WIDE / NARROW) ** 2
        maps = self._few_enough(maps, points, kernels[0], wider)
        found: list[Any] = []
        weight = self._unweighted
        for kernel in kernels:
            if found:
                weight = weigh(0.5 * (found[0][0][0] + found[0][1][0]))
                weight = arrays.own(mi.Float, np.repeat(weight, 2 * SAMPLES).astype(np.float32))
            scores = [self._scores(map_, weight) for map_ in maps]
            pairs = zip(maps, scores, strict=True)
            found.append([self._gathered(kernel, points, *pair) for pair in pairs])
        (a, over_lobes, met), (b, _, _) = found[0]
        (wide_a, _, _), (wide_b, _, _) = found[1]
        asks = dearer(points, _ASKS)
        here = dr.zeros(mi.Float, self.lanes)
        dr.scatter_add(here, mi.Float(1), points.lane)
        met, each = asks * met, asks * pairwise(here).mean(1)
        columns = [np.nan_to_num(column.numpy(), posinf=0) for column, _ in scores]
        emitted, stored = maps[0].emitted, maps[0].stored
        return Found(
            *(a, b, wide_a, wide_b, over_lobes, met, each, emitted, stored),
            aim=_learned(maps, columns),
            met_by_any=sum(int(np.count_nonzero(column)) for column in columns),
        )

    @property
    def lanes(self) -> int:
        return self.tiles.lanes

    @property
    def _share(self) -> float:
        """Of the pairs, that read."""
        return self.tiles.pairs / self.all_tiles.pairs

    def _own(self, points):
        """Those of the pairs that read, whose eye paths are counted anew."""
        if self.tiles is self.all_tiles:
            return points
        each, others = 2 * SAMPLES, len(self.pairs)
        place = np.full(self.all_tiles.pairs, others, np.uint32)
        place[self.pairs] = np.arange(others)
        pair = dr.gather(mi.UInt32, arrays.own(mi.UInt32, place), points.lane // each)
        points = replace(points, lane=each * pair + points.lane % each)
        return take(points, dr.compress(pair < others))

    @cached_property
    def _colours(self):
        return wavelengths(self.sensor, 0.5) if mi.is_spectral else None

    @cached_property
    def _unweighted(self):
        """Weights of photons that are not scored: one kernel serves all gathers."""
        return dr.opaque(mi.Float, 0, self.lanes)

    def _kernels(self, width: float) -> tuple[Prepared, float]:
        """The scene, and a bandwidth, with which kernels have the given radius, or are as wide as
        they are told to be, in pixels."""
        if self.radius:
            return self.scene, self.radius
        size = 0.1 * self.scene.extent
        free = footprint.of(self.sensor, size, width)
        assert free  # else a radius is given (see ``pilot.settle``)
        free = replace(free, least=dr.opaque(mi.Float, 1e-6))
        return replace(self.scene, footprint=free), size

    def _few_enough(self, maps, points, kernels, wider: float):
        """Maps with as many photons as there may be for kernels whose area is ``wider`` times that
        of the given ones."""
        every = max(1, round(_ASKED * self._share))
        asked = take(points, dr.arange(mi.UInt32, -(-dr.width(points.lane) // every)) * every)
        dr.eval(asked)  # so that the kernel is that of all points
        few = self._gathered(kernels, asked, maps[0], self._scores(maps[0]))[2]
        most = float(few.mean()) * every * self.lanes * wider
        allowed = _MET_BY_ALL * self._share
        if most <= allowed:
            return maps
        left = int(maps[0].emitted * allowed / most)
        return [thinned(map_, max(left, _FEWEST)) for map_ in maps]

    def _scores(self, map_: PhotonMap, weight=None):
        """As ``Prepared.gather`` has them."""
        column = dr.opaque(mi.Float, 0, max(map_.stored, 1))
        return column, self._unweighted if weight is None else weight

    def _gathered(self, kernels, points, map_, scores):
        """(light of pairs, the part of it that has come over lobes, photons an eye path meets).
        kernels: as of ``_kernels``."""
        scene, radius = kernels
        light, over_lobes, met = (dr.zeros(mi.Float, self.lanes) for _ in range(3))
        given = map_, dr.opaque(mi.Float, radius), self.seed, points, self._colours, scores
        for found in scene.gather(*given) if map_.stored else ():
            radiance = channel_mean(found.radiance)
            dr.scatter_add(light, radiance, found.lane)
            dr.scatter_add(over_lobes, radiance, found.lane, found.follows)
            dr.scatter_add(met, mi.Float(found.photons), found.lane)
        return pairwise(light), pairwise(over_lobes), pairwise(met).mean(1)


def dearer(points, times: float) -> float:
    """``times`` where no receiver is Lambertian, 1 where all are."""
    if points.lambertian is None or not dr.width(points.lambertian):
        return 1.0
    return 1 + (times - 1) * (1 - float(dr.mean(mi.Float(points.lambertian))[0]))


def pairwise(values) -> np.ndarray:
    """Means over SAMPLES lanes, (pairs, 2), finite, double precision."""
    values = np.nan_to_num(values.numpy().astype(np.float64), posinf=0, neginf=0)
    return values.reshape(-1, 2, SAMPLES).mean(-1)


def _learned(maps, columns) -> aim.Learned | None:
    """How light paths should be aimed, from the scores of the photons of two maps."""
    scores, left = [], []
    for map_, column in zip(maps, columns, strict=True):
        if not map_.stored:
            return None
        path = map_.origins.path.numpy()
        scores.append(np.bincount(path, column, map_.emitted))
        left.append(np.bincount(path, minlength=map_.emitted))
    photons_left = np.array(left, np.float64)
    work = LIGHT_PATH + LEFT * photons_left
    numbers = np.stack([map_.origins.numbers for map_ in maps])
    return aim.learn(numbers, np.array(scores), work, photons_left)
