"""Cases about the BSDF ``asgconductor``: the narrowest and the widest lobes, seen at any angle."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from .case import Case, Measured, worst_of
from .lanes import roughnesses

_SAMPLES = 1 << 15


def sampled(bsdf, cosine, count):
    """(weight, value, pdf of sample(), pdf of eval_pdf()) of ``count`` sampled directions at a
    view of that cosine."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    sine = (1 - cosine**2) ** 0.5
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(0.8 * sine, 0.6 * sine, cosine)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    context = mi.BSDFContext()
    bs, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d())
    value, pdf = bsdf.eval_pdf(context, si, bs.wo)
    return [np.array(a) for a in (weight, value, bs.pdf, pdf)]


def _energy(cosine) -> Measured:
    """What a perfect mirror's facets reflect beyond what arrives: mean of the sampling weights, −1
    where that is positive. Not a number where a weight, a value or a density is not finite."""
    alpha = roughnesses(aspects=(1.0, 30.0, 1e4))
    excess = []
    for alpha_u, alpha_v in alpha:
        bsdf = mi.load_dict(
            {
                "type": "asgconductor",
                "eta": 0.0,
                "k": 1.0,
                "alpha_u": float(alpha_u),
                "alpha_v": float(alpha_v),
            }
        )
        numbers = sampled(bsdf, cosine, _SAMPLES)
        finite = all(np.isfinite(a).all() for a in numbers)
        excess.append(max(numbers[0].mean() - 1, 0.0) if finite else np.nan)
    return Measured(*worst_of(excess, [f"α {u:g}, {v:g}" for u, v in alpha]))


def cases() -> list[Case]:
    return [
        Case(
            "asgconductor",
            f"α 1e-4 to 1, view at {name}",
            "energy gained, relative",
            2e-3,
            partial(_energy, cosine),
        )
        for name, cosine in (
            ("normal incidence", 1.0),
            ("60°", 0.5),
            ("89.9°", 1.745e-3),
            ("89.99°", 1.745e-4),
        )
    ]
