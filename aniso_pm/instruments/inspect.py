"""What a scene needs of the integrator, what was left out, and why (``aniso-pm inspect``)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..rendering.film import pixel_count
from ..rendering.history import recorded
from ..rendering.needs import emitter_name
from ..rendering.pilot import camera_rays, settle
from ..rendering.prepared import Prepared
from ..rendering.schedule import sample_count, shares, with_passes


@dataclass(frozen=True)
class Finding:
    """One decision: is the part traced and stored, what follows, and the evidence for it."""

    name: str
    needed: bool
    consequence: str
    evidence: list[str]


def examine(scene: Prepared, compile_: bool = False, spp: int = 0) -> list[Finding]:
    """All decisions that were taken for a scene and its integrator's parameters. Where there is a
    map a pilot is traced through the scene's first sensor, as before a rendering of ``spp``
    samples (0: those of the sampler). compile_: say what is compiled, too."""
    asked = scene
    scene, why_map, why_aim, of_lobes = decided(scene, spp)
    needs, settings = scene.needs, scene.settings
    shown = scene.follow_lobes
    why_disc = ["parameter kernel=isotropic" if settings.kernel == "isotropic" else "none found"]
    if not scene.lobes_matter and needs.lobes:
        why_disc = [f"kernel=auto: kernels behind lobes make {of_lobes:.0%} of the error"]
        why_disc += needs.lobes
    mirrors = [e for e in needs.chains if e not in needs.general] or needs.chains
    emitters = [emitter_name(e) for e in scene.scene.emitters()]
    spectrum = f"{dr.size_v(mi.Spectrum)} channels of the variant {mi.variant()}"
    findings = [
        Finding(
            "photon map",
            scene.needs_map,
            f"{scene.use}: photons are traced and gathered"
            if scene.needs_map
            else "no photon is traced: the scene is path traced",
            why_map + (needs.receivers or ["no surface gathers"]),
        ),
        Finding(
            "caustics, specular chains",
            scene.deep,
            "eye paths walk on to deeper gather points" if scene.deep else "eye paths end at once",
            mirrors or ["only Lambertian surfaces"],
        ),
        _glossy(scene, asked),
        Finding(
            "anisotropic lobes",
            shown,
            f"lobes are followed, kernels by rule={settings.rule}"
            if shown
            else "all kernels discs",
            needs.lobes if shown else why_disc,
        ),
        Finding(
            "unreadable roughness",
            bool(needs.unreadable),
            "kernels behind these surfaces are discs" if needs.unreadable else "none",
            needs.unreadable,
        ),
        Finding(
            "grooves without direction",
            bool(needs.grainless),
            "anisotropic meshes need texture coordinates; these have none"
            if needs.grainless
            else "none",
            needs.grainless,
        ),
        Finding(
            "general receivers",
            bool(needs.general),
            "photons keep directions; the BSDF is evaluated for each"
            if needs.general
            else "one BRDF value a gather point, no directions"
            + (" but for glossy caustics" if scene.glossy else ""),
            needs.general or ["all receivers are Lambertian"],
        ),
        Finding(
            "light only photons find",
            bool(needs.unseen),
            "direct light of these is stored too" if needs.unseen else "direct light is not stored",
            needs.unseen,
        ),
        Finding(
            "choice of emitters",
            scene.emission is not None and scene.emission.choose is not None,
            "light paths are shared by power" if len(emitters) > 1 else "nothing to choose",
            emitters or ["the scene has no emitters"],
        ),
        _direct_light(scene),
        Finding(
            "rays that meet no lamp",
            not scene.needs_map or scene.towards_lamps is None,
            "where an eye path can only end at an emitter, traced towards boxes around these"
            if scene.towards_lamps
            else "traced in any direction",
            [],
        ),
        _environment(scene),
        _focus(scene),
        Finding(
            "aimed light paths",
            scene.aim is not None,
            "light paths begin where they show"
            if scene.aim
            else "light paths begin evenly over what emitters emit",
            [why_aim],
        ),
        Finding(
            "path length of photons",
            scene.gather_depth > 0,
            "tested at every gather"
            if scene.gather_depth
            else "not tested: no limit, or the map keeps it",
            [f"max_depth={settings.max_depth}"],
        ),
        Finding(
            "sums over nodes",
            settings.gather_tolerance > 0 and scene.needs_map,
            "groups of photons inside a kernel count as one"
            if settings.gather_tolerance
            else "not built: every photon is summed",
            [f"gather_tolerance={settings.gather_tolerance:g}"],
        ),
        Finding(
            "edge compensation",
            settings.edge_compensation and scene.needs_map,
            "short rays measure how much of each kernel lies on the surface, and end it at walls",
            [f"edge_compensation={str(settings.edge_compensation).lower()}"],
        ),
        Finding(
            "bytes per photon",
            scene.needs_map,
            f"{scene.bytes_per_photon} with its index" if scene.needs_map else "0",
            [spectrum],
        ),
    ]
    return [*findings, kernels(scene)] if compile_ else findings


def _glossy(scene: Prepared, asked: Prepared) -> Finding:
    """Caustics on glossy surfaces. asked: as before a pilot."""
    name, needs = "caustics on glossy surfaces", scene.needs
    if scene.glossy:
        why = "photons there are combined with paths that meet the lamp"
        return Finding(name, True, why, [*needs.glossy, *scene.rare])
    if not needs.glossy or not needs.casting:
        missing = "glossy surface" if not needs.glossy else "sharp glass or mirror"
        return Finding(name, False, f"none: no {missing}", [])
    if asked.rare and not scene.needs_map:
        return Finding(name, False, "left to chance: the scene is path traced", [*asked.rare])
    if asked.rare:
        return Finding(name, False, "left to chance: a pilot found next to none", [*asked.rare])
    return Finding(name, False, "left to chance: paths meet the lamps often enough", needs.glossy)


def _direct_light(scene: Prepared) -> Finding:
    """Which emitters eye paths ask."""
    name, direct, emitters = "direct light", scene.direct, scene.scene.emitters()
    if direct is not None:
        groups = f"{len(emitters)} emitters in {len(direct.groups)} groups"
        why = "emitters are asked by what they may give at the place"
        return Finding(name, True, why, [groups])
    return Finding(name, False, "nothing to choose", [])


def _focus(scene: Prepared) -> Finding:
    """Where light from outside begins."""
    name, focus = "light from outside", scene.focus
    if focus is not None:
        x, y, z = focus.centre
        sphere = f"a sphere of radius {focus.radius:.3g} around {x:.3g}, {y:.3g}, {z:.3g}"
        return Finding(name, True, f"half of it begins above {sphere}, which the camera sees", [])
    there = scene.needs_map and scene.emission is not None and scene.emission.from_outside
    why = "begins evenly above the scene" if there else "no light path begins outside the scene"
    return Finding(name, False, why, [])


def _environment(scene: Prepared) -> Finding:
    """What surrounds the scene, and what its emitter's own rays would have done."""
    found = scene.emission.environment if scene.emission is not None else None
    if found is None:
        return Finding("light from all around", False, "nothing surrounds the scene", [])
    brightness = found.own_brightness()
    wrong = f"would be {brightness:.2f} times as bright" if abs(brightness - 1) > 0.05 else "agrees"
    return Finding(
        "light from all around",
        scene.needs_map,
        "light paths take directions from emitter sampling and start on discs across them",
        [emitter_name(found.emitter), f"its own sample_ray, which is not used, {wrong}"],
    )


def kernels(scene: Prepared) -> Finding:
    """What is compiled for each stage, found by a tiny pass with the scene's first sensor."""
    radius = dr.opaque(mi.Float, scene.settings.initial_radius or 0.01 * scene.extent)
    rays = camera_rays(scene.scene.sensors()[0], 0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, dr.width(rays))
    wavelengths = dr.copy(rays.wavelengths) if mi.is_spectral else None
    evidence, number, operations = [], 0, 0
    with recorded() as records:

        def lap(stage: str):
            nonlocal number, operations
            unique = {k["hash"]: k for k in records()}.values()
            size = sum(k["operation_count"] for k in unique)
            number, operations = number + len(unique), operations + size
            code = sum(len(k["ir"].getvalue()) for k in unique) / 1024
            evidence.append(
                f"{stage}: {len(unique)} kernels, {size:,} operations, {code:,.0f} KiB of code"
            )

        map_ = scene.with_(photon_count=1024).photon_map(0, 0, 0, wavelengths, lap)
        scene.radiance(sampler, rays, map_, radius, 0, lap=lap)
    return Finding("kernels", True, f"{number} kernels, {operations:,} operations", evidence)


def decided(scene: Prepared, spp: int = 0) -> tuple[Prepared, list[str], str, float]:
    """The scene as a pilot has decided, what ``map=auto`` went by, why light paths are aimed or
    not, and the part of the error that kernels behind lobes make."""
    if not scene.needs_map:
        causes = ["nothing casts caustics"] if scene.settings.map == "auto" else []
        return scene, [f"map=auto: {cause}" for cause in causes], "there are no light paths", 0.0
    sensor = scene.scene.sensors()[0]
    scene = replace(scene, settings=with_passes(scene.settings, spp, sensor))
    spp, pixels = sample_count(scene.settings, spp, sensor), pixel_count(sensor.film())
    found = settle(scene, sensor, 0, shares(scene.settings, spp, pixels).each)
    why = []
    if scene.undecided:
        why = [f"map=auto: {as_promises(found.errors)}"]
    elif scene.settings.map == "auto" and scene.needs.unseen:
        why = [f"map=auto: light of {emitter}" for emitter in scene.needs.unseen[:1]]
    count = scene.settings.photon_count
    scene = found.applied(scene).with_(photon_count=count)
    return scene, why, _aimed(found.aim), found.lobes


def _aimed(found) -> str:
    if found is None:
        return "a pilot found too little to gain"
    return (
        f"{len(found.low)} parts of what is emitted: a light path has {found.variance:.2f} of the "
        f"variance and {found.work:.2f} of the work of an even one"
    )


def as_promises(errors: dict[str, float | None]) -> str:
    """What a pilot promises of each use of the map, in words."""
    if not errors:
        return "a pilot found no photon to gather"
    why = "; photons could not lessen it by much" if list(errors) == ["none"] else ""

    def promise(use: str, error: float | None) -> str:
        if error is not None:
            return f"{error:.1e}"
        return "finds too little of the caustics" if use == "none" else "misses what eye paths see"

    words = [f"{use} {promise(use, error)}" for use, error in errors.items()]
    return f"relative MSE that a pilot promises: {', '.join(words)}{why}"


def as_text(findings: list[Finding]) -> str:
    lines = []
    for f in findings:
        lines.append(f"{'yes' if f.needed else 'no ':3s}  {f.name:26s} {f.consequence}")
        shown = f.evidence[:6] + ([f"… and {len(f.evidence) - 6} more"] if f.evidence[6:] else [])
        lines += [f"{'':33s}{e}" for e in shown]
    return "\n".join(lines)


def as_data(findings: list[Finding]) -> list[dict[str, Any]]:
    return [asdict(f) for f in findings]
