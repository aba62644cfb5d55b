"""Bounces of light paths at bump and normal maps.

They have a third normal, known to the BSDF alone, and directions that the viewer's side can see but
sampling from the light's side never finds. Where the BSDF has smooth lobes some bounces are drawn
from the cosine hemisphere, smooth ones are weighted by the BSDF as the viewer evaluates it, f(v, l)
with v the direction in which light leaves, and delta bounces by the cosines to their own normal.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Share of the bounces that are drawn so. The others weigh 1/(1 - DRAWN) more, again at each bounce.
DRAWN = 1 / 8


def viewed(si, direction):
    """The surface seen from another direction (local)."""
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = direction
    return seen


def bent_bounce(ctx, bsdf, si, bs, weight, sampler, active):
    """(BSDF sample, f(v, l)/p or delta weight) at bump and normal maps, see above."""
    m = si.wi + bs.wo * bs.eta  # along the normal that a delta bounce knows
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null) | (dr.squared_norm(m) < 1e-8)
    cosines = dr.select(straight, 1, dr.abs(dr.dot(m, si.wi) / dr.dot(m, bs.wo)))

    share = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), mi.Float(DRAWN), 0)
    drawn = active & (sampler.next_1d(active) < share)
    cosine_wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
    cosine_wo.z = dr.mulsign(cosine_wo.z, mi.Frame3f.cos_theta(si.wi))
    bs = mi.BSDFSample3f(bs)
    bs.wo = dr.select(drawn, cosine_wo, bs.wo)
    bs.eta = dr.select(drawn, 1, bs.eta)
    bs.sampled_type = dr.select(drawn, int(mi.BSDFFlags.DiffuseReflection), bs.sampled_type)

    delta &= ~drawn
    smooth = active & ~delta
    same_side = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) > 0
    pdf = (1 - share) * bsdf.pdf(ctx, si, bs.wo, smooth)
    pdf += dr.select(same_side, share * dr.inv_pi * dr.abs(mi.Frame3f.cos_theta(bs.wo)), 0)
    value = bsdf.eval(mi.BSDFContext(), viewed(si, bs.wo), si.wi, smooth)
    # A sample that failed is no sample of that density, wherever it points.
    failed = ~drawn & dr.all(weight == 0)
    value = dr.select((pdf > 0) & ~failed, value / pdf, 0)
    return bs, dr.select(delta, weight * cosines / (1 - share), value)
