"""The stages of a pass on a scene: photon map, eye paths, density estimation."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import Unsupported
from ..map import density, summed
from ..map.gather_points import GatherPoints, take
from ..map.glossy_caustics import EmitterDensity
from ..map.photon_map import EMPTY, PhotonMap
from ..transport import emission, eye, layers, photons
from ..transport.aim import Aim
from ..transport.amends import repair_bounds
from ..transport.direct_light import DirectLight
from ..transport.focus import Focus
from ..transport.lamps import Lamps
from ..transport.walk import WalkOptions
from . import gathering, replay
from .decisions import Decisions
from .evening import Evening
from .footprint import Footprint
from .gathering import GatherOptions
from .glossy import rarely_met
from .needs import read_scene
from .settings import Settings

# Segments of light paths after which their roulette begins at the latest: photons of equal flux are
# worth more than many faint ones (docs/performance.md).
_LIGHT_ROULETTE = 3

# Independent streams of random numbers (see ``stream_seed``).
EYE, PROBE, PHOTONS, PILOT, COLOUR, THINNING = range(6)
# Those of the pilot: its photons, eye paths of the automatic radius, random camera rays, pairs,
# their pixels, pairs of the finer look.
_, PILOT_EYE, PILOT_CAMERA, PILOT_PAIRS, PILOT_PIXELS, PILOT_FINE, PILOT_SHADOWS = range(7)


@dataclass(frozen=True)
class Radiance:
    """What one wavefront of eye paths saw.

    L         radiance, W/m²/sr, per eye path.
    valid     alpha is 1, per eye path.
    gathered  density.Gathered of all gather points, a list: Lambertian receivers, other ones.
    seen      layers.Seen, where somebody asks for layers.
    """

    L: Any
    valid: Any
    gathered: list[density.Gathered]
    seen: layers.Seen | None = None


@dataclass(frozen=True)
class Launch:
    """The functions that take most time to trace; frozen, they are traced once and replayed."""

    light: Callable = photons.light_paths
    eye: Callable = eye.eye_paths
    gather: Callable = gathering.gather


@dataclass(frozen=True)
class Prepared(Decisions):
    """What was decided about a scene, and how its paths are traced."""

    launch: Launch = Launch()
    light_wavefront: int | None = None  # light paths at once; None: photons.WAVEFRONT
    footprint: Footprint | None = None  # of pixels; None: one bandwidth for all of a pass
    aim: Aim | None = None  # of light paths, if a pilot has found that it pays
    lamps: Lamps | None = None  # where emitters are; None: anywhere
    drawn: EmitterDensity | None = None  # density of drawing emitters, where ``rare``
    direct: DirectLight | None = None  # how emitters are drawn; None: as Mitsuba does

    def with_(self, **changes) -> Prepared:
        """The same scene with some parameters changed."""
        return replace(self, settings=self.settings.with_(**changes))

    def focused(self, focus: Focus | None) -> Prepared:
        """The same scene with light from outside begun above a part of it."""
        if focus is None or self.emission is None:
            return self
        return replace(self, focus=focus, emission=self.emission.focused(focus))

    @property
    def replays(self) -> bool:
        """Is it frozen?"""
        return self.launch != Launch()

    @property
    def towards_lamps(self) -> Lamps | None:
        """Where paths go on that gather all but emission. With other uses they go on anyway."""
        return self.lamps if self.use in ("global", "final_gather") else None

    def thawed(self) -> Prepared:
        """The same scene with nothing frozen."""
        return replace(self, launch=Launch())

    def frozen(self) -> Prepared:
        """The same scene for a pilot and many passes: stages are traced in Python once and then
        replayed."""
        # Scenes that nobody uses any more must not vanish while Dr.Jit records this one: their
        # materials are part of the same virtual function calls.
        gc.collect()
        stages = photons.light_paths, eye.eye_paths, gathering.gather
        return replace(self, launch=Launch(*map(replay.frozen, stages)))

    def photon_map(
        self,
        seed: int,
        index: int,
        expected: int = 0,
        wavelengths=None,
        lap=lambda stage: None,
        remember: bool = False,
    ) -> PhotonMap:
        """Photon map of pass ``index``; empty where nothing in the scene could use one.

        wavelengths: nm, of the photons, in spectral variants. lap: called with the name of each
        stage that ends, "photons" and "index". remember: where light paths began.
        """
        if not self.needs_map:
            return EMPTY
        s = self.settings
        plain = "marked" if self.light_layers else "ignored"
        options = photons.TraceOptions(
            max_depth=s.depth_limit - 1,
            rr_depth=min(s.rr_depth, _LIGHT_ROULETTE),
            caustics={"global": plain, "caustic": "only"}.get(self.use, "marked"),
            general=bool(self.needs.general),
            roughness=s.gather_roughness,
            unseen_light=bool(self.needs.unseen),
            bent=bool(self.needs.bent),
            glossy=self.drawn if self.glossy else None,
            wavelengths=wavelengths,
            aim=self.aim,
            remember=remember,
        )
        seed = stream_seed(seed, PHOTONS, index)
        map_ = photons.build_map(
            self.scene,
            self.emission,
            s.photon_count,
            seed,
            options,
            expected=expected,
            launch=self.launch.light,
            lap=lap,
            wavefront=self.light_wavefront,
        )
        # A pilot asks what each photon gives, and reads parts of its maps.
        if s.gather_tolerance > 0 and map_.stored and not remember:
            map_ = replace(map_, sums=summed.build(map_))
            lap("index")
        return map_

    def trace(
        self, sampler, ray, expected: int = 0, watch=None, thinning=None, for_layers: bool = False
    ):
        """(radiance, valid, GatherPoints or None) of camera rays; see ``eye.trace``, and
        ``Thinning``. watch: returns ``walk``'s ``see``, whenever all paths are traced (again).
        for_layers: keep what layers need that are asked for."""
        s = self.settings
        options = WalkOptions(
            use=self.use,
            max_depth=s.depth_limit,
            rr_depth=s.rr_depth,
            min_segments=self.min_segments,
            hide_emitters=self.hide_emitters,
            gathers=self.needs_map,
            follow_lobes=self.follow_lobes and self.needs_map,
            deep=self.deep,
            general=bool(self.needs.general),
            roughness=s.gather_roughness,
            glossy=self.drawn if self.glossy else None,
            measure=self.footprint is not None and self.needs_map,
            thinning=thinning,
            light=for_layers and self.light_layers,
            surface=for_layers and self.surface_layers,
            lamps=self.towards_lamps,
            direct=self.direct,
        )
        launch = self.launch.eye
        if watch:  # what watches cannot be frozen
            launch = lambda *wavefront: eye.eye_paths(*wavefront, see=watch())  # type: ignore[misc]  # noqa: E731
        return eye.trace(self.scene, sampler, ray, options, expected, launch)

    def gather(
        self,
        map_,
        radius,
        seed: int,
        points: GatherPoints,
        wavelengths=None,
        scores=None,
        for_layers: bool = False,
    ) -> list[density.Gathered]:
        """Reflected radiance at gather points, edges compensated where that is asked for.

        radius       bandwidth, world units; a Dr.Jit array, so that its value is no part of the
                     kernel.
        wavelengths  nm, of the eye paths, in spectral variants.
        scores       None, or a column of zeros, one for each photon, and the weight of each eye
                     path (see ``density.estimate``).
        for_layers   find what layers need that are asked for.
        """
        o = self.gather_options
        if for_layers:
            wanted = "radius" in self.settings.layer_names
            o = replace(o, light=self.light_layers, radius=wanted)
        map_, seed = map_.numbered(), dr.opaque(mi.UInt32, seed)

        def gather(some, **changes):
            options = replace(o, **changes)
            scored = None
            if scores:
                # A weight for each point: Dr.Jit traces anew where sizes of arrays coincide or not.
                scored = scores[0], dr.gather(mi.Float, scores[1], some.lane)
                dr.eval(scored[1])
            found = self.launch.gather(
                self.scene, map_, radius, seed, some, self.footprint, wavelengths, scored, options
            )
            # One kernel for all of it: a reduction by itself would run the whole gather again.
            dr.eval(found)
            return found

        if points.lambertian is None:
            return [gather(points)]
        kinds: list[tuple[Any, dict[str, Any]]] = [(points.lambertian, {})]
        roughness = self.settings.gather_roughness
        glossy: Any = mi.Bool(False) if points.glossy is None else points.glossy
        if self.needs.general:
            kinds.append((~points.lambertian & ~glossy, {"roughness": roughness}))
        if points.glossy is not None:
            shining = tuple(sorted(self.needs.shining))
            changes = {"roughness": roughness, "glossy": True, "receiving": shining}
            kinds.append((glossy, changes))
        parts = []
        for some, changes in kinds:
            index = dr.compress(some)
            if dr.width(index):
                parts.append(gather(take(points, index), **changes))
        return parts

    @property
    def gather_options(self) -> GatherOptions:
        """For gather points on Lambertian receivers, without layers."""
        s = self.settings
        return GatherOptions(
            kernel=self.kernel_options,
            max_depth=self.gather_depth,
            compensate=s.edge_compensation,
            receiving=tuple(sorted(self.needs.receiving)) if self.deep else None,
            roughness=None,
            glossy=False,
            tolerance=s.gather_tolerance,
            use=self.use,
            unseen=bool(self.needs.unseen),
        )

    def radiance(
        self,
        sampler,
        ray,
        map_,
        radius,
        seed: int,
        expected: int = 0,
        lap=lambda stage: None,
        even: Evening | None = None,
        for_layers: bool = False,
    ) -> Radiance:
        """Radiance along camera rays: their own share and the map's.

        radius    bandwidth, world units: a Dr.Jit array.
        seed        of the random numbers that density estimation takes.
        expected    gather points to make room for.
        lap         called with the name of each stage that ends.
        even        which eye paths gather, and what evens that out; None: all do.
        for_layers  find what layers need that are asked for.
        """
        L, valid, points = self.trace(
            sampler,
            ray,
            expected,
            thinning=even.thinning if even else None,
            for_layers=for_layers,
        )
        lap("eye")
        gathered, seen = [], None
        if isinstance(L, layers.Seen):
            seen, L = L, L.radiance
        if points is not None and map_.stored:
            gathered = self.gather(
                map_, radius, seed, points, map_.wavelengths, for_layers=for_layers
            )

            totals, found = [L], [[f.radiance for f in gathered]]
            if seen is not None and gathered and gathered[0].light is not None:
                totals += [getattr(seen.light, name) for name in layers.LIGHT]
                found += [[getattr(f.light, name) for f in gathered] for name in layers.LIGHT]
            lanes = [f.lane for f in gathered]
            if even:
                nothing = dr.zeros(mi.Spectrum, dr.width(ray))
                read = [_scattered(nothing, lanes, values) for values in found]
                totals = [a + b + c for a, b, c in zip(totals, read, even(*read), strict=True)]
            else:
                totals = [_scattered(a, lanes, b) for a, b in zip(totals, found, strict=True)]
            L, *parts = totals
            if parts:
                seen.light = layers.Light(*parts)
            dr.eval(L, seen)
        lap("gather")
        return Radiance(L, valid, gathered, seen)


def _scattered(total, lanes, values):
    """``total`` of each eye path, and the values of its gather points."""
    total = mi.Spectrum(total)
    for lane, value in zip(lanes, values, strict=True):
        # Directly: sums of each thread's own would have their size in the code.
        dr.scatter_add(total, value, lane, mode=dr.ReduceMode.Direct)
    return total


def prepare(scene, settings: Settings, hide_emitters: bool) -> Prepared:
    """Read the scene, and mend what Mitsuba gets wrong of it (``transport.amends``). Raises
    Unsupported with one sentence where it cannot be rendered."""
    if mi.is_polarized:
        raise Unsupported(
            f'aniso_pm: variant "{mi.variant()}" is not supported (photons carry no '
            "polarisation); choose llvm_ad_rgb or another unpolarized variant"
        )
    if dr.flag(dr.JitFlag.FreezingScope):
        raise Unsupported(
            "aniso_pm: cannot render inside of a function with @dr.freeze, since what a scene "
            "needs is decided while rendering; take the decorator away (passes are replayed by "
            "themselves)"
        )
    repair_bounds(scene)  # before light from outside is aimed at them
    needs = read_scene(scene, settings.gather_roughness)
    source = emission.prepare(scene) if scene.emitters() else None
    lamps, direct = Lamps.of(scene), DirectLight.of(scene, source)
    rare = tuple(rarely_met(scene, needs, settings.gather_roughness))
    prepared = Prepared(
        scene, needs, settings, hide_emitters, source, rare=rare, lamps=lamps, direct=direct
    )
    if rare:
        prepared = replace(prepared, drawn=EmitterDensity.of(scene))
    radius, extent = settings.initial_radius, prepared.extent
    if radius and scene.shapes() and not 1e-7 * extent <= radius <= 10 * extent:
        raise Unsupported(
            f'aniso_pm: parameter "initial_radius" is {radius:g}, but the scene is {extent:g} '
            f"large; give a length between {1e-7 * extent:g} and {10 * extent:g}, or 0 (automatic)"
        )
    return prepared


def stream_seed(seed: int, stream: int, index: int = 0) -> int:
    """Seed of an independent stream of random numbers, by rounds of a block cipher (TEA)."""
    return mi.sample_tea_32(mi.sample_tea_32(seed, 8 * index + stream)[0], 0x5EED)[0]
