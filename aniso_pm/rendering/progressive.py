"""Passes: fresh photons and fresh eye paths at a shrinking bandwidth, until a rule says stop.

Probabilistic progressive photon mapping [Knaus and Zwicker 2011]: pass i + 1 uses a kernel whose
area is (i + α)/(i + 1) times that of pass i. Variance grows and bias shrinks so that the mean over
passes converges to the right image. Passes are pure: pass i depends on (scene, parameters, seed, i)
alone, so that they can be rendered in several runs, or on several machines, and added up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own
from ..errors import Failed, is_interrupt
from ..transport.eye import Thinning
from . import advice, digest, footprint, memory, state
from . import film as films
from .accumulate import NAMES, Sums, mean_and_variance, relative_standard_error
from .allotment import Allotment
from .clock import Clock
from .controls import Batch, Controls, Rendered
from .layered import Layered, plus, whole_pass
from .pilot import photons_per_path, settle
from .prepared import EYE, PROBE, THINNING, Prepared, stream_seed
from .schedule import bandwidth, shares, wavelength_sample
from .stopping import Stopping

# Eye samples traced at once, where there is memory for them (see ``memory``).
WAVEFRONT = 1 << 21
# What a pass counts.
_COUNTS = (
    "photons_emitted",
    "photons_stored",
    "photons_rejected",
    "photons_gathered",
    "eye_samples",
    "eye_samples_rejected",
    "gather_points",
    "gather_points_anisotropic",
    "gather_points_clamped",
    "gather_points_capped",
    "gather_points_degenerate",
    "gather_points_off_surface",
    "spp",
)


def render(scene: Prepared, sensor, seed: int, spp: int, controls: Controls, statistics: dict):
    """Render passes until a stopping rule says so; leaves the picture in the sensor's film.

    spp         see ``shares``; 0 takes the sampler's own.
    statistics  filled in as rendering goes on.

    Ctrl-C ends rendering: the film then holds all passes that were finished, or the wavefronts of
    the first one, and statistics["interrupted"] is True. It is raised on where there is nothing.
    A ``Failed`` of those who render the passes ends it likewise; statistics["failure"] is its text.
    Raises state.StateError where the checkpoint's state is not one of this rendering.
    """
    run = Run(scene, sensor, seed, spp, controls, statistics)
    run.start()
    try:
        if controls.elsewhere:
            for batch in controls.elsewhere(run):
                run.add(batch)
        else:
            for index in run.numbers():
                run.render_pass(index)
    except BaseException as error:
        failed = isinstance(error, Failed)
        if not (failed or is_interrupt(error)) or not run.keep_unfinished():
            raise
        statistics["interrupted"] = True
        if failed:
            statistics["failure"] = str(error)
    finally:
        run.stopping.close()
    run.finish()
    advice.after(scene, statistics)
    decided = replace(run.scene.thawed(), footprint=None)
    return Rendered(decided, run.map, run.radius, run.variance, run.done.layers, run.passes)


class _Done(NamedTuple):
    """Whole passes. Replaced by one assignment, so that Ctrl-C finds it consistent."""

    sums: Sums | None
    passes: list[list[int]]
    counts: dict[str, int]
    layers: dict[str, np.ndarray] | None = None


class _Room:
    """How many entries a buffer needs. It grows in steps: buffers of another size are traced anew
    by what is frozen."""

    def __init__(self):
        self.room = self.most = 0

    def seen(self, count: int):
        self.most = max(self.most, count)
        if count > self.room:
            self.room = count + count // 8


class Run:
    """One call of ``render``: what changes from pass to pass."""

    def __init__(self, scene, sensor, seed, spp, controls, statistics):
        self.scene, self.sensor, self.seed = scene, sensor, seed
        self.controls, self.statistics = controls, statistics
        self.film = sensor.film()
        self.given, self.spp = scene.settings, spp
        spp = spp or sensor.sampler().sample_count()
        pixels = films.pixel_count(self.film)
        self.shares = shares(scene.settings, spp, pixels, controls.first_pass)
        self.stopping = Stopping(scene.settings)
        self.clock = Clock()
        self.map = self.radius = self.variance = None
        self.done = _Done(None, [], dict.fromkeys((*_COUNTS, "passes"), 0))
        self.photons, self.points = _Room(), _Room()
        self.layered = Layered.of(self.film, scene.settings.layer_names)
        self.layers: dict[str, np.ndarray] | None = None  # of the pass that is being rendered
        self.unfinished = None  # (image, counts, layers) of the pass that is being rendered

    # --- Before the first pass ---

    def start(self):
        """Pilot, or the state of an earlier run."""
        advice.before(self.scene)
        self.film.prepare([])
        settings, checkpoint = self.scene.settings, self.controls.checkpoint
        earlier = checkpoint.start() if checkpoint else None
        known = earlier.identity if earlier else {}
        # The same pilot as before, whatever is known: what it chose pixel by pixel is not kept.
        exactly = known.get("samples per pixel of a pass")
        each = exactly or self.shares.each
        found = self.controls.settled or settle(
            self.scene, self.sensor, self.seed, each, bool(exactly)
        )
        self.shares = replace(self.shares, each=found.each)
        use = known.get("use of the map") or found.use
        count = settings.photon_count or known.get("photon count") or found.count
        self.radius0 = settings.initial_radius or known.get("initial radius") or found.radius
        self.found = found = replace(found, use=use, count=count, radius=self.radius0)
        self.scene = found.applied(self.scene)
        follow = known.get("lobes followed", self.scene.follow_lobes)
        self.scene = replace(self.scene, lobes_matter=follow)
        self.share = None  # of the eye paths of each pixel that gather; None: all do
        if found.share.min() < 1:
            pixels = films.pixel_count(self.film)
            self.share = own(mi.Float, np.resize(found.share, pixels).astype(np.float32))
        self.allotment = Allotment(films.pixel_count(self.film), found.each, found.counts)
        self.plan = memory.plan(self.scene, *self._job())
        self.scene = replace(self.scene, light_wavefront=self.plan.light_paths)
        if not settings.initial_radius:
            pixel = footprint.of(self.sensor, self.radius0, found.widths)
            self.scene = replace(self.scene, footprint=pixel)
        self.clock.lap("pilot")
        # The response curves of a specfilm do not survive a replay of the scene that they are in.
        special = mi.has_flag(self.film.flags(), mi.FilmFlags.Special)
        self.frozen = settings.passes != 1 and not special
        if self.frozen:
            self.scene = self.scene.frozen()
        if checkpoint:
            self.identity = digest.identity(self.scene, self.sensor, self.seed, self.shares.text)
            self.identity |= {
                "use of the map": use,
                "lobes followed": self.scene.follow_lobes,
                "initial radius": self.radius0,
                "photon count": count,
                "samples per pixel of a pass": self.shares.each,
            }
        self.statistics |= {
            "initial_radius": self.radius0,
            "radius_automatic": settings.initial_radius == 0,
            "share_of_gathers": float(found.share.mean()),
            "photon_count": count,
            "photon_count_automatic": settings.photon_count == 0,
            "aim": found.aim and found.aim.gains(),
            "map": use,
            "map_errors": found.errors,
            "kernel": "anisotropic" if self.scene.follow_lobes else "isotropic",
            "error_behind_lobes": found.lobes,
            "memory_estimate": self.plan.bytes / memory.GIB,
            "wavefront_light_paths": self.plan.light_paths,
            "wavefront_eye_samples": self.plan.eye_samples,
            **self.done.counts,
            "replayed": self.frozen,
            "relative_error": None,
            "interrupted": False,
            "seconds": self.clock.seconds,
        }
        if earlier:
            self._go_on_from(earlier)

    def _job(self) -> tuple[memory.Job, Callable[[], float]]:
        """What is to be held in memory, with a bound to the photons, and how to count those."""
        scene, pixels = self.scene, films.pixel_count(self.film)
        s = scene.settings
        # Roulette ends paths with a chance of at least 1/20 a segment.
        bound = min(s.depth_limit, s.rr_depth + 20) * s.photon_count if scene.needs_map else 0
        at_once = pixels * self._samples_at_once(self.shares.each + bool(self.shares.one_more))
        channels = self.film.create_block().channel_count()
        channels += self.layered.channels if self.layered else 0
        job = memory.Job(bound, pixels, channels, self.keeps_variance, at_once)
        return job, lambda: photons_per_path(scene, self.seed) * s.photon_count

    def _samples_at_once(self, spp: int) -> int:
        """Samples a pixel of a wavefront, where memory is no question."""
        pixels = films.pixel_count(self.film)
        return max(1, min(spp, WAVEFRONT // self.scene.crowding // pixels))

    @property
    def keeps_variance(self) -> bool:
        """Variances are worth their memory where there can be any, now or after a merge."""
        kept = self.controls.checkpoint is not None or self.controls.settled is not None
        return kept or self.scene.settings.passes != 1

    def _go_on_from(self, earlier: state.State):
        path = self.controls.checkpoint.path
        earlier.check_same(self.identity, path)
        first, count = self.controls.first_pass, self.scene.settings.passes
        end = first + count if count else math.inf
        if any(a < first or b > end for a, b in earlier.passes):
            wanted = f"{first}-{end - 1}" if count else f"{first} and later"
            raise state.StateError(
                f"{path}: holds passes {state.describe(earlier.passes)}, "
                f"but passes {wanted} are asked for"
            )
        counts = {name: earlier.statistics[name] for name in self.done.counts}
        sums = Sums.from_arrays(earlier.arrays)
        self.done = _Done(sums, earlier.passes, counts, earlier.layer_sums() or None)
        self.stopping.spent_before = earlier.seconds
        self.statistics |= counts
        self.clock.go_on_from(earlier.statistics["seconds"])

    # --- Passes ---

    def numbers(self):
        """Pass numbers to render, until a rule says stop."""
        first, count = self.controls.first_pass, self.scene.settings.passes
        done = set(state.numbers(self.done.passes))
        self._check_error()
        for index in range(first, first + count) if count else itertools.count(first):
            if index in done:
                continue
            if self.stopping.reached(len(done), self.statistics["relative_error"]):
                return
            yield index
            done.add(index)

    def render_pass(self, index: int):
        """One pass, from photons to sums, and what is due after it."""
        with self.stopping.measured():
            try:
                image, counts = self._trace_pass(index)
            except RuntimeError as error:
                # Dr.Jit cannot record every scene (materials written in Python, for example).
                if is_interrupt(error) or not self.frozen:
                    raise
                self.frozen, self.scene = False, self.scene.thawed()
                self.statistics["replayed"] = False
                image, counts = self._trace_pass(index)

            # --- One more pass is done ---
            sums = self.done.sums
            if sums is None:
                sums = Sums.zeros(image.shape, self.keeps_variance)
            total = {name: n + counts.get(name, 1) for name, n in self.done.counts.items()}
            passes = state.extended(self.done.passes, index)
            layers = self.layers and plus(self.done.layers, whole_pass(self.layers))
            self.done = _Done(sums.plus(image), passes, total, layers)
            self.unfinished = None
            self.statistics |= {**total, "radius": self.radius}
            estimate = self.plan.with_stored(self.photons.most).bytes / memory.GIB
            self.statistics["memory_estimate"] = estimate
            self._check_error()
            self.clock.lap("film")
            self._report(index, 1)
            self._after_pass(index)

    def begin(self):
        """Forget all passes that are done."""
        self.done = _Done(None, [], dict.fromkeys(self.done.counts, 0), None)
        self.clock.seconds.clear()

    def batch(self) -> Batch:
        """The passes since ``begin``."""
        sums, passes, counts, layers = self.done
        return Batch(passes, sums.arrays() | (layers or {}), counts, dict(self.clock.seconds))

    def add(self, batch: Batch):
        """Passes that were rendered elsewhere, and what is due after them."""
        sums, passes, counts, layers = self.done
        more = Sums.from_arrays(batch.arrays)
        sums = more if sums is None else sums.joined(more)
        total = {name: n + batch.counts[name] for name, n in counts.items()}
        others = {name: array for name, array in batch.arrays.items() if name not in NAMES}
        layers = plus(layers, others) if others else layers
        self.done = _Done(sums, state.joined([*passes, *batch.passes]), total, layers)
        self.clock.go_on_from(batch.seconds)
        last = self.done.passes[-1][1] - 1
        self.radius = bandwidth(self.radius0, self.scene.settings.alpha, last)
        self.statistics |= {**total, "radius": self.radius}
        self._estimate_error()
        self._report(last, 1)
        self._after_pass(last)

    def _trace_pass(self, index: int):
        """(image as film blocks hold it, counts) of one pass."""
        # --- Photons ---
        self.unfinished = self.layers = None
        self.radius = bandwidth(self.radius0, self.scene.settings.alpha, index)
        colour = wavelength_sample(self.seed, index)
        wavelengths = films.wavelengths(self.sensor, colour) if mi.is_spectral else None
        self.map = self.scene.photon_map(
            self.seed, index, self.photons.room, wavelengths, self.clock.lap
        )
        self.photons.seen(self.map.stored)
        counts = dict.fromkeys(_COUNTS, 0)
        counts["photons_emitted"] = self.map.emitted
        counts["photons_stored"] = self.map.stored
        counts["photons_rejected"] = self.map.rejected

        # --- Eye paths ---
        share = self.shares(index)
        for image, done in self._eye_pass(index, share, colour, counts):
            self.unfinished = image, dict(counts), self.layers
            if done < 1:
                self._report(index, done)
        counts["spp"] = share
        return image, counts

    def _eye_pass(self, index, spp, colour, counts):
        """Trace ``spp`` eye samples a pixel against the map, wavefront by wavefront; yields (image
        so far as film blocks hold it, share of the pass that is done). Where memory is short a
        wavefront has a part of the pixels, one sample each."""
        scene, sensor, map_ = self.scene, self.sensor, self.map
        film, pixels = sensor.film(), self.allotment.pixels
        most = min(max(pixels, WAVEFRONT // scene.crowding), self.plan.eye_samples)
        # An array, not a number: as a literal it would make every pass compile kernels of its own.
        radius = dr.opaque(mi.Float, self.radius)
        pixel = scene.footprint and scene.footprint.in_pass(index)
        sampler = mi.load_dict({"type": "owen_sobol"})
        each, before = self.allotment.each, self.shares.before(index) - index * self.allotment.each
        image = None
        parts = self.allotment.wavefronts(index, spp - each, before, most)
        for wavefront, (lanes, done) in enumerate(parts):
            sampler.begin(stream_seed(self.seed, EYE), lanes.pixel, lanes.sample)
            ray, ray_weight, position = films.sample_rays(sensor, sampler, lanes.pixel, colour)
            dr.eval(ray, ray_weight, position)
            thinning = None
            if self.share is not None:
                random = stream_seed(self.seed, THINNING)
                thinning = Thinning.of(self.share, random, lanes.pixel, lanes.sample)

            # --- Eye paths and density estimation ---
            if pixel is not None:
                scene = replace(scene, footprint=pixel.seen_by(lanes.pixel))
            seed = mi.sample_tea_32(stream_seed(self.seed, PROBE, index), wavefront)[0]
            room = self.points.room
            seen = scene.radiance(
                sampler, ray, map_, radius, seed, room, self.clock.lap, thinning, True
            )
            self._count(seen.gathered, counts)

            # --- Into the image ---
            finite = dr.all(dr.isfinite(seen.L))
            counts["eye_samples_rejected"] += dr.width(seen.L) - int(dr.count(finite)[0])
            L = dr.select(finite, seen.L, 0) * ray_weight
            splats = films.splat(film, position, L, seen.valid, each, ray.wavelengths, lanes.weight)
            image = splats if image is None else image + splats
            dr.eval(image)
            if self.layered is not None:
                found = self.layered.wavefront(
                    position, L, seen.seen, seen.gathered, ray, ray_weight, lanes, finite, each
                )
                self.layers = plus(self.layers, found)
            self.clock.lap("film")
            counts["eye_samples"] += lanes.count
            counts["spp"] = int(spp * done)
            yield image, done

    def _count(self, gathered, counts):
        for found in gathered:
            counts["gather_points"] += dr.width(found.lane)
            counts["gather_points_anisotropic"] += int(dr.count(found.follows)[0])
            counts["gather_points_clamped"] += int(dr.count(found.clamped)[0])
            counts["gather_points_capped"] += int(dr.count(found.capped)[0])
            counts["gather_points_degenerate"] += int(dr.count(found.degenerate)[0])
            counts["gather_points_off_surface"] += int(dr.count(found.lost)[0])
            counts["photons_gathered"] += int(dr.sum(mi.Float64(found.photons))[0])
        self.points.seen(sum(dr.width(found.lane) for found in gathered))

    # --- After a pass ---

    def _check_error(self):
        """Estimate the error after each pass, and rarer the more there are, if anybody asks."""
        asked = self.scene.settings.target_error or self.controls.progress or self.controls.callback
        if asked and self.stopping.is_checkpoint(self.done.counts["passes"]):
            self._estimate_error()

    @property
    def passes(self) -> int:
        """Whole ones that are done."""
        return self.done.counts["passes"]

    def _estimate_error(self):
        sums, count = self.done.sums, self.done.counts["passes"]
        if count > 1 and sums.square is not None:
            mean, self.variance = mean_and_variance(sums.arrays(), count)
            self.statistics["relative_error"] = relative_standard_error(mean, self.variance)

    def _report(self, index: int, part: float):
        if self.controls.progress is None:
            return
        count, error = self.done.counts["passes"], self.statistics["relative_error"]
        total = self.stopping.expected_total(count, error)
        number = f"pass {index + 1}"
        if self.scene.settings.passes:
            number += f"/{self.controls.first_pass + self.scene.settings.passes}"
        text = number + (f", error {error:.2%}" if error else "")
        with self.stopping.not_counted():
            self.controls.progress(count + part if part < 1 else count, total, text)
        self.clock.lap("output")

    def report_elsewhere(self, count: int):
        """Tell that ``count`` passes are rendered, not all of which are here."""
        if self.controls.progress:
            error = self.statistics["relative_error"]
            total = self.stopping.expected_total(count, error)
            text = f"{count} passes" + (f", error {error:.2%}" if error else "")
            self.controls.progress(count, total, text)

    def _after_pass(self, index: int):
        checkpoint, callback = self.controls.checkpoint, self.controls.callback
        due = checkpoint is not None and checkpoint.due()
        if due or callback:
            films.show(self.film, self.done.sums.film_tensor())
            if due:
                self._estimate_error()
            if self.controls.so_far:
                self.controls.so_far(self.variance, self.done.layers, self.passes)
        if callback:
            with self.stopping.not_counted():
                callback(index, self.film.develop(), dict(self.statistics))
        if due:
            checkpoint.write(self._state())
            if checkpoint.on_write:
                checkpoint.on_write()
        if due or callback:
            self.clock.lap("output")

    def _state(self) -> state.State:
        return state.State(
            self.identity,
            films.describe(self.film),
            self.done.passes,
            self.stopping.spent(),
            self.statistics,
            self.done.sums.arrays() | (self.done.layers or {}),
        )

    # --- At the end ---

    def keep_unfinished(self) -> bool:
        """After an interruption: is there a picture? Whole passes only, or the wavefronts of the
        first one."""
        if self.done.sums is None and self.unfinished is not None:
            image, counts, layers = self.unfinished
            sums = Sums.zeros(image.shape, False).plus(image)
            self.done = _Done(sums, [], counts | {"passes": 0}, layers)
        return self.done.sums is not None

    def finish(self):
        """The picture into the film, the state to the disk."""
        self.statistics |= self.done.counts
        if self.done.sums is not None:
            films.show(self.film, self.done.sums.film_tensor())
        if self.done.passes:
            self._estimate_error()
            if self.controls.checkpoint:
                self.controls.checkpoint.write(self._state())
