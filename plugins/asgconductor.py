"""The BSDF plugin ``asgconductor``: a conductor whose normal distribution is exactly one ASG."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
from aniso_pm.asg import ASG
from aniso_pm.ndf import asg_from_roughness, children

# Smallest and largest roughness; values outside are clamped, as in Mitsuba's own microfacet BSDFs.
ALPHA_MIN, ALPHA_MAX = 1e-4, 1.0
# Numbers that the parameters may be, (low, high, in words): textures and spectra by their mean.
# Fresnel's formula takes the fourth power of eta and k.
RANGES = {
    "alpha": (0.0, ALPHA_MAX, f"above 0 and at most {ALPHA_MAX:g}"),
    "alpha_u": (0.0, ALPHA_MAX, f"above 0 and at most {ALPHA_MAX:g}"),
    "alpha_v": (0.0, ALPHA_MAX, f"above 0 and at most {ALPHA_MAX:g}"),
    "eta": (0.0, 1e6, "between 0 and 1e+06"),
    "k": (0.0, 1e6, "between 0 and 1e+06"),
    "specular_reflectance": (0.0, 1.0, "between 0 and 1"),
}


class ASGConductor:
    r"""
    .. _bsdf-asgconductor:

    Anisotropic spherical Gaussian conductor (:monosp:`asgconductor`)
    -----------------------------------------------------------------

    .. pluginparameters::

     * - material
       - |string|
       - Name of a conductor, as for :ref:`roughconductor <bsdf-roughconductor>`.
         (Default: ``Cu``; excludes eta and k)

     * - eta, k
       - |spectrum| or |texture|
       - Real and imaginary part of the index of refraction.

     * - alpha, alpha_u, alpha_v
       - |float| or |texture|
       - Roughness, along the tangent and the bitangent; above 0 and at most 1. Values below 0.0001,
         and those of a texture outside of both, are clamped. (Default: 0.1)

     * - specular_reflectance
       - |spectrum| or |texture|
       - Factor of the reflection. (Default: 1.0)

    A microfacet model D·G·F / (4 cos θi cos θo) in which D is one ASG,

    .. math:: D(h) = c\, \max(h_z, 0)\, \exp(-h_x^2/\alpha_u^2 - h_y^2/\alpha_v^2),

    c such that the projected area of the microfacets is 1, F is Fresnel's for conductors and G the
    shadowing of V-shaped grooves [Cook and Torrance 1982], which conserves energy for any D. It
    makes the premise of anisotropic density estimation (the lobe is an ASG) true, so that errors of
    that premise and errors of the estimator can be told apart.
    """

    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        if "material" in props and ("eta" in props or "k" in props):
            raise ValueError('asgconductor: give either "material" or "eta" and "k", not both')
        if ("eta" in props) != ("k" in props):
            raise ValueError('asgconductor: "eta" and "k" must be given together')
        if "alpha" in props and ("alpha_u" in props or "alpha_v" in props):
            raise ValueError(
                'asgconductor: give either "alpha" or "alpha_u" and "alpha_v", not both'
            )
        if ("alpha_u" in props) != ("alpha_v" in props):
            raise ValueError('asgconductor: "alpha_u" and "alpha_v" must be given together')
        for name in RANGES:
            if name in props:
                _check(name, props[name])

        if "eta" in props:
            self.eta = props.get_unbounded_texture("eta")
            self.k = props.get_unbounded_texture("k")
        else:
            self.eta, self.k = _named_conductor(props["material"] if "material" in props else "Cu")
        if "alpha_u" in props:
            self.alpha_u = props.get_texture("alpha_u")
            self.alpha_v = props.get_texture("alpha_v")
        else:
            self.alpha_u = self.alpha_v = props.get_texture("alpha", 0.1)
        self.specular_reflectance = (
            props.get_texture("specular_reflectance") if "specular_reflectance" in props else None
        )

        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if self.alpha_u is not self.alpha_v:
            flags |= mi.BSDFFlags.Anisotropic
        textures = [self.eta, self.k, self.alpha_u, self.alpha_v]
        if any(t.is_spatially_varying() for t in textures):
            flags |= mi.BSDFFlags.SpatiallyVarying
        self.m_components = [flags]
        self.m_flags = flags

    def traverse(self, callback):
        differentiable = mi.ParamFlags.Differentiable
        if self.alpha_u is self.alpha_v:
            callback.put("alpha", self.alpha_u, differentiable)
        else:
            callback.put("alpha_u", self.alpha_u, differentiable)
            callback.put("alpha_v", self.alpha_v, differentiable)
        callback.put("eta", self.eta, differentiable)
        callback.put("k", self.k, differentiable)
        if self.specular_reflectance is not None:
            callback.put("specular_reflectance", self.specular_reflectance, differentiable)

    # --- D, G, F ---

    def _ndf(self, si, active) -> ASG:
        """The ASG of half-vectors, amplitude such that ∫ D(h) cos θ_h dω = 1."""
        clamp = lambda t: dr.clip(t.eval_1(si, active), ALPHA_MIN, ALPHA_MAX)  # noqa: E731
        alpha_u = clamp(self.alpha_u)
        alpha_v = alpha_u if self.alpha_v is self.alpha_u else clamp(self.alpha_v)
        ndf = asg_from_roughness(alpha_u, alpha_v)
        ndf.amplitude = dr.rcp(_projected_area(ndf.lam, ndf.mu))
        return ndf

    @staticmethod
    def _shadowing(wi, wo, h):
        """Cook and Torrance's min(1, 2 (h·n)(wi·n)/(wi·h), 2 (h·n)(wo·n)/(wo·h))."""
        k = 2 * h.z * dr.rcp(dr.dot(wi, h))
        return dr.minimum(1, k * dr.minimum(wi.z, wo.z))

    def _reflectance(self, si, cos_d, active):
        """Fresnel reflectance times the factor, at the angle between wi and h."""
        eta, k = self.eta.eval(si, active), self.k.eval(si, active)
        value = mi.Spectrum(
            *(
                mi.fresnel_conductor(cos_d, mi.Complex2f(eta[i], k[i]))
                for i in range(dr.size_v(mi.UnpolarizedSpectrum))
            )
        )
        if self.specular_reflectance is not None:
            value *= self.specular_reflectance.eval(si, active)
        return value

    # --- Mitsuba's interface ---

    def sample(self, ctx, si, sample1, sample2, active=True):
        wi = si.wi
        active = mi.Bool(active) & (wi.z > 0) & self._enabled(ctx)
        ndf = self._ndf(si, active)
        h, _ = ndf.sample(sample2)
        # V-shaped grooves: of the two facets h and its mirror image the viewer sees each in
        # proportion to its projected area [Heitz and d'Eon 2014].
        mirrored = mi.Vector3f(-h.x, -h.y, h.z)
        see, see_mirrored = dr.maximum(dr.dot(wi, h), 0), dr.maximum(dr.dot(wi, mirrored), 0)
        h = dr.select(sample1 * (see + see_mirrored) < see, h, mirrored)

        bs = mi.BSDFSample3f()
        bs.wo = mi.reflect(wi, mi.Normal3f(h))
        bs.eta = mi.Float(1)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.sampled_component = mi.UInt32(0)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        active &= bs.pdf > 0
        return bs, dr.select(active, value / bs.pdf, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_pdf(self, ctx, si, wo, active=True):
        wi = si.wi
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0) & self._enabled(ctx)
        h = dr.normalize(wi + wo)
        cos_d = dr.dot(wi, h)
        ndf = self._ndf(si, active)
        d = ndf.eval(h)
        value = self._reflectance(si, cos_d, active)
        value *= d * self._shadowing(wi, wo, h) / (4 * wi.z)
        # Density of h under ``sample``: both facets are drawn equally often, then one is chosen.
        see = dr.maximum(cos_d, 0)
        see_mirrored = dr.maximum(wi.z * h.z - wi.x * h.x - wi.y * h.y, 0)
        pdf = 2 * ndf.pdf(h) * see / (see + see_mirrored) / (4 * cos_d)
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def _enabled(self, ctx):
        return ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)

    def to_string(self):
        return (
            f"ASGConductor[\n  alpha_u = {self.alpha_u},\n  alpha_v = {self.alpha_v},\n"
            f"  eta = {self.eta},\n  k = {self.k}\n]"
        )


def _projected_area(lam, mu):
    """∫ D(h) cos θ_h dω of D = G, the projected area of the facets, within 5e-5 for λ, μ >= 1.

    With h_x = ρ cos φ/√λ, h_y = ρ sin φ/√μ and k² = cos²φ/λ + sin²φ/μ the radial integral is
    ∫ exp(−u) √(1 − k²u) du over [0, 1/k²] = 1 − k D(1/k), D being Dawson's function: smooth in
    k², so that a rational function of k² (least squares, 2e-5) and six angles in a quarter turn
    are enough.
    """
    numerator = (0.6925119, 15.01607, 31.10133, 0.792377)
    denominator = (1.188922, 16.07337, 35.88697, 51.06626)
    a, b = dr.rcp(lam), dr.rcp(mu)
    mean, half = 0.5 * (a + b), 0.5 * (a - b)
    total = mi.Float(0)
    for i in range(6):
        k2 = mean + half * math.cos(math.pi * (i + 0.5) / 6)
        top, bottom = mi.Float(0), mi.Float(0)
        for p, q in zip(reversed(numerator), reversed(denominator), strict=True):
            top, bottom = (top + p) * k2, (bottom + q) * k2
        total += (1 + top) / (1 + bottom)
    return total * (dr.pi / 6) * dr.sqrt(a * b)


def _named_conductor(material):
    """(eta, k) textures of one of Mitsuba's named conductors ("none": a perfect mirror's)."""
    if material == "none":
        # Mitsuba's convention for a reflectance of 1.
        constant = lambda v: mi.load_dict({"type": "uniform", "value": v})  # noqa: E731
        return constant(0.0), constant(1.0)
    if type(material) is not str:
        raise ValueError(
            f'asgconductor: parameter "material" is {material!r}; it must be a name, such as "Cu"'
        )
    try:
        twin = mi.load_dict({"type": "roughconductor", "material": material})
    except RuntimeError:
        raise ValueError(
            f'asgconductor: parameter "material" is "{material}", which is unknown; it must be one '
            'of the conductors that roughconductor knows ("Ag", "Al", "Au", "Cu", …), or "none"'
        ) from None
    found = children(twin)
    return found["eta"], found["k"]


def _check(name, value):
    """Raise ValueError unless the number, or the mean of the texture, is in range."""
    low, high, words = RANGES[name]
    mean = value
    if isinstance(value, mi.Texture):
        try:
            mean = float(mi.Float(value.mean())[0])
        except RuntimeError:  # a texture that does not know its mean
            return
    elif type(value) not in (int, float):
        raise ValueError(
            f'asgconductor: parameter "{name}" is {value!r}; it must be a number {words}, a '
            "spectrum or a texture"
        )
    # A texture may be 0 in places: roughness is clamped there. A number may not.
    above = mean > low or mean == low and (not name.startswith("alpha") or mean is not value)
    if not (math.isfinite(mean) and above and mean <= high):
        raise ValueError(f'asgconductor: parameter "{name}" is {mean:g}; it must be {words}')
