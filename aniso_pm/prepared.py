"""A Mitsuba scene with what was found out about it once, and the stages of a pass on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from . import density, eye, photons
from .needs import Needs, read_scene
from .settings import Settings

# Independent streams of random numbers.
EYE, PROBE, PHOTONS, PILOT = range(4)
# Longest path that a photon can tell from a longer one (see photons.segments).
_SEGMENTS_MAX = 255


class Unsupported(ValueError):
    """The variant or the scene asks for something that this integrator does not do."""


@dataclass(frozen=True)
class Prepared:
    """A scene, its needs, the parameters, and the decisions that follow from them."""

    scene: Any
    needs: Needs
    settings: Settings
    hide_emitters: bool

    def with_(self, **changes) -> Prepared:
        """The same scene with some parameters changed."""
        return replace(self, settings=self.settings.with_(**changes))

    @property
    def extent(self) -> float:
        """Diagonal of the scene's bounding box, world units."""
        return float(dr.norm(self.scene.bbox().extents()))

    @property
    def follow_lobes(self) -> bool:
        """Keep the reflection lobes of eye paths?"""
        return self.settings.kernel == "anisotropic" and len(self.needs.lobes) > 0

    @property
    def deep(self) -> bool:
        """May gather points lie deeper than the first vertex?"""
        return len(self.needs.chains) > 0

    @property
    def gather_depth(self) -> int:
        """The limit that ``density.estimate`` has to test photons against: none if there is no
        limit, or if all gather points lie at the first vertex and the map keeps the limit. Paths of
        more than 255 segments are not told apart."""
        limit = self.settings.max_depth
        return limit if self.deep and 0 < limit <= _SEGMENTS_MAX else 0

    def photon_map(self, seed: int, index: int, expected: int = 0) -> photons.PhotonMap:
        """Photon map of pass ``index``; empty where nothing in the scene could use one."""
        limit = self.settings.depth_limit
        if limit < 3 or not self.needs.receivers or not self.scene.emitters():
            return photons.PhotonMap(0, 0, 0, None, None)
        return photons.build_map(
            self.scene,
            self.settings.photon_count,
            stream_seed(seed, PHOTONS, index),
            limit - 1,
            self.settings.rr_depth,
            expected,
        )

    def walk(self, sampler, ray, active):
        """(radiance, valid, GatherPoints) of camera rays; see ``eye.walk``."""
        return eye.walk(
            self.scene,
            sampler,
            ray,
            self.settings.depth_limit,
            self.settings.rr_depth,
            self.hide_emitters,
            self.follow_lobes,
            self.deep,
            active,
        )

    def gather(self, map_, radius, sampler, points) -> density.Gathered:
        """Reflected radiance at gather points, edges compensated where that is asked for.

        radius: bandwidth, world units; a Dr.Jit array, so that its value is no part of the kernel.
        """
        s = self.settings
        options = density.KernelOptions(
            self.follow_lobes, s.rule, s.size, s.epsilon, s.guard, s.max_aspect
        )
        kernel, follows, degenerate = density.kernels(points, radius, options)
        L, count = density.estimate(map_, points, kernel, radius, self.gather_depth, points.active)
        lost = mi.Bool(False)
        if s.edge_compensation:
            lit = points.active & (count > 0)
            inverse, lost = density.probe_surface(self.scene, sampler, points, kernel, radius, lit)
            L *= inverse
        clamped, capped = follows & kernel.clamped, follows & kernel.capped
        return density.Gathered(L, count, follows, clamped, capped, degenerate, lost)


def prepare(scene, settings: Settings, hide_emitters: bool) -> Prepared:
    """Read the scene. Raises Unsupported with one sentence where it cannot be rendered."""
    if mi.is_spectral:
        raise Unsupported(
            f'aniso_pm: variant "{mi.variant()}" is not supported (photons and eye paths would '
            "have to share wavelengths); choose llvm_ad_rgb, llvm_ad_mono or their cuda_ twins"
        )
    if mi.is_polarized:
        raise Unsupported(
            f'aniso_pm: variant "{mi.variant()}" is not supported (photons carry no '
            "polarisation); choose llvm_ad_rgb or another unpolarized variant"
        )
    try:
        needs = read_scene(scene)
    except ValueError as error:
        raise Unsupported(str(error)) from None
    _repair_bounds(scene)
    prepared = Prepared(scene, needs, settings, hide_emitters)
    radius, extent = settings.initial_radius, prepared.extent
    if radius and scene.shapes() and not 1e-7 * extent <= radius <= 10 * extent:
        raise Unsupported(
            f'aniso_pm: parameter "initial_radius" is {radius:g}, but the scene is {extent:g} '
            f"large; give a length between {1e-7 * extent:g} and {10 * extent:g}, or 0 (automatic)"
        )
    return prepared


def _repair_bounds(scene):
    """Give every mesh its bounding box.

    Mitsuba merges meshes that share a BSDF and leaves the merged one without a bounding box. The
    scene then seems smaller than it is, or infinite: lights that surround the scene aim their
    photons elsewhere and there is no extent to choose a bandwidth from.
    """
    broken = [shape for shape in scene.shapes() if not shape.bbox().valid()]
    for shape in broken:
        parameters = mi.traverse(shape)
        if "vertex_positions" in parameters:
            parameters.set_dirty("vertex_positions")
            parameters.update()
    if broken:
        scene.parameters_changed()
        for emitter in scene.emitters():
            emitter.set_scene(scene)


def stream_seed(seed: int, stream: int, index: int = 0) -> int:
    """Seed of an independent stream of random numbers, by rounds of a block cipher (TEA)."""
    return mi.sample_tea_32(mi.sample_tea_32(seed, 4 * index + stream)[0], 0x5EED)[0]
