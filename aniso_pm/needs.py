"""What this scene needs. Read once per scene, in Python; the rest is never traced.

A surface is a *receiver* if photons are stored and gathered on it: Lambertian reflection, seen
through ``twosided`` and ``blendbsdf``. Every other BSDF is walked through by photons and by eye
paths alike, exactly as ``path`` would, so a scene of unusual materials is at worst noisier.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from .ndf import children, nested_bsdfs, roughness_source


@dataclass(frozen=True)
class Needs:
    """Answers about one scene, with the evidence (shape: BSDF) for each.

    lobes      surfaces with a readable roughness that may be anisotropic.
    chains     surfaces that eye paths walk through, so that a gather point may lie deeper than
               the first vertex.
    receivers  surfaces that photons are stored on.
    """

    lobes: list[str] = field(default_factory=list)
    chains: list[str] = field(default_factory=list)
    receivers: list[str] = field(default_factory=list)


def read_scene(scene) -> Needs:
    """Inspect all BSDFs of a scene.

    Raises ValueError naming the shape where the scene has participating media, or the emitter
    where it has light that emitter sampling cannot find; neither is supported.
    """
    needs = Needs()
    for emitter in scene.emitters():
        if emitter.class_name() == "DirectionalArea":
            raise ValueError(
                f'aniso_pm: emitter "{emitter.id()}" is a directionalarea light, whose direct '
                'light cannot be sampled from the eye; use "directional", "spot" or "area" instead'
            )
    seen = set()
    for shape in scene.shapes():
        name = shape.id() or shape.class_name()
        if shape.is_medium_transition():
            raise ValueError(
                f'aniso_pm: shape "{name}" bounds a participating medium, which this integrator '
                'does not support; remove the medium or use the integrator "volpath"'
            )
        if shape.class_name() == "Instance":
            # Its shapes cannot be reached from Python: anything may be among them.
            for need in (needs.lobes, needs.chains, needs.receivers):
                need.append(f"{name}: Instance")
            continue
        bsdf = shape.bsdf()
        if bsdf is None or bsdf.ptr in seen:
            continue
        seen.add(bsdf.ptr)
        evidence = f"{name}: {bsdf.class_name()}"
        if is_lambertian(bsdf):
            needs.receivers.append(evidence)
            continue
        needs.chains.append(evidence)
        if _may_be_anisotropic(bsdf):
            needs.lobes.append(evidence)
    return needs


def is_lambertian(bsdf) -> bool:
    """Does this BSDF reflect the same radiance in every direction, whatever the incident one?"""
    if bsdf.class_name() == "SmoothDiffuse":
        return True
    if bsdf.class_name() in ("TwoSidedBRDF", "BlendBSDF"):
        nested = nested_bsdfs(children(bsdf))
        return len(nested) > 0 and all(is_lambertian(b) for b in nested)
    return False


def _may_be_anisotropic(bsdf) -> bool:
    """A roughness that can be read, with two parameters somewhere in the tree of BSDFs."""
    if roughness_source(bsdf) is None:
        return False
    found = children(bsdf)
    if "alpha_u" in found or "anisotropic" in found:
        return True
    return any(_may_be_anisotropic(nested) for nested in nested_bsdfs(found))


def receiver_reflectance(bsdf, si, active):
    """(is a receiver, BRDF value in 1/sr) of the surfaces at si, for the side that si.wi is on.

    bsdf: mi.BSDFPtr. The value is 0 on the back of one-sided surfaces. Decided once per BSDF.
    """

    def read(instance, si, active):
        if instance is None or not is_lambertian(instance):  # None: a scene without shapes
            return mi.Bool(False), mi.Spectrum(0)
        up = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(si.wi)))
        return mi.Bool(True), instance.eval(mi.BSDFContext(), si, up, active)

    return dr.dispatch(bsdf, read, si, active)
