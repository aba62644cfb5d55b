"""A film cut into tiles, each of which stands for its pixels: means over neighbours, and what
follows from them for every pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .allotment import LEAST, MOST, in_proportion
from .film import border, sampled_size
from .prepared import PILOT, PILOT_PIXELS, stream_seed

# Tiles of a picture at most: those that read the photon map, and those that see what eye paths
# find by themselves; stratified samples of each half of the pair in a tile's pixel.
COARSE, FINE, SAMPLES = 4096, 20_000, 4
# Pairs of smaller films: a single one tells nothing.
_FEWEST = 256
# A tile's numbers count by so much, the rest is the picture's mean.
_TRUST = 0.85
# Brightness below which errors count as absolute: of the median, and of the 90th percentile.
_FLOOR = 0.25, 0.1
# Uneven samples have to promise so much less work for the same error: they are a tenth slower.
_WORTH = 1.1


@dataclass(frozen=True)
class Tiles:
    """Squares of ``edge`` pixels that cover a film, with a random pixel and its pair in each. Where
    pixels are few, ``split`` × ``split`` tiles, hence pairs, stand for the same one."""

    edge: int
    width: int
    height: int
    split: int = 1

    @staticmethod
    def of(sensor, most: int) -> Tiles:
        width, height = sampled_size(sensor.film())
        edge = max(1, math.ceil(math.sqrt(width * height / most)))
        return Tiles(edge, width, height, math.ceil(math.sqrt(_FEWEST / (width * height))))

    @property
    def across(self) -> int:
        return -(-self.width // self.edge) * self.split

    @property
    def down(self) -> int:
        return -(-self.height // self.edge) * self.split

    @property
    def pairs(self) -> int:
        return self.across * self.down

    @property
    def lanes(self) -> int:
        return 2 * SAMPLES * self.pairs

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def every_fourth(self) -> tuple[Tiles, np.ndarray] | None:
        """(Every second tile across and down, as tiles twice as wide; their indices). None where a
        quarter of the pairs tells nothing."""
        if self.pairs < 4 * _FEWEST:
            return None
        chosen = self.grid(np.arange(self.pairs))[::2, ::2].ravel()
        return replace(self, edge=2 * self.edge), chosen

    def positions(self, sensor, seed: int, sampler):
        """On the film, of all lanes, tiles row by row."""
        film = sensor.film()
        tile = dr.arange(mi.UInt32, self.lanes) // (2 * SAMPLES)
        a, b = mi.sample_tea_32(tile, dr.opaque(mi.UInt32, stream_seed(seed, PILOT, PILOT_PIXELS)))
        column, row = tile % self.across // self.split, tile // self.across // self.split
        x = dr.minimum(column * self.edge + a % self.edge, self.width - 1)
        y = dr.minimum(row * self.edge + b % self.edge, self.height - 1)
        # Unsigned numbers, which have no place left of the first pixel.
        corner = mi.ScalarPoint2f(film.crop_offset()) - border(film)
        return mi.Point2f(mi.Float(x), mi.Float(y)) + corner + sampler.next_2d()

    def grid(self, pairs) -> np.ndarray:
        """Values of pairs as (down, across)."""
        return pairs.reshape(self.down, self.across)

    def weight(self, light) -> np.ndarray:
        """1/(mean² + floor²) of each pair. The floor is a quarter of the median, or a tenth of what
        a tenth of the picture exceeds: in a dark room behind a door ajar half of the pixels are so
        dark that beside the bright ones nobody sees their noise."""
        level = smooth(self.grid(light.mean(-1)))
        lit = level[level > 0]
        floor = max(np.quantile(lit, (0.5, 0.9)) * _FLOOR) if lit.size else 1.0
        return (1 / (level**2 + floor**2)).ravel()

    def counts(self, noise, work, each: int) -> np.ndarray | None:
        """Samples of each pixel, in proportion to √(variance/work), from those of pairs; None where
        even ones are as good: rare bright samples say little about where the next ones will be."""
        noise, work = self.grid(noise), self.grid(work)
        if noise.size < 2 or not noise.mean() > 0:
            return None
        # What every other tile says, tried on the tiles between them.
        chess = np.indices(noise.shape).sum(0) % 2
        gains = []
        for known in (chess, 1 - chess):
            share = _allotted(smooth(noise * known, 3) / smooth(1.0 * known, 3), work)
            tried = known == 0
            cost = (noise / share)[tried].mean() * (work * share).mean()
            gains.append(noise[tried].mean() * work.mean() / cost)
        if not np.mean(gains) > _WORTH:
            return None
        return in_proportion(self.to_pixels(_allotted(smooth(noise, 3), work)), each)

    def trusted(self, noise) -> np.ndarray:
        """Variance of each tile, from those of pairs, which may be negative."""
        return _trusted(smooth(self.grid(noise))).ravel()

    def uncertainty(self, pairs) -> np.ndarray:
        """Half a standard error of smoothed means of pairs, in each tile."""
        squared = smooth(self.grid(pairs**2))
        return 0.5 * np.sqrt(squared * _SQUARED_WEIGHTS)

    def refined(self, pairs, finer: Tiles) -> np.ndarray:
        """Values of pairs for the tiles of ``finer``, which are smaller, or split as these."""
        row = np.arange(finer.down) * finer.edge // self.edge
        column = np.arange(finer.across) * finer.edge // self.edge
        return self.grid(pairs)[np.ix_(row, column)].ravel()

    def to_pixels(self, tiles) -> np.ndarray:
        k = self.split
        tiles = tiles.reshape(self.down // k, k, self.across // k, k).mean((1, 3))
        pixels = np.kron(tiles, np.ones((self.edge, self.edge)))
        return pixels[: self.height, : self.width].ravel()


def _allotted(noise, work):
    """Samples of each tile as shares of the mean."""
    share = np.sqrt(_trusted(noise) / work)
    return np.clip(share / share.mean(), LEAST, MOST)


def _trusted(noise):
    return np.maximum(_TRUST * noise + (1 - _TRUST) * noise.mean(), 0)


_BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16
# Σ w² of the weights of ``smooth``, once.
_SQUARED_WEIGHTS = float((_BINOMIAL**2).sum() ** 2)


def smooth(tiles: np.ndarray, times: int = 1) -> np.ndarray:
    """Binomial averages over 5 × 5 tiles: a standard deviation of √times tiles."""
    for axis in times * (0, 1):
        pad = [(2, 2) if k == axis else (0, 0) for k in (0, 1)]
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(tiles, pad, "edge"), 5, axis)
        tiles = windows @ _BINOMIAL
    return tiles
