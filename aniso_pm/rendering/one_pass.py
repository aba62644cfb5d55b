"""One pass: its photons, its eye paths wavefront by wavefront, and what they leave in the film.

Passes are pure: pass i depends on (scene, parameters, seed, i) alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from ..errors import is_interrupt, one_line
from ..map.photon_map import PhotonMap
from ..transport.thinning import Thinning
from . import film as films
from .beginning import Decided
from .done import Traced
from .evening import Evening
from .layered import plus
from .prepared import EYE, PROBE, THINNING, Prepared, stream_seed
from .schedule import bandwidth, wavelength_sample
from .stage_times import Clock
from .state import COUNTS, added

_GATHERED = [name for name in COUNTS if name.startswith(("gather_points", "photons_gathered"))]
_Result = TypeVar("_Result")


class Tracer:
    """Renders one pass after the other.

    map, radius  of the last one.
    unfinished   wavefronts so far of the pass that is being rendered; None between passes.
    replayed     are passes traced in Python once and then replayed?
    photons      of a map, the most so far; _points: gather points of a wavefront.
    """

    def __init__(self, decided: Decided, sensor, seed: int, clock: Clock):
        self.decided, self.sensor, self.seed, self.clock = decided, sensor, seed, clock
        self.replayed = decided.replayed
        self.scene = decided.scene if self.replayed else decided.scene.thawed()
        self.map: PhotonMap | None = None
        self.radius: float | None = None
        self.unfinished: Traced | None = None
        self.photons = self._points = 0

    def __call__(self, index: int, report: Callable[[int, float], None]) -> Traced:
        """Pass ``index``. report: called with it and the share of it that is done, after every
        wavefront but the last."""
        # --- Photons ---
        self.unfinished = None
        decided, settings = self.decided, self.scene.settings
        self.radius = bandwidth(decided.settled.radius, settings.alpha, index)
        colour = wavelength_sample(self.seed, index)
        wavelengths = films.wavelengths(self.sensor, colour) if mi.is_spectral else None
        self.map = self._replayed(
            lambda scene: scene.photon_map(
                self.seed, index, self.photons, wavelengths, self.clock.lap
            )
        )
        self.photons = max(self.photons, self.map.stored)
        counts = dict.fromkeys(COUNTS, 0)
        counts["photons_emitted"] = self.map.emitted
        counts["photons_stored"] = self.map.stored
        counts["photons_rejected"] = self.map.rejected

        # --- Eye paths, where memory is short one sample each of a part of the pixels ---
        spp = decided.shares(index)
        allotment, layered = decided.allotment, decided.layered
        more = spp - allotment.each
        before = decided.shares.before(index) - index * allotment.each
        # An array, not a number: as a literal it would make every pass compile kernels of its own.
        radius = dr.opaque(mi.Float, self.radius)
        image, layers = None, None
        parts = allotment.wavefronts(index, more, before, decided.wavefront)
        for wavefront, (lanes, done) in enumerate(parts):
            random = mi.sample_tea_32(stream_seed(self.seed, PROBE, index), wavefront)[0]
            wavefront_of = partial(self._wavefront, index, lanes, radius, random, colour)
            splats, found, counted = self._replayed(wavefront_of)
            counts = added(counts, counted)
            image = splats if image is None else image + splats
            dr.eval(image)
            layers = plus(layers, found) if layered else None
            self.clock.lap("film")
            counts["spp"] = int(spp * done)
            self.unfinished = Traced(image, dict(counts), layers)
            if done < 1:
                report(index, done)
        counts["spp"] = spp
        return Traced(image, counts, layers)

    def _replayed(self, stage: Callable[[Prepared], _Result]) -> _Result:
        """What a stage of a pass gives on the scene. If that cannot be recorded it begins anew, and
        nothing is replayed from then on."""
        try:
            return stage(self.scene)
        except RuntimeError as error:
            # As in the pilot, which does not record everything (see ``beginning``).
            if is_interrupt(error) or not self.replayed:
                raise
            mi.Log(mi.LogLevel.Debug, f"aniso_pm: passes are not replayed: {one_line(error)}")
            self.replayed, self.scene = False, self.scene.thawed()
            return stage(self.scene)

    def _wavefront(self, index: int, lanes, radius, random, colour: float, scene: Prepared):
        """Some eye samples: (image of them, their sums of layers, what they count of COUNTS).

        lanes   allotment.Lanes.
        random  seed for density estimation.
        colour  of the pass, see ``film.sample_rays``.
        """
        decided, sensor = self.decided, self.sensor
        sampler = mi.load_dict({"type": "owen_sobol"})
        sampler.begin(stream_seed(self.seed, EYE), lanes.pixel, lanes.sample)
        ray, ray_weight, position = films.sample_rays(sensor, sampler, lanes.pixel, colour)
        dr.eval(ray, ray_weight, position)
        even = None
        if decided.gathers is not None:
            choice = stream_seed(self.seed, THINNING, index)
            places = lanes.pixel, lanes.place, lanes.of
            thinning = Thinning.of_pass(decided.gathers, choice, *places)
            even = Evening(thinning, lanes, films.sampled_size(sensor.film())[0])

        # --- Eye paths and density estimation ---
        if scene.footprint is not None:
            pixel = scene.footprint.in_pass(index).seen_by(lanes.pixel)
            scene = replace(scene, footprint=pixel)
        seen = scene.radiance(
            sampler,
            ray,
            self.map,
            radius,
            random,
            expected=self._points,
            lap=self.clock.lap,
            even=even,
            for_layers=True,
        )
        counts = _counts(seen.gathered)
        self._points = max(self._points, counts["gather_points"])

        # --- Into the image ---
        finite = dr.all(dr.isfinite(seen.L))
        counts["eye_samples"] = lanes.count
        counts["eye_samples_rejected"] = dr.width(seen.L) - int(dr.count(finite)[0])
        L = dr.select(finite, seen.L, 0) * ray_weight
        image = films.splat(sensor.film(), lanes, position, L, seen.valid, ray.wavelengths)
        dr.eval(image)
        layers: dict[str, Any] = {}
        if decided.layered is not None:
            layers = decided.layered.wavefront(
                position, L, seen.seen, seen.gathered, ray, ray_weight, lanes, finite
            )
        return image, layers, counts


def _counts(gathered) -> dict[str, int]:
    """What was gathered."""
    counts = dict.fromkeys(_GATHERED, 0)
    for found in gathered:
        counts["gather_points"] += dr.width(found.lane)
        counts["gather_points_anisotropic"] += int(dr.count(found.follows)[0])
        counts["gather_points_clamped"] += int(dr.count(found.clamped)[0])
        counts["gather_points_capped"] += int(dr.count(found.capped)[0])
        counts["gather_points_degenerate"] += int(dr.count(found.degenerate)[0])
        counts["gather_points_off_surface"] += int(dr.count(found.lost)[0])
        counts["photons_gathered"] += int(dr.sum(mi.Float64(found.photons))[0])
    return counts
