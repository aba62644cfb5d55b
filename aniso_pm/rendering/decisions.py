"""A Mitsuba scene with what was found out about it, and what follows from that and from the
parameters. Decided in Python, once, before anything is traced."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map import density, photon_word
from ..map.photon_map import flux_bytes
from ..transport import emission, layers
from ..transport.focus import Focus
from ..transport.uses import Use
from .needs import Needs
from .settings import Settings

# Lobes are followed where kernels behind them make so much of the error. They cost up to a seventh
# of the time (thin ellipses a third). Before kernels ended at walls, following them saved a third
# of the error where half of it was theirs, and less than its cost where a fifth to three tenths
# were; since then both kinds are equal there (docs/performance.md).
WORTH_FOLLOWING = 1 / 3


@dataclass(frozen=True)
class Decisions:
    """A scene, its needs, the parameters, and what a pilot has chosen."""

    scene: Any
    needs: Needs
    settings: Settings
    hide_emitters: bool
    emission: emission.Emission | None
    chosen: Use | None = None  # use of the map that a pilot has found best, see ``undecided``
    rare: tuple[str, ...] = ()  # emitters whose caustics are photons' on glossy surfaces, too
    lobes_matter: bool = True  # kernels that follow lobes: a pilot may find that they do not
    focus: Focus | None = None  # where light from outside begins; None: anywhere

    @property
    def extent(self) -> float:
        """Diagonal of the scene's bounding box, world units."""
        return float(dr.norm(self.scene.bbox().extents()))

    @property
    def follow_lobes(self) -> bool:
        """Keep the reflection lobes of eye paths?"""
        matter = self.settings.kernel != "isotropic" and self.lobes_matter
        return matter and len(self.needs.lobes) > 0

    @property
    def lobes_are_dispensable(self) -> bool:
        """May a pilot choose discs everywhere? Not where somebody says how many photons, or how
        large kernels are to be."""
        s = self.settings
        asked = s.photon_count or s.initial_radius or s.size == "epsilon"
        return s.kernel == "auto" and not asked

    def worth_following(self, part: float) -> bool:
        """Are lobes, if kernels that follow them make this part of the error?"""
        return part >= WORTH_FOLLOWING or not self.lobes_are_dispensable

    @property
    def deep(self) -> bool:
        """May gather points lie deeper than the first vertex?"""
        return len(self.needs.chains) > 0

    @property
    def glossy(self) -> bool:
        """Are caustics on glossy surfaces the map's as well (see ``glossy_caustics``)?"""
        return self.needs_map and bool(self.rare)

    @property
    def glossy_is_dispensable(self) -> bool:
        """May a pilot leave them to chance? Not what emitters cast that no path meets."""
        return not self._has_delta

    @property
    def undecided(self) -> bool:
        """Is it for a pilot to say how the map is best used? ``map=auto`` has no choice where there
        are no surfaces that paths walk on (nothing casts caustics: path tracing is best), nor where
        there is light that only photons find (it takes the global map)."""
        automatic = self.settings.map == "auto" and not self.settings.final_gather
        return automatic and self.use == "global" and not self.needs.unseen and not self.chosen

    @property
    def use(self) -> Use:
        """How eye paths use the map; see ``uses``. As long as nobody has chosen, ``auto`` is
        "global" where there is anything to choose."""
        if self.chosen:
            return self.chosen
        read = bool(self.needs.receivers or self.rare)
        wanted = read and self.settings.depth_limit > self.min_segments
        if not wanted or self.emission is None:
            return "none"
        if self.settings.final_gather:
            return "final_gather"
        if not self.deep and not self.needs.unseen and self.settings.map != "global":
            return "none"
        return "global" if self.settings.map == "auto" else self.settings.map

    @property
    def photons_are_dispensable(self) -> bool:
        """May a pilot choose path tracing? Not where eye paths cannot find all light by themselves
        (a point emits it, or a direction has all of it: what such a light sends over a mirror is
        found by photons only), and not where somebody says how many photons, or how large kernels
        are to be."""
        asked = self.settings.photon_count or self.settings.initial_radius
        return not asked and not self._has_delta

    @property
    def _has_delta(self) -> bool:
        delta = mi.EmitterFlags.Delta
        return any(mi.has_flag(e.flags(), delta) for e in self.scene.emitters())

    @property
    def crowding(self) -> int:
        """How many times fewer eye paths than usual are traced at once: where paths leave gather
        points at several vertices, fewer of them fit into the same memory."""
        if not self.needs_map:
            return 1
        if self.use == "caustic":
            return 8
        return 2 if self.use == "final_gather" or self.needs.general or self.glossy else 1

    @property
    def min_segments(self) -> int:
        """Segments of the shortest light path in the map."""
        return 1 if self.needs.unseen else 2

    @property
    def needs_map(self) -> bool:
        """Is there anything for photons to do?"""
        return self.use != "none"

    @property
    def bytes_per_photon(self) -> int:
        """Of a map at rest, index included: position and word, flux, direction, density, and one
        box of 16 bytes for every leaf and every inner node (at most 2 nodes for 4 photons), which
        have their sums, too, where ``gather_tolerance`` asks for them."""
        node = 16 + (20 + flux_bytes() if self.settings.gather_tolerance else 0)
        direction = 4 if self.needs.general or self.glossy else 0
        density = 4 if self.glossy else 0
        return 16 + flux_bytes() + direction + density + node // 2

    @property
    def gather_depth(self) -> int:
        """The limit that ``density.estimate`` has to test photons against: none if there is no
        limit, or if all gather points lie at the first vertex and the map keeps the limit. Paths of
        more than ``photon_word.SEGMENTS_MAX`` segments are not told apart."""
        limit = self.settings.max_depth
        tested = self.deep or self.use != "global"
        return limit if tested and 0 < limit <= photon_word.SEGMENTS_MAX else 0

    @property
    def kernel_options(self) -> density.KernelOptions:
        """How gather points get their kernels."""
        s = self.settings
        return density.KernelOptions(
            self.follow_lobes, s.rule, s.size, s.epsilon, s.guard, s.max_aspect
        )

    @property
    def light_layers(self) -> bool:
        """Does anybody ask for light by how it came?"""
        return any(name in layers.LIGHT for name in self.settings.layer_names)

    @property
    def surface_layers(self) -> bool:
        """Does anybody ask for what eye paths see?"""
        wanted = (*layers.SURFACE, "denoising")
        return any(name in wanted for name in self.settings.layer_names)
