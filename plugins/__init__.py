"""The Mitsuba plugin classes, registered for the current variant and every later one."""

import mitsuba as mi

_listening = False
_registered: set[str] = set()


def register() -> None:
    """Register the plugins now, if a variant is set, and after every change of variant."""
    global _listening
    if _listening:
        return
    mi.detail.add_variant_callback(_on_variant)
    _listening = True
    if mi.variant():
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str) -> None:
    # Base classes belong to one variant: every variant gets plugin classes of its own, once.
    if new in _registered:
        return
    _registered.add(new)
    if new.startswith("scalar_"):
        mi.register_integrator("aniso_pm", _refuse_scalar)
        mi.register_bsdf("asgconductor", _refuse_scalar)
        mi.register_sampler("owen_sobol", _refuse_scalar)
        return
    from .asgconductor import ASGConductor
    from .integrator import AnisoPhotonMapper
    from .sampler import OwenSobol

    mi.register_integrator("aniso_pm", _bind(AnisoPhotonMapper, mi.SamplingIntegrator))
    mi.register_bsdf("asgconductor", _bind(ASGConductor, mi.BSDF))
    mi.register_sampler("owen_sobol", _bind(OwenSobol, mi.Sampler))


def _bind(template: type, base: type) -> type:
    """The template's methods in a class derived from one variant's base class (Mitsuba's classes
    cannot be combined with others by multiple inheritance)."""
    own = {k: v for k, v in vars(template).items() if k not in ("__dict__", "__weakref__")}
    return type(template.__name__, (base,), own)


def _refuse_scalar(props):
    raise RuntimeError(
        f'{props.plugin_name()}: the variant "{mi.variant()}" has no Dr.Jit arrays to '
        'work with; choose a vectorised one: mi.set_variant("llvm_ad_rgb"), or -m llvm_ad_rgb'
    )
