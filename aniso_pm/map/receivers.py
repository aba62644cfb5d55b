"""Which part of a BSDF is read from the photon map, and which part paths walk on.

Every BSDF is the sum of a *gathered* part f_g and a *walked* part. Light that arrives over two path
segments or more and is reflected by f_g comes from the photon map; the walked part is path traced.
f_g never transmits and never contains a delta lobe. It is

* all of it, for Lambertian BSDFs (``diffuse``, also in ``twosided`` and ``blendbsdf``);
* all of it, where the smallest roughness alpha is at least the threshold ``gather_roughness``
  (decided per lane, so textures are right) or where no lobe is glossy;
* the diffuse component, in BSDFs that can be asked for it (``roughplastic`` ...);
* nothing, for everything else: such surfaces are walked through exactly as ``path`` would.

The split changes noise, never energy: both parts together are the BSDF.
"""

from __future__ import annotations

from collections.abc import Container

import drjit as dr
import mitsuba as mi

from ..ndf import ROUGHNESS, children, clearcoat_roughness, nested_bsdfs, own_roughness

# Roughness from which photons are summed up in glossy caustics: lobes of smoother surfaces are so
# narrow that next to no photon lies in them. As the smallest ``gather_roughness``.
_SHINES_FROM = 0.01
_WRAPPERS = ("TwoSidedBRDF", "BlendBSDF", "MaskBSDF", "BumpMap", "NormalMap")
# BSDFs that evaluate exactly the components that BSDFContext.type_mask asks for.
_OBEYS_TYPE_MASK = (
    "SmoothDiffuse",
    "SmoothPlastic",
    "RoughPlastic",
    "SmoothConductor",
    "RoughConductor",
    "SmoothDielectric",
    "ThinDielectric",
    "RoughDielectric",
    "Null",
)


def is_lambertian(bsdf) -> bool:
    """Does this BSDF reflect the same radiance in every direction, whatever the incident one?"""
    if bsdf.class_name() == "SmoothDiffuse":
        return True
    if bsdf.class_name() in ("TwoSidedBRDF", "BlendBSDF"):
        nested = nested_bsdfs(children(bsdf))
        return len(nested) > 0 and all(is_lambertian(b) for b in nested)
    return False


def may_gather(bsdf, threshold: float) -> bool:
    """Can the gathered part of this BSDF be anything but zero? (Evaluates uniform textures.)"""
    if is_lambertian(bsdf) or _diffuse_can_be_asked_for(bsdf):
        return True
    smallest = _smallest_roughness(bsdf)
    if smallest is None or not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth):
        return False
    if _roughness_varies(bsdf):
        return True
    return _uniform(smallest) >= threshold


def read_receiver(bsdf, si, threshold: float, general: bool, active, glossy: str = ""):
    """(is a receiver, is Lambertian, BRDF value in 1/sr of a Lambertian one, keeps photons, shows
    glossy caustics) at si.

    bsdf: mi.BSDFPtr; decided once per BSDF while tracing. The value is that of the side that si.wi
    is on, 0 on the back of one-sided surfaces. ``general=False``: only Lambertian receivers exist.
    Photons are kept on the smooth texels of rough surfaces too, where nothing gathers: kernels of
    the rough ones reach over them. So do kernels of the smooth ones in glossy caustics, which are
    seen "here", or "somewhere" on the surface; "": nobody asks.
    """

    def read(instance, si, active):
        if instance is None:  # a scene without shapes
            no = mi.Bool(False)
            return no, no, mi.Spectrum(0), no, no
        if is_lambertian(instance):
            up = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(si.wi)))
            value = instance.eval(mi.BSDFContext(), si, up, active)
            # By side, not by value: kernels of lit texels reach over black ones.
            side = _reflects(instance, si)
            return side, mi.Bool(True), value, side, mi.Bool(False)
        whole, diffuse = _gathered(instance, si, threshold, active) if general else (False, False)
        gathers = mi.Bool(diffuse) | whole
        keeps = mi.Bool(True) if whole is not False and _roughness_varies(instance) else gathers
        shines = mi.Bool(False)
        if glossy and _reflects_smoothly(instance):
            varies = whole is not False and _roughness_varies(instance)
            shines = _reflects(instance, si)
            smallest = _smallest_roughness(instance)
            if smallest is not None:
                shines &= smallest(si, active) >= _SHINES_FROM
            if glossy == "here" or not varies:
                shines &= ~gathers
        return gathers, mi.Bool(False), mi.Spectrum(0), keeps, shines

    return dr.dispatch(bsdf, read, si, active)


def gathered_part(bsdf, si, wo, threshold: float, active):
    """f_g(si.wi, wo) |cos θ_o| per lane, as ``BSDF.eval`` would return it."""

    def evaluate(instance, si, wo, active):
        if instance is None:
            return mi.Spectrum(0)
        active = active & (mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) > 0)
        ctx = mi.BSDFContext()
        if is_lambertian(instance):
            return instance.eval(ctx, si, wo, active)
        whole, diffuse = _gathered(instance, si, threshold, active)
        value = mi.Spectrum(0)
        if diffuse:
            ctx.type_mask = int(mi.BSDFFlags.DiffuseReflection)
            value = instance.eval(ctx, si, wo, active & ~whole)
        if whole is not False:
            value = dr.select(whole, instance.eval(mi.BSDFContext(), si, wo, active & whole), value)
        return dr.select(active, value, 0)

    return dr.dispatch(bsdf, evaluate, si, wo, active)


def may_shine(bsdf, threshold: float) -> bool:
    """Are there places where all of this BSDF is walked, and it reflects smoothly, and lets nothing
    pass but straight on? Glossy caustics are seen there (see ``glossy_caustics``)."""
    if not _reflects_smoothly(bsdf):
        return False
    smallest = _smallest_roughness(bsdf)
    if smallest is not None and not _roughness_varies(bsdf):
        return _SHINES_FROM <= _uniform(smallest) < threshold
    return True


def shining_part(bsdf, si, wo, active):
    """(BSDF times |cos θ_o|, density of sampling wo) where glossy caustics are seen."""

    def evaluate(instance, si, wo, active):
        if instance is None or not _reflects_smoothly(instance):
            return mi.Spectrum(0), mi.Float(0)
        active = active & (mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) > 0)
        value, pdf = instance.eval_pdf(mi.BSDFContext(), si, wo, active)
        return mi.Spectrum(dr.select(active, value, 0)), dr.select(active, pdf, 0)

    return dr.dispatch(bsdf, evaluate, si, wo, active)


def shining_pdf(bsdf, si, wo, active):
    """The same density alone."""

    def evaluate(instance, si, wo, active):
        if instance is None or not _reflects_smoothly(instance):
            return mi.Float(0)
        return instance.pdf(mi.BSDFContext(), si, wo, active)

    return dr.dispatch(bsdf, evaluate, si, wo, active)


def has_walked_part(bsdf, threshold: float) -> bool:
    """Can the part of this BSDF that is not gathered be anything but zero?"""
    if is_lambertian(bsdf):
        return False
    flags = mi.BSDFFlags
    if mi.has_flag(bsdf.flags(), flags.Delta) or mi.has_flag(bsdf.flags(), flags.Transmission):
        return True
    smallest = _smallest_roughness(bsdf)
    if smallest is None or (mi.has_flag(bsdf.flags(), flags.Glossy) and _roughness_varies(bsdf)):
        return True
    return not _uniform(smallest) >= threshold


def is_bent(bsdf) -> bool:
    """Is there a bump or normal map in the tree? Its BSDF takes cosines to a normal of its own."""
    nested = nested_bsdfs(children(bsdf)) if bsdf.class_name() in _WRAPPERS else []
    return bsdf.class_name() in ("BumpMap", "NormalMap") or any(is_bent(b) for b in nested)


def read_bent(bsdf, active):
    """``is_bent`` per lane of mi.BSDFPtr."""

    def read(instance, active):
        return mi.Bool(instance is not None and is_bent(instance))

    return dr.dispatch(bsdf, read, active)


def read_cover(bsdf, active, receivers: Container[int]):
    """(is it one of the receivers?, does light pass?) per lane of mi.BSDFPtr. receivers: addresses
    of BSDFs."""

    def read(instance, active):
        if instance is None:
            return mi.Bool(False), mi.Bool(True)
        passes = mi.has_flag(instance.flags(), mi.BSDFFlags.Transmission)
        return mi.Bool(instance.ptr in receivers), mi.Bool(passes)

    return dr.dispatch(bsdf, read, active)


def _reflects_smoothly(bsdf) -> bool:
    """As ``may_shine``, whatever the roughness: nothing is evaluated."""
    flags = mi.BSDFFlags
    through = flags.DiffuseTransmission, flags.GlossyTransmission, flags.DeltaTransmission
    if any(mi.has_flag(bsdf.flags(), flag) for flag in through):
        return False
    if is_lambertian(bsdf) or _diffuse_can_be_asked_for(bsdf):
        return False
    return mi.has_flag(bsdf.flags(), flags.Smooth)


def _reflects(bsdf, si):
    """Does the BSDF reflect on the side that si.wi is on?"""
    front, back = (
        mi.has_flag(bsdf.flags(), f) for f in (mi.BSDFFlags.FrontSide, mi.BSDFFlags.BackSide)
    )
    return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, mi.Bool(front), mi.Bool(back))


def _uniform(function) -> float:
    """Value of a function of (si, active) that is the same everywhere."""
    return float(mi.Float(function(dr.zeros(mi.SurfaceInteraction3f), True))[0])


def _gathered(bsdf, si, threshold, active):
    """(gathered as a whole, per lane or False; is its diffuse component gathered anyway?)"""
    smallest = _smallest_roughness(bsdf)
    whole = False
    if smallest is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth):
        whole = mi.Bool(smallest(si, active) >= threshold)
    return whole, _diffuse_can_be_asked_for(bsdf)


def _diffuse_can_be_asked_for(bsdf) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection) and _obeys(bsdf)


def _obeys(bsdf) -> bool:
    if bsdf.class_name() in _OBEYS_TYPE_MASK:
        return True
    nested = nested_bsdfs(children(bsdf)) if bsdf.class_name() in _WRAPPERS else []
    return len(nested) > 0 and all(_obeys(b) for b in nested)


def _smallest_roughness(bsdf):
    """A function of (si, active): the smallest alpha of all glossy lobes (infinite where there is
    none); None where it cannot be known."""
    if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy):
        return lambda si, active: mi.Float(dr.inf)
    own = own_roughness(bsdf)
    coat = clearcoat_roughness(bsdf)
    if own is not None and coat is not None:
        return lambda si, active: dr.minimum(dr.minimum(*own(si, active)), coat(si, active))
    if own is not None:
        return lambda si, active: dr.minimum(*own(si, active))
    nested = nested_bsdfs(children(bsdf)) if bsdf.class_name() in _WRAPPERS else []
    parts = [_smallest_roughness(b) for b in nested]
    if not parts or None in parts:
        return None

    def smallest(si, active):
        value = mi.Float(dr.inf)
        for part in parts:
            value = dr.minimum(value, part(si, active))
        return value

    return smallest


def _roughness_varies(bsdf) -> bool:
    """Does a texture of the tree make ``_smallest_roughness`` another from place to place?"""
    found = children(bsdf)
    textures = [found[name] for name in ROUGHNESS if isinstance(found.get(name), mi.Texture)]
    return any(texture.is_spatially_varying() for texture in textures) or any(
        _roughness_varies(nested) for nested in nested_bsdfs(found)
    )
