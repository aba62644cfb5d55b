"""What this scene needs. Read once per scene, in Python; the rest is never traced."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from ..errors import Unsupported
from ..map.receivers import has_walked_part, is_bent, is_lambertian, may_gather, may_shine
from ..ndf import children, nested_bsdfs, roughness_source
from ..transport.emission import only_photons_see

# Shapes of one BSDF that are named as evidence.
_NAMED = 4


@dataclass(frozen=True)
class Needs:
    """Answers about one scene, with the evidence (shape: BSDF) for each.

    lobes      surfaces with a readable roughness that may be anisotropic.
    chains     surfaces that paths walk on, so that a gather point may lie deeper than the first
               vertex, and caustics exist.
    receivers  surfaces that photons are stored on; receiving: addresses of their BSDFs.
    general    receivers that are not Lambertian.
    casting    surfaces with delta lobes (or cut-outs), which cast sharp caustics.
    glossy     surfaces on which glossy caustics are seen (see ``glossy_caustics``); shining:
               addresses of their BSDFs.
    bent       surfaces with bump or normal maps.
    unreadable glossy surfaces whose roughness cannot be read: kernels behind them are discs.
    unseen     emitters whose direct light only photons can find.
    grainless  meshes without texture coordinates that have an anisotropic BSDF.
    """

    lobes: list[str] = field(default_factory=list)
    chains: list[str] = field(default_factory=list)
    receivers: list[str] = field(default_factory=list)
    receiving: set[int] = field(default_factory=set)
    general: list[str] = field(default_factory=list)
    casting: list[str] = field(default_factory=list)
    glossy: list[str] = field(default_factory=list)
    shining: set[int] = field(default_factory=set)
    bent: list[str] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)
    grainless: list[str] = field(default_factory=list)


def read_scene(scene, gather_roughness: float) -> Needs:
    """Inspect all emitters and BSDFs of a scene. gather_roughness: see ``receivers``.

    Raises Unsupported naming the shape where the scene has participating media, or glossy surfaces
    together with light that emitter sampling cannot find; neither is supported.
    """
    needs = Needs()
    for emitter in scene.emitters():
        if only_photons_see(emitter):
            needs.unseen.append(emitter_name(emitter))
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            raise Unsupported(
                f'aniso_pm: sensor "{sensor.id()}" is in a participating medium, which this '
                'integrator does not support; remove the medium or use the integrator "volpath"'
            )
    seen = set()
    names = _sharing(scene)
    for name, shape in surfaces(scene):
        if shape.is_medium_transition():
            raise Unsupported(
                f'aniso_pm: shape "{name}" bounds a participating medium, which this integrator '
                'does not support; remove the medium or use the integrator "volpath"'
            )
        bsdf = shape.bsdf()
        if bsdf is None:
            continue
        if isinstance(shape, mi.Mesh) and not shape.has_vertex_texcoords():
            if _may_be_anisotropic(bsdf):
                needs.grainless.append(f"{name}: {describe(bsdf)}")
        if bsdf.ptr in seen:
            continue
        seen.add(bsdf.ptr)
        evidence = f"{', '.join(names[bsdf.ptr])}: {describe(bsdf)}"
        if may_gather(bsdf, gather_roughness):
            needs.receivers.append(evidence)
            needs.receiving.add(bsdf.ptr)
        if is_lambertian(bsdf):
            continue
        if may_gather(bsdf, gather_roughness):
            needs.general.append(evidence)
        if has_walked_part(bsdf, gather_roughness):
            needs.chains.append(evidence)
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta):
            needs.casting.append(evidence)
        if may_shine(bsdf, gather_roughness):
            needs.glossy.append(evidence)
            needs.shining.add(bsdf.ptr)
        if is_bent(bsdf):
            needs.bent.append(evidence)
        if _is_unreadable(bsdf):
            needs.unreadable.append(evidence)
        if _may_be_anisotropic(bsdf):
            needs.lobes.append(evidence)
        unlit = (mi.BSDFFlags.Glossy, mi.BSDFFlags.DiffuseTransmission)
        if any(mi.has_flag(bsdf.flags(), flag) for flag in unlit):
            _refuse_unlit(needs, evidence)
    return needs


def instanced(scene) -> list[tuple[Any, Any]]:
    """(group, shape) for the shapes of shape groups, which ``scene.shapes()`` leaves out."""
    if all(shape.class_name() != "Instance" for shape in scene.shapes()):
        return []
    tree = mi.traverse(scene).hierarchy.items()
    return [
        (above, node) for node, (above, _) in tree if above and "ShapeGroup" in above.class_name()
    ]


def surfaces(scene) -> list[tuple[str, Any]]:
    """Names of all shapes that have materials, and the shapes; those of groups once."""
    own = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    named = [(shape.id() or shape.class_name(), shape) for shape in own]
    for group, shape in instanced(scene):
        named.append((f"{shape.id() or shape.class_name()} in {group.id()}", shape))
    return named


def _sharing(scene) -> dict[int, list[str]]:
    """Names of the shapes that share a BSDF, by its address."""
    found: dict[int, Counter[str]] = {}
    for name, shape in surfaces(scene):
        if (bsdf := shape.bsdf()) is not None:
            found.setdefault(bsdf.ptr, Counter())[name] += 1
    return {address: _listed(names) for address, names in found.items()}


def _listed(names: Counter[str]) -> list[str]:
    """Names, those that occur more than once with their number, and how many are not named."""
    words = [f"{count} × {name}" if count > 1 else name for name, count in names.items()]
    rest = len(words) - _NAMED
    return [*words[:_NAMED], f"and {rest} more"] if rest > 0 else words


def _refuse_unlit(needs: Needs, evidence: str):
    if needs.unseen:
        raise Unsupported(
            f'aniso_pm: emitter "{needs.unseen[0]}" casts parallel light that the surface '
            f'"{evidence}" cannot be lit by in this integrator (glossy or transmitting); use '
            '"directional", "spot" or "area" instead'
        )


def _is_unreadable(bsdf) -> bool:
    """Is there a glossy BSDF in the tree whose roughness cannot be read?"""
    nested = nested_bsdfs(children(bsdf))
    if nested:
        return any(_is_unreadable(b) for b in nested)
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) and roughness_source(bsdf) is None


def emitter_name(emitter) -> str:
    return f"{emitter.id()}: {emitter.class_name()}".removeprefix(": ")


def describe(bsdf) -> str:
    """Class names of a tree of BSDFs: TwoSidedBRDF(RoughConductor)."""
    python = type(bsdf).__module__.split(".")[0] != "mitsuba"
    name = type(bsdf).__name__ if python else bsdf.class_name()
    distinct = {child.ptr: child for child in nested_bsdfs(children(bsdf))}  # twosided: twice one
    nested = ", ".join(describe(child) for child in distinct.values())
    return f"{name}({nested})" if nested else name


def _may_be_anisotropic(bsdf) -> bool:
    """A roughness that can be read, with two parameters somewhere in the tree of BSDFs."""
    if roughness_source(bsdf) is None:
        return False
    found = children(bsdf)
    if "alpha_u" in found or "anisotropic" in found:
        return True
    return any(_may_be_anisotropic(nested) for nested in nested_bsdfs(found))
