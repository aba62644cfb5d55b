"""The BSDF ``asgconductor``: agreement of its three methods, energy, and the lobe it promises."""

import aniso_pm
import drjit as dr
import mitsuba as mi
import pytest


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def tag(**values):
    return "".join(f'<float name="{k}" value="{v}"/>' for k, v in values.items())


def interaction(wi, n=1):
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = dr.normalize(mi.Vector3f(wi))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return si


PERFECT = {"type": "asgconductor", "eta": 0.0, "k": 1.0}  # reflectance 1 at every angle


@pytest.mark.parametrize(
    "roughness, wi",
    [
        (dict(alpha_u=0.1, alpha_v=0.4), [0.5, 0.3, 0.8]),
        (dict(alpha=0.3), [0, 0, 1]),
        (dict(alpha=1.0), [0.9, 0, 0.2]),
        (dict(alpha_u=0.05, alpha_v=0.3), [0.9, 0.3, 0.1]),
    ],
)
def test_samples_follow_the_pdf(roughness, wi):
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    sample, pdf = BSDFAdapter("asgconductor", tag(**roughness), wi=dr.normalize(mi.Vector3f(wi)))
    test = ChiSquareTest(
        SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, res=101, ires=16
    )
    assert test.run(significance_level=0.001, test_count=4), test.messages


@pytest.mark.parametrize("roughness", [(0.1, 0.1), (0.1, 0.5), (1.0, 0.3)])
def test_sample_weight_is_value_over_pdf(roughness):
    bsdf = mi.load_dict(PERFECT | {"alpha_u": roughness[0], "alpha_v": roughness[1]})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 10_000)
    si, ctx = interaction([0.6, -0.3, 0.7], 10_000), mi.BSDFContext()
    bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d())
    value, pdf = bsdf.eval_pdf(ctx, si, bs.wo)
    ok = bs.pdf > 0
    assert dr.allclose(dr.select(ok, bs.pdf, 0), dr.select(ok, pdf, 0), rtol=1e-3)
    assert dr.allclose(
        dr.select(ok, weight.x * bs.pdf, 0), dr.select(ok, value.x, 0), rtol=1e-3, atol=1e-5
    )
    assert dr.all(dr.isfinite(weight.x))


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.3, 0.05])
@pytest.mark.parametrize("roughness", [(0.02, 0.02), (0.05, 0.4), (0.3, 0.3), (1.0, 0.5)])
def test_a_perfect_conductor_gains_no_energy(roughness, cosine):
    """Single scattering loses what facets shadow, and never gains: with V-shaped grooves and
    ∫D cos = 1 the albedo is at most 1, and 1 for a smooth surface."""
    bsdf = mi.load_dict(PERFECT | {"alpha_u": roughness[0], "alpha_v": roughness[1]})
    n = 1 << 17
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, n)
    sine = (1 - cosine**2) ** 0.5
    si = interaction([0.8 * sine, 0.6 * sine, cosine], n)
    _, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    albedo = dr.mean(weight.x)[0]
    assert albedo < 1 + 2e-3  # Monte Carlo error of 1e5 samples of deviation < 0.5
    if max(roughness) < 0.05 and cosine > 0.5:
        assert albedo > 0.995


def test_half_vectors_are_distributed_as_the_asg():
    """At normal incidence f = D F G / 4, and G = 1 near the pole: ratios of f are ratios of D."""
    au, av = 0.08, 0.3
    bsdf = mi.load_dict(PERFECT | {"alpha_u": au, "alpha_v": av})
    ndf = aniso_pm.ndf.asg_from_roughness(au, av)
    si, ctx = interaction([0, 0, 1]), mi.BSDFContext()
    peak = bsdf.eval(ctx, si, mi.Vector3f(0, 0, 1)).x
    h = dr.normalize(mi.Vector3f(mi.Float([0.05, 0, 0.1]), mi.Float([0, 0.2, 0.1]), 1))
    wo = mi.reflect(mi.Vector3f(0, 0, 1), mi.Normal3f(h))
    expected = dr.exp(ndf.log_eval(h) - ndf.log_eval(mi.Vector3f(0, 0, 1)))
    assert dr.allclose(bsdf.eval(ctx, si, wo).x / peak, expected, rtol=1e-4)


def test_material_sets_the_fresnel_reflectance_of_roughconductor():
    for material in ("Cu", "Au"):
        smooth = mi.load_dict({"type": "conductor", "material": material})
        bsdf = mi.load_dict({"type": "asgconductor", "material": material, "alpha": 0.02})
        n = 1 << 15
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(2, n)
        si = interaction([0.5, 0, 0.8], n)
        _, expected = smooth.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5))
        _, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
        for k in range(3):
            assert dr.mean(weight[k])[0] == pytest.approx(dr.mean(expected[k])[0], rel=5e-3)


def test_textured_roughness_is_used():
    texture = {
        "type": "checkerboard",
        "color0": 0.05,
        "color1": 0.5,
        "to_uv": mi.ScalarTransform4f().scale([2, 2, 1]),
    }
    bsdf = mi.load_dict(PERFECT | {"alpha_u": texture, "alpha_v": 0.1})
    si = interaction([0, 0, 1], 2)
    si.uv = mi.Point2f(mi.Float([0.1, 0.4]), 0.1)
    peak = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)).x.numpy()
    assert max(peak) / min(peak) == pytest.approx(10, rel=0.1)  # D(z) ∝ 1/(alpha_u alpha_v)


@pytest.mark.parametrize(
    "wrong, word",
    [
        ({"alpha": 0.0}, "alpha"),
        ({"alpha": float("nan")}, "alpha"),
        ({"alpha": -1.0}, "alpha"),
        ({"alpha_u": 0.1}, "alpha_v"),
        ({"alpha": 0.1, "alpha_u": 0.1, "alpha_v": 0.1}, "alpha"),
        ({"material": "Unobtainium"}, "Unobtainium"),
        ({"eta": 1.0}, "together"),
        ({"material": "Cu", "eta": 1.0, "k": 1.0}, "either"),
    ],
)
def test_wrong_parameters_are_refused_by_name(wrong, word):
    with pytest.raises(Exception, match=word):
        mi.load_dict({"type": "asgconductor"} | wrong)


def test_path_renders_it_in_every_variant(variants_all):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "lamp": {"type": "constant"},
            "ball": {
                "type": "sphere",
                "center": [0, 0, 3],
                "bsdf": {"type": "asgconductor", "material": "Au", "alpha_u": 0.1, "alpha_v": 0.4},
            },
        }
    )
    image = mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=16)
    assert dr.all(dr.isfinite(image), axis=None) and dr.mean(image, axis=None) > 0.1
