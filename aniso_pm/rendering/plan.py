"""What two photon maps and pairs of eye paths say about a use of the map: variances, and the best
that can be done with it.

Two independent means a, b over k = 4 stratified samples of one pixel are read from two independent
photon maps A, B. With the gathered light g and all the rest l, weighted by 1/(mean² + floor²) so
that errors are relative,

    V_r = k⟨(l_a − l_b)²⟩/2                    of an eye path, without what it gathers,
    V_g = k⟨(g_aA − g_bA)(g_aB − g_bB)⟩/2      of a gather, were there no end of photons,
    V_p = ⟨(g_aA − g_aB)(g_bA − g_bB)⟩/2       of photons that a pixel's samples share,
    V_gp = k(⟨(g_aA − g_aB)²⟩/2 − V_p)         of a gather, by the photons that it alone meets.

A pass of n eye samples a pixel, of which a share q gathers, and N light paths (N_0 in the pilot)
has the variance A/n + B/N, A = V_r + V_g/q, B = N_0 (V_p + V_gp/(q n)) (the noise of eye paths
being what the film's filter leaves of it, that of shared photons the root of it), and costs
n P (C + q (C_g + N C_m)) + N C_p + C_0, P the number of pixels, C_m the work of the photons of one
light path that a gather meets, C_0 what every pass costs. For given n, variance times cost is
smallest at

    q² = C (V_g + V_gp)/(V_r (C_g + N C_m)),
    N² = n (n P (C + q C_g) + C_0) B / (A (C_p + n P q C_m)),

and with samples of a pixel in proportion to √((V_r + (V_g + V_gp)/q)/C) there, C the work of an eye
path of that pixel. Costs are counted, not timed, so that every machine decides alike; those of
gathers tile by tile: kernels are wide where there are few photons.

*Widths of kernels.* All this is gathered with kernels of several widths w, in pixels. B falls as
1/w². With D = g(8) − g(4) the product D_aA D_bB has neither the noise of eye paths nor of photons
in it: its mean is the square of what bias changes from 4 to 8 pixels. Bias grows as w² where light
is smooth and as √w in the mean around an edge; between them, as w^1.5,

    bias²(w) = ⟨D D'⟩ (w/4)³/(2^1.5 − 1)²,    so    w⁵ = 2 B₁/(3 M N) · 4³ (2^1.5 − 1)²/⟨D D'⟩

makes bias² + B₁/(w² M N) smallest after M = 32 passes. Means are taken over tiles and their
neighbours. What is promised after M passes knows that kernels shrink from pass to pass: photons'
noise is multiplied by the mean of (r_0/r_i)² over the passes, bias² by the square of the mean of
(r_i/r_0)^1.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..transport import aim
from ..transport.uses import Use
from . import footprint
from .allotment import FEW
from .schedule import bandwidth
from .tiles import SAMPLES, Tiles, smooth

# Widths of kernels that are compared, and the range of those that are chosen, in pixels.
NARROW, WIDE = 0.5 * footprint.TRIED, footprint.TRIED
_THINNEST, _WIDEST = 1.0, 32.0
# Passes that the widths are right for, however many there will be: passes add up.
PASSES = 32
# Smallest share of eye paths that gather.
LEAST_SHARE = 1 / 8
# Work of a gather, each photon it meets, a light path, a photon it leaves; an eye path is about 1.
_GATHER, _MET, LIGHT_PATH, LEFT = 2.0, 1 / 30, 0.6, 0.4
# Work of a pass besides, however small (docs/performance.md), and of one that has no map.
_PASS, _PASS_WITHOUT = 1.5e5, 2e4
# Light paths, and what meets their photons, are at most so many times the work of all else.
_TIMES = 10
# Variance of an eye sample among a few hundred stratified ones, as a share of that among SAMPLES:
# 0.59 among 52 and falling, in direct light.
STRATIFIED = 0.45
# Rounds in which the decisions, each of which depends on the others, settle.
_ROUNDS = 4
# Variance beyond the first gathered part, where stratification does less, as such a share.
_LATER_STRATIFIED = 0.85


@dataclass(frozen=True)
class Found:
    """What a use of the map gives to the pairs: light from map a, b through narrow kernels and
    through wide ones, what came over lobes of a, (pairs, 2); photons that an eye path meets and
    gather points that it leaves (pairs), as many as on Lambertian receivers would be the same work;
    light paths and photons of a map; how to aim those; photons of both maps that any pair meets."""

    a: np.ndarray
    b: np.ndarray
    wide_a: np.ndarray
    wide_b: np.ndarray
    over_lobes: np.ndarray
    met: np.ndarray
    points: np.ndarray
    emitted: int
    stored: int
    aim: aim.Learned | None
    met_by_any: int

    @property
    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Light of each."""
        return self.wide_a, self.wide_b

    @property
    def light(self) -> np.ndarray:
        return 0.5 * (self.wide_a + self.wide_b)


@dataclass(frozen=True)
class Plan:
    """The best that can be done with a use of the map; see the module's head and ``Survey``. share
    and widths are those of tiles, error is the relative MSE, work that of a pass, light_work that
    of its light paths; path_work (of an eye path), gathered (light) and noise (variance of gathers)
    are those of pairs; lobes is the part of the error that kernels make which follow lobes."""

    tiles: Tiles
    use: Use
    each: int
    share: np.ndarray
    light_paths: float
    widths: np.ndarray
    error: float
    work: float
    light_work: float
    path_work: np.ndarray
    gathered: np.ndarray
    noise: np.ndarray
    aim: aim.Learned | None = None
    lobes: float = 0.0

    @staticmethod
    def of(longest: float, each: int, **given) -> Plan:
        """Of passes whose work is ``longest`` at most, or, where light paths are given, twice that
        of those. Where they would have less than FEW samples a pixel, up to four times as long, if
        their light paths alone are no more work than that; with one sample as long as its eye paths
        ask for. given: as of ``_of``."""
        plan = Plan._of(each, **given)
        if given["light_paths"]:
            longest = max(longest, 2 * plan.light_work)
        if plan.work > longest and plan.each > FEW:
            plan = Plan._of(max(FEW, int(plan.each * longest / plan.work)), **given)
        too_long = max(plan.work / 4, plan.light_work) / longest
        if too_long > 1 and plan.each > 1:
            plan = Plan._of(max(1, int(plan.each / too_long)), **given)
        most = max(longest, plan.work - plan.light_work)
        if plan.light_work > most and not given["light_paths"]:
            # Passes add up: more of them, each with fewer light paths, are as good.
            fewer = plan.light_paths * most / plan.light_work
            plan = Plan._of(plan.each, **given | {"light_paths": fewer})
        return plan

    @staticmethod
    def _of(
        each: int,
        *,
        tiles: Tiles,
        choose: bool,
        light_paths: float | None,
        filtered: float,
        total: float,
        whole,
        alpha: float,
        use: Use,
        weight,
        v_own,
        found: Found | None = None,
        later: Any = 0.0,
        work: Any = None,
    ) -> Plan:
        """
        each    eye samples of a pixel in a pass.
        choose  widths of kernels: there is no given radius.
        light_paths  of a pass if they are given, else 0 or None.
        filtered  variance of eye paths that the film leaves (``film.noise_share``).
        total   work after which ``error`` is that of the mean over all passes.
        whole   work of path tracing.
        alpha   by which kernels shrink from pass to pass (``schedule.bandwidth``).
        use     of the map; weight: of each pair.
        v_own   of an eye path, without what it gathers; later: what it has more because it goes on
                beyond the first gathered part.
        found   in the map; None: there is none.
        work    of an eye path; None: of path tracing.
        """
        work = whole if work is None else work
        v_eye = STRATIFIED * float(v_own.mean()) + _LATER_STRATIFIED * float(np.mean(later))
        v_eye = filtered * max(v_eye, 0.0)
        if found is None:
            pass_ = each * tiles.pixels * float(work.mean()) + _PASS_WITHOUT
            error = v_eye / each * pass_ / total
            share = np.full(1, 1.0 if use == "none" else LEAST_SHARE)
            nothing = np.zeros(len(whole))
            return Plan(
                tiles=tiles,
                use=use,
                each=each,
                share=share,
                light_paths=0.0,
                widths=np.ones(1),
                error=error,
                work=pass_,
                light_work=0.0,
                path_work=work,
                gathered=nothing,
                noise=nothing,
            )

        noise = _Noise.of(found, tiles, weight, filtered)

        # --- Decisions ---
        share, paths = np.ones(len(whole)), float(light_paths or 5 * found.emitted)
        widths = np.full(len(whole), NARROW if choose else 1.0)
        samples, eye_work = each * tiles.pixels, float(work.mean())
        light, aimed = LIGHT_PATH + LEFT * found.stored / found.emitted, 1.0
        # Were all eye paths to gather: C_g, and C_m through kernels of the first width.
        point = _GATHER * smooth(tiles.grid(found.points)).ravel()
        photon = _MET * smooth(tiles.grid(found.met)).ravel() / found.emitted
        if found.aim:
            light, photon = light * found.aim.work, photon * found.aim.photons
            aimed = found.aim.variance
        for _ in range(_ROUNDS):
            b_1 = aimed * noise.by_photons(share * each, choose)
            if choose:
                widths = kernel_widths(tiles, b_1, noise.change, PASSES * paths).ravel()
                area = (widths / NARROW) ** 2
            else:
                area = np.ones(len(whole))
            thinner = aimed * found.emitted / (paths * area)
            every = np.maximum(point + photon * area * paths, 1e-3)
            if v_eye > 0:
                share = noise.share(thinner, eye_work / (v_eye * every), each)
            eye_noise = max(v_eye + float((noise.gather / share).mean()), 1e-30)
            by_photons = max(0.0, float((b_1 / widths**2).mean()))
            if not light_paths:
                rest = samples * (eye_work + float((point * share).mean()))
                of_one = light + samples * float((photon * area * share).mean())
                paths = math.sqrt(each * (rest + _PASS) * by_photons / (of_one * eye_noise))
                # Where eye paths have next to no noise: more of them save next to nothing.
                paths = max(min(paths, (_TIMES * rest + _PASS) / of_one), 1.0)

        # --- What they promise ---
        gather = (point + photon * area * paths) * share
        pass_ = samples * (eye_work + float(gather.mean())) + paths * light + _PASS
        left = pass_ / total
        # Kernels of later passes are smaller.
        radii = np.array([bandwidth(1.0, alpha, k) for k in range(PASSES)])
        noisier, sharper = float((radii**-2).mean()), float((radii**1.5).mean()) ** 2
        error = (eye_noise / each + noisier * by_photons / paths) * left
        blur = sharper * noise.change * (widths / NARROW) ** 3 if choose else np.zeros(len(whole))
        error += _bias2(float(blur.mean()))
        follow = np.clip(found.over_lobes.sum(1) / np.maximum(found.a.sum(1), 1e-30), 0, 1)
        behind = noisier * max(0.0, float((follow * b_1 / widths**2).mean())) / paths * left
        behind += _bias2(float((follow * blur).mean()))
        return Plan(
            tiles=tiles,
            use=use,
            each=each,
            share=share,
            light_paths=paths,
            widths=widths,
            error=error,
            work=pass_,
            light_work=paths * light,
            path_work=work + gather,
            gathered=found.light.mean(1),
            noise=(noise.gather + noise.alone * thinner) / (filtered * share),
            aim=found.aim,
            lobes=round(behind / max(error, 1e-30), 2),
        )


@dataclass(frozen=True)
class _Noise:
    """Variances of each pair, relative to the light there; see the module's head.

    gather  V_g; alone, shared: V_gp and V_p through narrow kernels. These three as they can be
            trusted (``Tiles.trusted``).
    narrow, wide  V_p and V_gp as measured, through narrow kernels and through wide ones.
    change  ⟨D D'⟩.
    emitted  light paths of each map: N_0.
    """

    gather: np.ndarray
    alone: np.ndarray
    shared: np.ndarray
    narrow: tuple[np.ndarray, np.ndarray]
    wide: tuple[np.ndarray, np.ndarray]
    change: np.ndarray
    emitted: int

    @staticmethod
    def of(found: Found, tiles: Tiles, weight, filtered: float) -> _Noise:
        """weight, filtered: as for ``Plan._of``."""

        def of_photons_filtered(difference):
            # Neighbours have what is shared in common, as far as kernels reach: a few pixels.
            shared, alone = of_photons(difference, weight)
            return math.sqrt(filtered) * shared, filtered * alone

        a, b = found.a, found.b
        narrow = of_photons_filtered(a - b)
        changed_a, changed_b = found.wide_a - a, found.wide_b - b
        change = changed_a[:, 0] * changed_b[:, 1] + changed_a[:, 1] * changed_b[:, 0]
        return _Noise(
            gather=tiles.trusted(filtered * within(a, b, weight)),
            alone=tiles.trusted(narrow[1]),
            shared=tiles.trusted(narrow[0]),
            narrow=narrow,
            wide=of_photons_filtered(found.wide_a - found.wide_b),
            change=0.5 * weight * change,
            emitted=found.emitted,
        )

    def by_photons(self, gathers, choose: bool) -> np.ndarray:
        """B₁, the variance B of kernels of one pixel (where widths are chosen; else of the given
        ones), of one light path. gathers: of a pixel in a pass."""
        own = 1 / gathers
        # A pass that a pixel reads less than once counts when it is read.
        often = np.maximum(1, own)
        sizes = (NARROW, WIDE) if choose else (1.0, 1.0)
        b_1 = sizes[1] ** 2 * (often * self.wide[0] + own * self.wide[1])
        b_1 += sizes[0] ** 2 * (often * self.narrow[0] + own * self.narrow[1])
        return 0.5 * self.emitted * b_1

    def share(self, thinner, worth, each: int) -> np.ndarray:
        """q of each pair. thinner: by what photons' variance is multiplied; worth: C over V_r and
        the work of a gather."""
        share = np.sqrt((self.gather + self.alone * thinner) * worth)
        # Less than one in a pass: then a gather is alone with what it would share.
        more = np.sqrt((self.gather + (self.alone + self.shared) * thinner) * worth)
        share = np.where(share * each < 1, np.minimum(more, 1 / each), share)
        # In steps, so that machines whose arithmetic differs in the last digits agree.
        return np.ceil(16 * np.clip(share, LEAST_SHARE, 1)) / 16


def _bias2(change: float) -> float:
    """From the square of what changes between kernels of 4 and 8 pixels."""
    return max(change, 0.0) / (2**1.5 - 1) ** 2


def kernel_widths(tiles: Tiles, photons, change, light_paths: float) -> np.ndarray:
    """Of kernels in each tile, in pixels (see the module's head). photons: B₁ of each pair."""
    photons = smooth(tiles.grid(photons))
    photons = np.maximum(photons, 1e-3 * max(float(photons.mean()), 1e-30))
    error = tiles.uncertainty(change)
    bias2 = (2**1.5 - 1) ** -2 * (np.maximum(smooth(tiles.grid(change)), 0) + error)
    fifth = 2 * photons * NARROW**3 / (3 * light_paths * np.maximum(bias2, 1e-30))
    return np.clip(fifth**0.2, _THINNEST, _WIDEST)


def within(v, w, weight):
    """Of a single sample: half the product of differences within each pair."""
    return 0.5 * SAMPLES * weight * (v[:, 0] - v[:, 1]) * (w[:, 0] - w[:, 1])


def of_photons(difference, weight):
    """Variance by photons, of what all samples of a pixel share and of what each has alone.
    difference: between the two maps."""
    shared = 0.5 * weight * difference[:, 0] * difference[:, 1]
    return shared, SAMPLES * (0.25 * weight * (difference**2).sum(1) - shared)
