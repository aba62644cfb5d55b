"""Layers: parts of the light that add up to the picture and are what they are called, and what eye
paths see."""

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering.history import recorded
from aniso_pm.rendering.prepared import Prepared
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.state import Checkpoint, State, merge
from aniso_pm.transport import layers
from rooms import room

pytestmark = pytest.mark.usefixtures("without_pilot")

ALL = ",".join(name for name in layers.NAMES if name != "standard_error")
USES = {
    "none": {"map": "caustic"},
    "global": {"map": "global"},
    "caustic": {"map": "caustic"},
    "final_gather": {"final_gather": True},
}


def glass_room(size=16, scale=1.0, ball="dielectric"):
    """A closed room with a glass ball and a plastic block; scale: of all diffuse reflectances."""
    T = mi.ScalarTransform4f
    plastic = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.3]}}
    block = T().translate([-0.5, -0.7, -0.3]).scale(0.3)
    scene = room(
        {
            "ball": {
                "type": "sphere",
                "center": [0.35, -0.55, -0.2],
                "radius": 0.4,
                "bsdf": {"type": ball},
            },
            "block": {"type": "cube", "to_world": block, "bsdf": plastic},
        },
        size=size,
    )
    for shape in scene.values():
        for name in ("reflectance", "diffuse_reflectance"):
            if isinstance(shape, dict) and name in shape.get("bsdf", {}):
                value = shape["bsdf"][name]
                value["value"] = (np.broadcast_to(value["value"], 3) * scale).tolist()
    return scene


def rendered(scene, use="global", spp=16, passes=2, asked=ALL, **parameters):
    plugin = mi.load_dict(
        {"type": "aniso_pm", "passes": passes, "layers": asked} | USES[use] | parameters
    )
    return np.array(mi.render(scene, integrator=plugin, spp=spp, seed=3)), plugin.layers


def assert_adds_up(picture, found):
    total = sum(found[name] for name in layers.LIGHT)
    # Single precision, sums of a few hundred samples
    np.testing.assert_allclose(total, np.broadcast_to(picture[..., :3], total.shape), atol=2e-5)
    for name in layers.LIGHT:
        assert found[name].mean() > 1e-3, name
        assert found[name].min() > -1e-5, name


@pytest.fixture(scope="module")
def scene():
    mi.set_variant("llvm_ad_rgb")
    return mi.load_dict(glass_room())


def as_path_tracer(monkeypatch):
    monkeypatch.setattr(Prepared, "use", property(lambda self: "none"))


def test_light_adds_up_and_is_the_same_for_every_use_of_the_map(
    variant_llvm_rgb, scene, monkeypatch
):
    means = {}
    for use in ("global", "caustic", "final_gather", "none"):
        if use == "none":  # many samples: it finds caustics by chance
            as_path_tracer(monkeypatch)
        spp = 2048 if use == "none" else 64
        picture, found = rendered(scene, use, spp, 1, photon_count=200_000, initial_radius=0.03)
        assert_adds_up(picture, found)
        means[use] = np.array([found[name].mean() for name in layers.LIGHT])
    for use in ("global", "caustic", "final_gather"):
        # Kernels of this width lose up to a tenth of the caustic at the room's edges.
        off = np.abs(means[use] / means["none"] - 1)
        assert (off < [0.02, 0.1, 0.04]).all(), (use, off)


@pytest.mark.parametrize(
    "variant", [pytest.param("llvm_ad_mono", marks=pytest.mark.slow), "llvm_ad_spectral"]
)
@pytest.mark.parametrize(
    "use", ["global", *(pytest.param(use, marks=pytest.mark.slow) for use in list(USES)[2:])]
)
def test_light_adds_up_in_other_variants(variant, use, request):
    request.getfixturevalue(variant.replace("_ad", "").replace("llvm", "variant_llvm"))
    scene = mi.load_dict(glass_room(12))
    assert_adds_up(*rendered(scene, use, asked="direct,caustic,indirect", photon_count=20_000))


def test_light_of_the_first_receiver_is_what_path_finds_in_nearly_black_rooms(
    variant_llvm_rgb, scene
):
    """Light that a receiver reflects once grows with the reflectance, other light with its square;
    and what a black ball in the place of the glass takes away is the caustic."""
    path = mi.load_dict({"type": "path", "rr_depth": 100, "max_depth": 12})

    def lit_once(ball):
        dark, black = (mi.load_dict(glass_room(16, scale, ball)) for scale in (0.01, 0))
        a, b = (np.array(mi.render(s, integrator=path, spp=2048, seed=1)) for s in (dark, black))
        return (a - b) / 0.01

    clear = lit_once("dielectric")
    emission = np.array(mi.render(mi.load_dict(glass_room(16, 0)), integrator=path, spp=2048))
    _, found = rendered(scene, "global", 64, 1, photon_count=300_000, initial_radius=0.02)
    direct = found["direct"] - emission
    ours = direct + found["caustic"]
    assert ours.mean() == pytest.approx(clear.mean(), rel=0.03)  # 1 % of it is reflected twice
    floor = np.zeros(clear.shape[:2], bool)
    floor[12:] = True
    floor &= emission.max(2) < 1e-6  # where the camera sees neither glass nor plastic
    assert floor.sum() > 15
    assert direct[floor].mean() < 0.93 * clear[floor].mean()
    assert ours[floor].mean() == pytest.approx(clear[floor].mean(), rel=0.04)


def test_light_that_only_photons_see_is_direct(variant_llvm_rgb):
    scene = room(size=12)
    scene["light"]["emitter"]["type"] = "directionalarea"
    picture, found = rendered(mi.load_dict(scene), asked="direct,caustic,indirect")
    assert found["direct"].mean() > found["indirect"].mean() > 0.01
    assert np.abs(found["caustic"]).max() < 1e-5
    np.testing.assert_allclose(found["direct"] + found["indirect"], picture, atol=2e-5)


def test_first_surface_and_normal_are_mitsubas(variant_llvm_rgb):
    scene = mi.load_dict(room(size=12))
    _, ours = rendered(scene, spp=256, passes=1, asked="depth,position,normal,albedo")
    aov = mi.load_dict({"type": "aov", "aovs": "d:depth,p:position,n:sh_normal,a:albedo"})
    theirs = np.array(mi.render(scene, integrator=aov, spp=256))
    parts = np.split(theirs, np.cumsum([1, 3, 3]), axis=2)
    for name, want in zip(("depth", "position", "normal", "albedo"), parts, strict=True):
        # The same means by other samples: borders of surfaces differ within a pixel.
        assert np.abs(ours[name] - want).mean() < 0.01, name


def test_mirrors_show_the_albedo_and_the_normal_of_what_is_in_them(variant_llvm_rgb):
    scene = room(size=12)
    scene["back"]["bsdf"] = {"type": "conductor"}
    _, found = rendered(mi.load_dict(scene), asked="albedo,normal,depth")
    front = found["normal"][..., 2] < -0.999
    assert front.sum() > 4
    np.testing.assert_allclose(found["albedo"][front], 0.5, rtol=0.01)
    assert found["depth"][front].min() == pytest.approx(1.97, rel=0.1)  # to the mirror


def test_samples_are_counted_and_radii_shrink(variant_llvm_rgb, scene):
    _, one = rendered(scene, spp=24, passes=1, asked="samples,radius")
    _, more = rendered(scene, spp=96, passes=4, asked="samples,radius", initial_radius=0.1)
    assert one["samples"].sum() == 24 * 16 * 16 and more["samples"].sum() == 96 * 16 * 16
    radii = [0.1]
    for i in range(1, 4):
        radii.append(radii[-1] * ((i + 2 / 3) / (i + 1)) ** 0.5)
    lit = more["radius"] > 0
    assert lit.mean() > 0.9
    assert more["radius"][lit].mean() == pytest.approx(np.mean(radii), rel=0.01)


def test_standard_error_is_a_layer_too(variant_llvm_rgb, scene):
    plugin = mi.load_dict({"type": "aniso_pm", "passes": 3, "layers": "standard_error"})
    mi.render(scene, integrator=plugin, spp=6)
    np.testing.assert_allclose(plugin.layers["standard_error"] ** 2, plugin.variance, rtol=1e-4)


def test_passes_that_were_rendered_apart_have_the_layers_of_the_whole(
    variant_llvm_rgb, scene, tmp_path
):
    def render(first, count, name):
        plugin = mi.load_dict(
            {"type": "aniso_pm", "passes": count, "layers": ALL, "photon_count": 5000}
        )
        plugin.first_pass, plugin.checkpoint = first, Checkpoint(tmp_path / name)
        mi.render(scene, integrator=plugin, spp=4 * count)
        return plugin.layers, State.load(tmp_path / name)

    whole, _ = render(0, 4, "whole")
    parts = {str(first): render(first, 2, str(first))[1] for first in (0, 2)}
    together = merge(parts).layers()
    for name in whole:
        np.testing.assert_allclose(together[name], whole[name], rtol=1e-3, atol=1e-4, err_msg=name)


def test_nothing_is_traced_that_nobody_asks_for(variant_llvm_rgb, scene):
    """Kernels with layers are others, and longer; those without are what they were before."""
    work = {}
    for asked in ("", ALL, " "):
        plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "layers": asked})
        with recorded() as records:
            mi.render(scene, integrator=plugin, spp=8, seed=2)
            kernels = {k["hash"]: k["operation_count"] for k in records()}
        work[asked] = {hash_: n for hash_, n in kernels.items() if n > 400}
        assert bool(plugin.layers) == bool(asked.strip())
    assert work[" "] == work[""]
    longer, shorter = (
        sum(work[a][hash_] for hash_ in work[a].keys() - work[b].keys())
        for a, b in ((ALL, ""), ("", ALL))
    )
    assert longer > 1.1 * shorter > 0


def test_wrong_layers_are_told_in_a_sentence(variant_llvm_rgb):
    with pytest.raises(ValueError, match='"layers" is .*no layer "albeda"; .*direct, .*commas'):
        Settings(layers="albedo,albeda")
    with pytest.raises(ValueError, match='asks for "standard_error".*set "passes" to 2'):
        Settings(layers="standard_error", passes=1)


def test_films_without_room_for_layers_are_refused(variant_llvm_spectral):
    scene = room(size=8)
    response = {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}
    scene["sensor"]["film"] = {"type": "specfilm", "width": 8, "height": 8, "srf": response}
    plugin = mi.load_dict({"type": "aniso_pm", "layers": "albedo"})
    with pytest.raises(ValueError, match="has no room for layers; take an hdrfilm"):
        plugin.render(mi.load_dict(scene))


def test_albedo_in_spectral_variants_is_mitsubas(variant_llvm_spectral):
    scene = mi.load_dict(room(size=8))
    # Each pass has four wavelengths.
    _, found = rendered(scene, spp=256, passes=64, asked="albedo")
    aov = mi.load_dict({"type": "aov", "aovs": "a:albedo"})
    wall = np.s_[3:5, 3:5]  # the back one alone
    theirs = np.array(mi.render(scene, integrator=aov, spp=1024))[wall].mean((0, 1))
    np.testing.assert_allclose(found["albedo"][wall].mean((0, 1)), theirs, rtol=0.03)


def test_depth_behind_a_hidden_lamp_is_counted_from_the_camera(variant_llvm_rgb):
    scene = room(size=8)
    plain = rendered(mi.load_dict(scene), asked="depth", passes=1)[1]["depth"]
    to_world = mi.ScalarTransform4f().translate([0, 0, 0.4]).scale(0.6)
    scene["lamp"] = {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area"}}
    hidden = rendered(mi.load_dict(scene), asked="depth", passes=1, hide_emitters=True)[1]["depth"]
    np.testing.assert_allclose(hidden, plain, rtol=0.05)
