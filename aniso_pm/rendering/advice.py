"""Warnings about what a scene or its parameters will do, or have done, to the picture."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .pilot import LARGEST
from .prepared import Prepared
from .schedule import SPECTRAL_PASSES

# Anisotropic meshes without texture coordinates that warnings name.
_NAMED = 3
# Photons in the mean kernel below which a radius that was given cannot be meant.
_FEWEST_IN_KERNEL = 0.1
# Share of a scene's extent by which rays may begin off surfaces; energy is wrong by as much.
_LARGEST_OFFSET = 0.005


def before(scene: Prepared) -> None:
    """Of what can be seen without rendering."""
    if not scene.scene.emitters():
        mi.Log(
            mi.LogLevel.Warn,
            "aniso_pm: the scene has no emitters; the picture will be black. Add one, or give "
            'a shape the emitter "area"',
        )
    for surface in scene.needs.grainless[:_NAMED]:
        mi.Log(
            mi.LogLevel.Warn,
            f'aniso_pm: the mesh "{surface}" is anisotropic but has no texture coordinates: '
            "its grooves run along the first edge of every triangle. Give it texture "
            "coordinates (u along the grooves' alpha_u)",
        )
    _ray_offset(scene)
    _large_radius(scene)
    target = scene.settings.target_error
    if target >= 1:
        mi.Log(
            mi.LogLevel.Warn,
            f'aniso_pm: parameter "target_error" is {target:g}: rendering ends at a standard error '
            f"of {target:.0%} of the picture. It is relative: 0.02 is 2 %",
        )
    passes = scene.settings.passes
    if mi.is_spectral and 0 < passes < SPECTRAL_PASSES:
        few = f"{passes} passes" if passes > 1 else "one pass"
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: all light of a pass shares four wavelengths; {few} will give "
            f'wrong colours, set the parameter "passes" to {SPECTRAL_PASSES} or more',
        )


def after(scene: Prepared, statistics: dict[str, Any]) -> None:
    """Of what the statistics of a rendering tell."""
    emitted = statistics["photons_emitted"]
    if statistics["photons_rejected"] > 1e-3 * emitted:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: {statistics['photons_rejected']} times in {emitted} light paths a flux was "
            "not finite and was dropped; an emitter or a BSDF returns NaN or infinity",
        )
    if statistics["eye_samples_rejected"]:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: {statistics['eye_samples_rejected']} of {statistics['eye_samples']} eye "
            "samples were not finite and count as black",
        )
    if emitted and not statistics["photons_stored"]:
        lost = "light over glass, mirrors and metal" if statistics["map"] == "caustic" else "light"
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: none of {emitted} light paths left a photon; if {lost} should reach what "
            'the camera sees, it is missing: give more of them (parameter "photon_count")',
        )
    points = statistics["gather_points"]
    if scene.settings.initial_radius and points and statistics["photons_stored"]:
        mean = statistics["photons_gathered"] / points
        if mean < _FEWEST_IN_KERNEL:
            _warn_of_radius(
                scene, f"kernels hold {mean:.2g} photons in the mean, the rest is noise"
            )


def _ray_offset(scene):
    """Mitsuba starts rays (1 + max |p|) ε off the surface at p: world units, not the scene's."""
    if not scene.scene.shapes():
        return
    box = scene.scene.bbox()
    farthest = float(dr.max(dr.maximum(dr.abs(box.min), dr.abs(box.max))))
    offset = (1 + farthest) * mi.math.RayEpsilon
    if offset > _LARGEST_OFFSET * scene.extent:
        mi.Log(
            mi.LogLevel.Warn,
            f"aniso_pm: the scene is {scene.extent:.3g} large and up to {farthest:.3g} from the "
            f"origin, where Mitsuba starts rays {offset:.2g} off surfaces: light passes through "
            'edges and contacts, with "path" as well. Move the scene to the origin, or scale it '
            "to a size of 1 to 1000",
        )


def _large_radius(scene):
    if scene.needs_map and scene.settings.initial_radius > LARGEST * scene.extent:
        wrong = "kernels reach across much of it, blur everything, and take long to sum"
        _warn_of_radius(scene, wrong)


def _warn_of_radius(scene, wrong):
    """A radius that somebody has chosen may be right in other units."""
    mi.Log(
        mi.LogLevel.Warn,
        f'aniso_pm: parameter "initial_radius" is {scene.settings.initial_radius:g} in a scene '
        f"that is {scene.extent:.3g} large: {wrong}. Lengths are in world units; 0 is automatic",
    )
