"""Cases about the scenes that come with the library, at the parameters' defaults: at most 1 % of
their gather points may lie in the regions of the fallbacks."""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np
from aniso_pm.kernel import RULES

from .. import gallery
from .case import RARE, Case, Measured

_COUNTED = ("clamped", "capped", "degenerate", "off_surface")


def _fallbacks(name, rule) -> Measured:
    """Share of all gather points in which any fallback acted."""
    path = gallery.directory() / f"{name}.xml"
    scene = mi.load_file(str(path), width="96", height="72")
    integrator = mi.load_dict({"type": "aniso_pm", "kernel": "anisotropic", "rule": rule})
    image = np.array(mi.render(scene, integrator=integrator, spp=16))
    counts = integrator.statistics
    points = counts["gather_points"]
    found = {kind: counts[f"gather_points_{kind}"] for kind in _COUNTED}
    dropped = counts["photons_rejected"] + counts["eye_samples_rejected"]
    words = ", ".join(f"{kind} {number / points:.3%}" for kind, number in found.items() if number)
    share = sum(found.values()) / points
    fine = np.isfinite(image).all() and dropped == 0 and counts["gather_points_anisotropic"] > 0
    return Measured(share if fine else float("nan"), words or "none", share)


def cases() -> list[Case]:
    # The rule "taylor", which is not the default, makes needles where the curvature along the lobe
    # vanishes: there the aspect cap is part of the answer.
    return [
        Case(
            f"gallery, {name}",
            f"rule {rule}",
            "share of gather points with a fallback",
            0.05 if rule == "taylor" else RARE,
            partial(_fallbacks, name, rule),
            region="cap" if rule == "taylor" else None,
            slow=rule != "lobe",
        )
        for name in ("teapot", "fry_pan")
        for rule in RULES
    ]
