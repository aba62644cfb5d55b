"""What pairs of eye paths tell before the first pass: how many of them should gather, how many
light paths they are worth, how wide kernels should be, and which pixels need more samples.

Two independent means a, b over k = 4 stratified samples of one pixel are read from two independent
photon maps A, B. With the gathered light g and all the rest l, weighted by 1/(mean² + floor²) so
that errors are relative,

    V_r = k⟨(l_a − l_b)²⟩/2                    of an eye path, without what it gathers,
    V_g = k⟨(g_aA − g_bA)(g_aB − g_bB)⟩/2      of a gather, were there no end of photons,
    V_gp = k⟨(g_aA − g_bA)²⟩/2 − V_g           of a gather, by the photons that it alone meets,
    V_p = ⟨(g_aA − g_aB)(g_bA − g_bB)⟩/2       of photons that a pixel's samples share.

A pass of n eye samples a pixel, of which a share q gathers, and N light paths (N_0 in the pilot)
has the variance A/n + B/N, A = V_r + V_g/q, B = N_0 (V_p + V_gp/(q n)), and costs
n P (1 + q C_g) + N C_p, P the number of pixels. For given n, variance times cost is smallest at

    q² = (V_g + V_gp)/(V_r C_g),        N² = n² P (1 + q C_g) B / (A C_p),

and with samples of a pixel in proportion to √((V_r + (V_g + V_gp)/q)/C) there, C the work of an eye
path of that pixel. Costs are counted, not timed, so that every machine decides alike.

*Widths of kernels.* All this is gathered with kernels of several widths w, in pixels. B falls as
1/w². With D = g(8) − g(4) the product D_aA D_bB has neither the noise of eye paths nor of photons
in it: its mean is the square of what bias changes from 4 to 8 pixels. Bias grows as w² where light
is smooth and as √w in the mean around an edge; between them, as w^1.5,

    bias²(w) = ⟨D D'⟩ (w/4)³/(2^1.5 − 1)²,    so    w⁵ = 2 B₁/(3 M N) · 4³ (2^1.5 − 1)²/⟨D D'⟩

makes bias² + B₁/(w² M N) smallest after M = 32 passes. Means are taken over tiles and their
neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from . import footprint
from .allotment import in_proportion
from .film import rays_through, sampled_size, wavelengths
from .prepared import PILOT, Prepared, stream_seed
from .spectra import channel_mean

# Tiles of the picture at most, and stratified samples of each half of the pair in a tile's pixel.
_TILES, _SAMPLES = 4096, 4
# Widths of kernels that are compared, and the range of those that are chosen, in pixels.
_NARROW, _WIDE = 4.0, 8.0
_THINNEST, _WIDEST = 1.0, 32.0
# Passes that the widths are right for, however many there will be: passes add up.
_PASSES = 32
# Smallest share of eye paths that gather, and smallest number of them in a pixel and pass.
_LEAST_SHARE, _GATHERS_PER_PIXEL = 1 / 8, 2
# Work of an eye path: of its first ray, of a vertex.
_CAMERA, _VERTEX = 0.3, 0.4
# Work of a gather, each photon it meets, a light path, a photon it leaves; an eye path is about 1.
_GATHER, _MET, _LIGHT_PATH, _LEFT = 1.2, 1 / 40, 0.6, 0.4
# Variance of an eye sample among many stratified ones, as a share of that among _SAMPLES.
_STRATIFIED = 0.3
# A tile's numbers count by so much, the rest is the picture's mean.
_TRUST = 0.85
# Rounds in which the decisions, each of which depends on the others, settle.
_ROUNDS = 4


@dataclass(frozen=True)
class Survey:
    """What was found.

    share        of the eye paths that should gather (see ``eye.Thinning``).
    light_paths  of a pass; 0 where photons do not show.
    counts       samples of each pixel (see ``allotment``), or None: all alike.
    widths       of the kernels of each pixel, in pixels.
    """

    share: float
    light_paths: float
    counts: np.ndarray | None
    widths: np.ndarray


def look(
    scene: Prepared, sensor, radius: float, seed: int, each: int, maps, light_paths, choose: bool
) -> Survey:
    """Trace the pairs, and decide.

    radius       bandwidth of the first pass, world units.
    each         eye samples of a pixel in a pass, in the mean.
    maps         two independent photon maps of as many light paths, or empty ones.
    light_paths  of a pass if they are given, else 0 or None.
    choose       widths of kernels; else all have ``radius``.
    """
    tiles = _Tiles.of(sensor)
    sampler = mi.load_dict({"type": "owen_sobol"})
    lane = dr.arange(mi.UInt32, tiles.lanes)
    sampler.begin(stream_seed(seed, PILOT, 3), lane // _SAMPLES, lane % _SAMPLES)
    ray, _ = rays_through(sensor, sampler, tiles.positions(sensor, seed, sampler), 0.5)
    if choose:  # kernels as wide as they are told to be
        radius = 0.1 * scene.extent
    free = replace(footprint.of(sensor, radius), least=dr.opaque(mi.Float, 1e-6))
    if choose:
        scene = replace(scene, footprint=free)
    vertices = dr.zeros(mi.Float, tiles.lanes)

    def see(lane, depth, si, bsdf, bs, active):
        dr.scatter_add(vertices, mi.Float(1), lane, active)

    L, _, points = scene.trace(sampler, ray, see=see)
    work = _VERTEX * _pairwise(vertices).mean(1) + _CAMERA
    rest = _pairwise(channel_mean(L) + dr.zeros(mi.Float, tiles.lanes))
    if points is None or not min(map_.stored for map_ in maps):
        noise = _within(rest, rest, tiles.weight(rest))
        counts = in_proportion(tiles.spread(noise, work), each)
        return Survey(1.0, 0.0, counts, np.ones(1))

    # --- Gathered light of a wide and a narrow kernel, from either map ---
    colours = wavelengths(sensor, 0.5) if mi.is_spectral else None
    gathered = []
    for width in (_NARROW, _WIDE) if choose else (1.0,):
        if choose:
            free = replace(free, widths=dr.opaque(mi.Float, width))
            scene = replace(scene, footprint=free)
        gathered.append(
            [_gathered(scene, map_, radius, seed, points, colours, tiles.lanes) for map_ in maps]
        )
    (a, met), (b, _) = gathered[0]
    wide_a, wide_b = gathered[-1][0][0], gathered[-1][1][0]
    emitted, points_each = maps[0].emitted, dr.width(points.lane) / tiles.lanes

    # --- Variances and bias² of each pair, relative to the light there ---
    weight = tiles.weight(rest + 0.5 * (wide_a + wide_b))
    v_rest = _within(rest, rest, weight)
    v_gather = max(0.0, float(_within(a, b, weight).mean()))
    shared, alone = _of_photons(wide_a - wide_b, weight)
    mid_shared, mid_alone = _of_photons(a - b, weight)
    v_alone = max(0.0, float(mid_alone.mean()))
    changed_a, changed_b = wide_a - a, wide_b - b
    change = 0.5 * weight * (changed_a[:, 0] * changed_b[:, 1] + changed_a[:, 1] * changed_b[:, 0])

    # --- Decisions ---
    share, paths = 1.0, light_paths or 5 * emitted
    narrow, wide = (_NARROW, _WIDE) if choose else (1.0, 1.0)
    widths = np.full(len(rest), narrow)
    for _ in range(_ROUNDS):
        photons = (
            0.5
            * emitted
            * (
                wide**2 * (shared + alone / (share * each))
                + narrow**2 * (mid_shared + mid_alone / (share * each))
            )
        )
        if choose:
            widths = _widths(tiles, photons, change, _PASSES * paths).ravel()
        area = float(np.mean((widths / narrow) ** 2))
        thinner = float(np.mean((narrow / widths) ** 2)) * emitted / paths
        gather = _GATHER * points_each + _MET * met * area * paths / emitted
        least = max(_LEAST_SHARE, min(1.0, _GATHERS_PER_PIXEL / each))
        v_eye = _STRATIFIED * float(v_rest.mean())
        if v_eye > 0:
            share = math.sqrt((v_gather + v_alone * thinner) / (v_eye * gather))
        # In steps, so that machines whose arithmetic differs in the last digits agree.
        share = min(16, math.ceil(16 * max(least, share))) / 16
        if not light_paths:
            light = _LIGHT_PATH + _LEFT * maps[0].stored / emitted
            costs = (1 + share * gather) / (light * tiles.pixels)
            photons = max(0.0, float((photons / widths**2).mean()))
            eye = max(v_eye + v_gather / share, 1e-30)
            paths = max(each * tiles.pixels * math.sqrt(photons * costs / eye), 1.0)
    noise = v_rest + 0.5 * (_within(a, a, weight) + _within(b, b, weight)) / share
    counts = in_proportion(tiles.spread(noise, work + share * gather), each)
    return Survey(share, paths, counts, tiles.to_pixels(tiles.grid(widths)))


def _widths(tiles: _Tiles, photons, change, light_paths: float) -> np.ndarray:
    """Of kernels in each tile, in pixels (see the module's head). photons: B₁ of each pair."""
    photons = _smooth(tiles.grid(photons))
    photons = np.maximum(photons, 1e-3 * max(float(photons.mean()), 1e-30))
    error = tiles.uncertainty(change)
    bias2 = (2**1.5 - 1) ** -2 * (np.maximum(_smooth(tiles.grid(change)), 0) + error)
    fifth = 2 * photons * _NARROW**3 / (3 * light_paths * np.maximum(bias2, 1e-30))
    return np.clip(fifth**0.2, _THINNEST, _WIDEST)


def _gathered(scene, map_, radius, seed, points, colours, lanes):
    """(light of pairs, photons an eye path meets)."""
    light, photons = dr.zeros(mi.Float, lanes), 0.0
    r = dr.opaque(mi.Float, radius)
    for found in scene.gather(map_, r, seed, points, colours):
        dr.scatter_add(light, channel_mean(found.radiance), found.lane)
        photons += float(dr.sum(mi.Float(found.photons))[0]) / lanes
    return _pairwise(light), photons


def _pairwise(values) -> np.ndarray:
    """Means over _SAMPLES lanes, (pairs, 2), finite, double precision."""
    values = np.nan_to_num(values.numpy().astype(np.float64), posinf=0, neginf=0)
    return values.reshape(-1, 2, _SAMPLES).mean(-1)


def _within(v, w, weight):
    """Of a single sample: half the product of differences within each pair."""
    return 0.5 * _SAMPLES * weight * (v[:, 0] - v[:, 1]) * (w[:, 0] - w[:, 1])


def _of_photons(difference, weight):
    """Variance by photons, of what all samples of a pixel share and of what each has alone.
    difference: between the two maps."""
    shared = 0.5 * weight * difference[:, 0] * difference[:, 1]
    return shared, _SAMPLES * (0.25 * weight * (difference**2).sum(1) - shared)


@dataclass(frozen=True)
class _Tiles:
    """Squares of ``edge`` pixels that cover a film, with a random pixel and its pair in each."""

    edge: int
    width: int
    height: int

    @staticmethod
    def of(sensor) -> _Tiles:
        width, height = sampled_size(sensor.film())
        return _Tiles(max(1, math.ceil(math.sqrt(width * height / _TILES))), width, height)

    @property
    def across(self) -> int:
        return -(-self.width // self.edge)

    @property
    def down(self) -> int:
        return -(-self.height // self.edge)

    @property
    def lanes(self) -> int:
        return 2 * _SAMPLES * self.across * self.down

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def positions(self, sensor, seed: int, sampler):
        """On the film, of all lanes, tiles row by row."""
        film = sensor.film()
        tile = dr.arange(mi.UInt32, self.lanes) // (2 * _SAMPLES)
        a, b = mi.sample_tea_32(tile, dr.opaque(mi.UInt32, stream_seed(seed, PILOT, 4)))
        x = dr.minimum((tile % self.across) * self.edge + a % self.edge, self.width - 1)
        y = dr.minimum((tile // self.across) * self.edge + b % self.edge, self.height - 1)
        border = (self.width - film.crop_size().x) // 2
        corner = film.crop_offset()
        corner = mi.ScalarPoint2f(corner.x - border, corner.y - border)
        return mi.Point2f(mi.Float(x), mi.Float(y)) + corner + sampler.next_2d()

    def grid(self, pairs) -> np.ndarray:
        """Values of pairs as (down, across)."""
        return pairs.reshape(self.down, self.across)

    def weight(self, light) -> np.ndarray:
        """1/(mean² + floor²) of each pair, the floor a quarter of the median."""
        level = _smooth(self.grid(light.mean(1)))
        lit = level[level > 0]
        floor = 0.25 * float(np.median(lit)) if lit.size else 1.0
        return (1 / (level**2 + floor**2)).ravel()

    def spread(self, noise, work) -> np.ndarray:
        """√(variance/work) of each pixel, from those of pairs."""
        noise = _smooth(self.grid(noise))
        noise = _TRUST * noise + (1 - _TRUST) * noise.mean()
        return self.to_pixels(np.sqrt(noise / _smooth(self.grid(work))))

    def uncertainty(self, pairs) -> np.ndarray:
        """Half a standard error of smoothed means of pairs, in each tile."""
        squared = _smooth(self.grid(pairs**2))
        return 0.5 * np.sqrt(squared * _SQUARED_WEIGHTS)

    def to_pixels(self, tiles) -> np.ndarray:
        pixels = np.kron(tiles, np.ones((self.edge, self.edge)))
        return pixels[: self.height, : self.width].ravel()


_BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16
# Σ w² of the weights of ``_smooth``.
_SQUARED_WEIGHTS = float((_BINOMIAL**2).sum() ** 2)


def _smooth(tiles: np.ndarray) -> np.ndarray:
    """Binomial averages over 5 × 5 tiles."""
    for axis in (0, 1):
        pad = [(2, 2) if k == axis else (0, 0) for k in (0, 1)]
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(tiles, pad, "edge"), 5, axis)
        tiles = windows @ _BINOMIAL
    return tiles
