"""Before the first pass: what the pilot chooses, or an earlier run has chosen, and what follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from ..arrays import own
from ..errors import is_interrupt, one_line
from . import advice, digest, footprint, memory
from . import film as films
from .allotment import Allotment
from .controls import Controls
from .layered import Layered
from .pilot import look_for_shadows, photons_per_path, settle
from .prepared import Prepared
from .schedule import Shares, sample_count, shares
from .settled import Settled

# Eye samples traced at once, where there is memory for them (see ``memory``).
WAVEFRONT = 1 << 21


@dataclass(frozen=True)
class Decided:
    """What a rendering goes by in all of its passes.

    scene      with all that was chosen for it.
    settled    what that was.
    shares     samples of each pass; allotment: of each pixel.
    gathers    share of the eye paths of each pixel that gather (mi.Float); None: all do.
    layered    layers that are summed, or None.
    wavefronts  that fit into the memory.
    variance   is the spread of passes kept?
    replayed   passes are traced in Python once and then replayed.
    """

    scene: Prepared
    settled: Settled
    shares: Shares
    allotment: Allotment
    gathers: Any
    layered: Layered | None
    wavefronts: memory.Wavefronts
    variance: bool
    replayed: bool

    @property
    def wavefront(self) -> int:
        """Most eye samples at once."""
        room = max(self.allotment.pixels, WAVEFRONT // self.scene.crowding)
        return min(room, self.wavefronts.eye_samples)

    def identity(self, sensor, seed: int) -> dict[str, Any]:
        """What a state has to agree in, to be gone on from (see ``digest``)."""
        return digest.identity(self.scene, sensor, seed, self.shares.text) | {
            digest.USE: self.settled.use,
            digest.LOBES: self.scene.follow_lobes,
            digest.RADIUS: self.settled.radius,
            digest.COUNT: self.settled.count,
            digest.SAMPLES: self.shares.each,
        }

    def statistics(self, given) -> dict[str, Any]:
        """Those that are known before the first pass. given: the settings before the choice."""
        settled = self.settled
        return {
            "initial_radius": settled.radius,
            "radius_automatic": given.initial_radius == 0,
            "share_of_gathers": float(settled.share.mean(dtype=float)),
            "photon_count": settled.count,
            "photon_count_automatic": given.photon_count == 0,
            "aim": settled.aim and settled.aim.gains(),
            "focus": settled.focus and asdict(settled.focus),
            "map": settled.use,
            "map_errors": settled.errors,
            "kernel": "anisotropic" if self.scene.follow_lobes else "isotropic",
            "error_behind_lobes": settled.lobes,
            "memory_estimate": self.wavefronts.bytes / memory.GIB,
            "wavefront_light_paths": self.wavefronts.light_paths,
            "wavefront_eye_samples": self.wavefronts.eye_samples,
            "replayed": self.replayed,
        }


def decide(
    scene: Prepared, sensor, seed: int, spp: int, controls: Controls, known: Settled | None
) -> Decided:
    """Run the pilot, and make ready for passes.

    spp    as in ``progressive.render``.
    known  what was chosen elsewhere, or by an earlier run that is gone on from: there is no pilot.

    Raises ValueError where samples, layers or memory do not fit; for what reason it says.
    """
    film, settings = sensor.film(), scene.settings
    pixels = films.pixel_count(film)
    share = shares(settings, sample_count(settings, spp, sensor), pixels, controls.first_pass)
    layered = Layered.of(film, settings.layer_names)
    advice.before(scene)
    films.begin(film, bool(controls.callback or controls.checkpoint))

    # --- What is chosen ---
    scene = look_for_shadows(scene, sensor)
    scene, settled = _settle(scene, sensor, seed, share.each, known)
    settled = replace(
        settled,
        count=settings.photon_count or settled.count,
        radius=settings.initial_radius or settled.radius,
    )
    share = replace(share, each=settled.each)
    scene = settled.applied(scene)

    # --- What follows ---
    # Variances are worth their memory where there can be any, now or after a merge.
    kept = controls.checkpoint is not None or controls.settled is not None
    variance = kept or (controls.spread and settings.passes != 1)
    wavefronts = memory.fitting(scene, *_job(scene, film, seed, share, layered, variance))
    scene = replace(scene, light_wavefront=wavefronts.light_paths)
    if not settings.initial_radius:
        pixel = footprint.of(sensor, settled.radius, settled.widths)
        scene = replace(scene, footprint=pixel)
    gathers = None
    if settled.share.min() < 1:
        gathers = own(mi.Float, np.resize(settled.share, pixels))
    replayed = settings.passes != 1 and scene.replays
    counts = None if settled.counts is None else settled.counts.astype(np.int64)
    allotment = Allotment(pixels, settled.each, counts)
    return Decided(
        scene, settled, share, allotment, gathers, layered, wavefronts, variance, replayed
    )


def _settle(
    scene: Prepared, sensor, seed: int, each: int, known: Settled | None
) -> tuple[Prepared, Settled]:
    """(the scene, frozen if it can be, what is chosen)."""
    # The response curves of a specfilm do not survive a replay of the scene that they are in.
    if not mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
        frozen = scene.frozen()
        try:
            return frozen, known or settle(frozen, sensor, seed, each)
        except RuntimeError as error:
            # Dr.Jit cannot record every scene (materials written in Python, for example).
            if is_interrupt(error):
                raise
            mi.Log(mi.LogLevel.Debug, f"aniso_pm: nothing is replayed: {one_line(error)}")
    return scene, known or settle(scene, sensor, seed, each)


def _job(
    scene: Prepared, film, seed: int, share: Shares, layered: Layered | None, variance: bool
) -> tuple[memory.Job, Callable[[], float]]:
    """What is to be held in memory, with a bound to the photons, and how to count those."""
    s, pixels = scene.settings, films.pixel_count(film)
    # Roulette ends paths with a chance of at least 1/20 a segment.
    bound = min(s.depth_limit, s.rr_depth + 20) * s.photon_count if scene.needs_map else 0
    most = share.each + bool(share.one_more)
    at_once = max(1, min(most, WAVEFRONT // scene.crowding // pixels))
    channels = film.create_block().channel_count() + (layered.channels if layered else 0)
    job = memory.Job(bound, pixels, channels, variance, pixels * at_once)
    return job, lambda: photons_per_path(scene, seed) * s.photon_count
