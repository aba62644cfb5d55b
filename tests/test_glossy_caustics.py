"""Caustics on glossy surfaces: photons and paths that meet lamps share them; nothing is lost."""

from dataclasses import replace

import aniso_pm  # noqa: F401  (before drjit, so that it can choose LLVM)  # isort: skip
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.map import glossy_caustics
from aniso_pm.rendering import pilot
from aniso_pm.rendering.glossy import rarely_met
from aniso_pm.rendering.needs import read_scene
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from conftest import slow
from renders import array

POINT = {"type": "point", "position": [0.6, 1.6, 4], "intensity": {"type": "rgb", "value": 20}}
METAL = {"type": "roughconductor", "alpha_u": 0.15, "alpha_v": 0.12}
PRINCIPLED = {"type": "principled", "roughness": 0.4, "metallic": 0.5}
GRAY = {"type": "diffuse"}


def lamp(radius):
    """A sphere that sends as much light as the point does."""
    radiance = 20 / (np.pi * radius**2)
    return {
        "type": "sphere",
        "center": [0.6, 1.6, 4],
        "radius": radius,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }


def plate(light, bsdf=METAL, size=24):
    """A glass ball over a plate, in front of nothing."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 32,
            "to_world": T().look_at(origin=[0, -4, 3.2], target=[0, -0.2, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "light": light,
        "plate": {
            "type": "rectangle",
            "to_world": T().scale(1.5),
            "bsdf": {"type": "twosided", "bsdf": bsdf},
        },
        "ball": {
            "type": "sphere",
            "center": [0.1, 0.3, 1.3],
            "radius": 0.5,
            "bsdf": {"type": "dielectric"},
        },
    }


def pictures(scene, integrator, spp, seeds=1):
    integrator = mi.load_dict(integrator)
    render = lambda seed: mi.render(scene, integrator=integrator, spp=spp, seed=seed)  # noqa: E731
    return [array(render(seed)) for seed in range(seeds)]


def picture(scene, integrator, spp, seeds=1):
    return np.mean(pictures(scene, integrator, spp, seeds), 0)


def below_the_ball(image):
    """Where the caustic is, and the ball is not: light tracing does not see that."""
    return float(image[image.shape[0] * 14 // 32 :].mean())


def test_weights_of_both_ways_add_up_to_one(variant_llvm_rgb):
    p, q = np.meshgrid(10.0 ** np.arange(-6, 7), 10.0 ** np.arange(-6, 16))
    p, q = (mi.Float(v.ravel().astype(np.float32)) for v in (p, q))
    chance, photons = glossy_caustics.by_chance(p, q), glossy_caustics.by_photons(p, q)
    np.testing.assert_allclose((chance + photons).numpy(), 1, rtol=1e-6)
    # Veach's power heuristic, in double precision.
    exact = p.numpy().astype(float) ** 2
    exact /= exact + q.numpy().astype(float) ** 2
    np.testing.assert_allclose(chance.numpy(), exact, rtol=1e-5, atol=1e-30)
    assert glossy_caustics.by_photons(mi.Float(3), mi.Float(0))[0] == 0  # came another way


def test_density_of_drawing_a_lamp(variant_llvm_rgb):
    """1/A, the environment's own, more than anything for points."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 1}}
    scene = mi.load_dict({"type": "scene", "a": lamp(0.5), "b": POINT, "c": sky})
    drawn = glossy_caustics.EmitterDensity.of(scene)
    found = {}
    for emitter in scene.emitters():
        of = dr.gather(mi.EmitterPtr, scene.emitters_dr(), scene.emitters().index(emitter))
        density, per_area = drawn.at(of, mi.Vector3f(0, 0, 1), True)
        found[emitter.class_name()] = density[0], per_area[0]
    assert found["AreaLight"] == (pytest.approx(1 / np.pi), True)
    assert found["PointLight"] == (pytest.approx(1e15), False)
    assert found["ConstantBackgroundEmitter"] == (pytest.approx(1 / (4 * np.pi)), False)
    at_two = glossy_caustics.seen_from(mi.Float(3), mi.Bool(True), mi.Float(2))
    assert at_two[0] == 12


@pytest.mark.parametrize("bsdf", [METAL, *slow(PRINCIPLED)], ids=["metal", "principled"])
def test_what_a_point_casts_on_metal_is_that_of_light_tracing(variant_llvm_rgb, bsdf):
    """``path`` cannot see it."""
    scene = mi.load_dict(plate(POINT, bsdf))
    expected = below_the_ball(picture(scene, {"type": "ptracer"}, 8000, 3))
    found = below_the_ball(picture(scene, {"type": "aniso_pm"}, 512))
    seen_by_path = below_the_ball(picture(scene, {"type": "path"}, 64))
    assert seen_by_path < 0.8 * expected
    assert found == pytest.approx(expected, rel=0.015)


USES = {
    "auto": {},
    "global": {"map": "global"},
    "caustic": {"map": "caustic"},
    "final_gather": {"final_gather": True},
    "sums": {"map": "global", "gather_tolerance": 0.05},
}


@pytest.fixture(scope="module")
def seen_by_path():
    """The plate under a lamp, with a rough ball whose light is no photon's, by path tracing."""
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    rough = {"type": "sphere", "center": [-0.6, -0.3, 0.4], "radius": 0.4, "bsdf": METAL}
    scene = mi.load_dict(plate(lamp(0.25)) | {"rough": rough})
    yield scene, picture(scene, {"type": "path"}, 4096, 4)
    if before:
        mi.set_variant(before)


@pytest.mark.parametrize("use", ["auto", "caustic", *slow(*(u for u in USES if u != "caustic"))])
def test_energy_is_that_of_path(variant_llvm_rgb, seen_by_path, use):
    scene, expected = seen_by_path
    prepared = prepare(scene, Settings(**USES[use]), False)
    assert pilot.settle(prepared, scene.sensors()[0], 0, 64).rare
    found = picture(scene, {"type": "aniso_pm", **USES[use]}, 256, 4)
    assert found.mean() == pytest.approx(expected.mean(), rel=0.01)
    assert below_the_ball(found) == pytest.approx(below_the_ball(expected), rel=0.01)


def test_photons_lessen_noise(variant_llvm_rgb, seen_by_path):
    scene, expected = seen_by_path
    noise = {
        name: np.mean([(image - expected) ** 2 for image in pictures(scene, {"type": name}, 32, 4)])
        for name in ("aniso_pm", "path")
    }
    assert noise["aniso_pm"] < 0.2 * noise["path"]


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants(variant, request):
    request.getfixturevalue(f"variant_{variant.replace('_ad', '')}")
    scene = mi.load_dict(plate(lamp(0.25), size=16))
    expected = picture(scene, {"type": "path"}, 4096, 2)
    found = picture(scene, {"type": "aniso_pm"}, 512, 2)
    assert found.mean() == pytest.approx(expected.mean(), rel=0.015)


@pytest.mark.parametrize("tolerance", [0.0, 0.05])
def test_photons_on_metal_are_not_the_floors(variant_llvm_rgb, tolerance):
    """The left half of the plate is diffuse, in one plane with the metal. It gathers what it would
    if photons were kept nowhere else, in single photons and in sums of them."""
    T = mi.ScalarTransform4f
    definition = plate(lamp(0.25))
    half = T().scale([0.75, 1.5, 1])
    definition["plate"]["to_world"] = T().translate([0.75 - 0.1, 0, 0]) @ half
    floor = {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": GRAY}}
    definition["floor"] = floor | {"to_world": T().translate([-0.75 - 0.1, 0, 0]) @ half}
    scene = mi.load_dict(definition)
    settings = Settings(
        map="global", photon_count=50_000, initial_radius=0.3, gather_tolerance=tolerance
    )
    both = prepare(scene, settings, False)
    assert both.glossy
    light, stored = [], []
    for prepared in (both, replace(both, rare=())):
        map_ = prepared.photon_map(0, 0)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 4096)
        rays = pilot.camera_rays(scene.sensors()[0], 0)
        points = prepared.trace(sampler, rays)[2]
        found = prepared.gather(map_, dr.opaque(mi.Float, 0.3), 0, points)
        light.append(found[0].radiance.numpy().sum())
        stored.append(map_.stored)
    assert stored[0] > 1.2 * stored[1]
    assert light[0] == pytest.approx(light[1], rel=0.01 if tolerance else 1e-5)


def rare(definition, roughness=0.2):
    scene = mi.load_dict(definition)
    return rarely_met(scene, read_scene(scene, roughness), roughness)


def test_which_lamps_are_rarely_met(variant_llvm_rgb):
    """Small ones, points, and the sun; not those that fill the lobes of the metal."""
    assert rare(plate(lamp(0.25))) and rare(plate(POINT))
    assert not rare(plate(lamp(0.4)))
    assert rare(plate(lamp(0.4), METAL | {"alpha_u": 0.19, "alpha_v": 0.19}))
    assert not rare(plate({"type": "constant"}))
    assert rare(plate({"type": "sunsky", "sun_direction": [0, 0.3, 1]}))
    assert rare(plate({"type": "directional", "direction": [0, 0, -1]}))


def test_nobody_asks_without_glass_or_gloss(variant_llvm_rgb):
    assert not rare(plate(POINT, GRAY))
    assert not rare(plate(POINT, METAL | {"alpha_u": 0.3, "alpha_v": 0.3}))  # gathers by itself
    assert rare(plate(POINT, METAL | {"alpha_u": 0.3, "alpha_v": 0.3}), roughness=0.4)
    without = plate(POINT)
    without["ball"]["bsdf"] = GRAY
    assert not rare(without)


def test_a_pilot_leaves_them_out_where_they_hardly_show(variant_llvm_rgb):
    """But what a point casts is nobody else's."""
    definition = plate(lamp(0.25), GRAY)
    aside = {"type": "sphere", "center": [0, 0, -3], "radius": 0.2, "bsdf": METAL}
    for light, kept in ((lamp(0.25), False), (POINT, True)):
        scene = mi.load_dict(definition | {"light": light, "aside": aside})
        prepared = prepare(scene, Settings(), False)
        assert prepared.glossy
        found = pilot.settle(prepared, scene.sensors()[0], 0, 16)
        assert bool(found.rare) == kept
        assert found.applied(prepared).glossy == kept
    # What is left out takes nothing.
    assert replace(prepared, rare=()).bytes_per_photon < prepared.bytes_per_photon


def test_shapes_that_do_not_know_their_area_are_not_asked(variant_llvm_rgb):
    """Instances and curves, in this scene and in another one that is alive."""
    T = mi.ScalarTransform4f
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.1, "bsdf": METAL}}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    definition = plate(POINT, size=12) | {
        "group": group,
        "instance": instance | {"to_world": T().translate([0.8, -0.4, 0.2])},
    }
    scene = mi.load_dict(definition)
    assert prepare(scene, Settings(), False).glossy
    with_it = picture(scene, {"type": "aniso_pm"}, 64)
    without = picture(mi.load_dict(plate(POINT, size=12)), {"type": "aniso_pm"}, 64)
    assert np.isfinite(with_it).all()
    assert with_it.mean() == pytest.approx(without.mean(), rel=0.15)


@pytest.mark.parametrize("use", ["global", "caustic"])
def test_a_camera_that_sees_glass_and_metal_alone(variant_llvm_rgb, use):
    """A pilot that leaves out photons on metal has nothing left to read."""
    definition = plate(lamp(0.25), size=12)
    definition["ball"]["to_world"] = mi.ScalarTransform4f().translate([0, 0, 30])
    scene = mi.load_dict(definition)
    prepared = prepare(scene, Settings(map=use), False)
    assert prepared.glossy
    assert not pilot.settle(prepared, scene.sensors()[0], 0, 16).rare


def test_a_black_environment_map_has_no_density(variant_llvm_rgb):
    """Mitsuba says 0/0, which would make every sample non-finite that leaves the scene."""
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((8, 16, 3), np.float32))}
    scene = mi.load_dict(plate(lamp(0.05), size=16) | {"sky": sky})
    prepared = prepare(scene, Settings(), False)
    assert prepared.rare and prepared.drawn.surrounded
    integrator = mi.load_dict({"type": "aniso_pm"})
    array(mi.render(scene, integrator=integrator, spp=64))
    assert integrator.statistics["eye_samples_rejected"] == 0


def test_narrow_lobes_are_left_to_paths(variant_llvm_rgb):
    assert rare(plate(POINT, METAL | {"alpha_u": 0.012, "alpha_v": 0.012}))
    assert not rare(plate(POINT, METAL | {"alpha_u": 0.008, "alpha_v": 0.012}))


def test_light_that_metal_shows_is_direct(variant_llvm_rgb):
    """It has met no gathered part (see ``layers``)."""
    scene = mi.load_dict(plate(POINT))
    plugin = mi.load_dict({"type": "aniso_pm", "layers": "direct, caustic, indirect"})
    image = array(mi.render(scene, integrator=plugin, spp=64))
    np.testing.assert_allclose(plugin.layers["direct"], image[..., :3], rtol=1e-4, atol=1e-5)
    assert plugin.layers["caustic"].max() == plugin.layers["indirect"].max() == 0


def test_kernels_on_smooth_texels_reach_over_rough_ones(variant_llvm_rgb):
    """Photons for them are kept on all: kernels are wider than texels here."""
    alpha = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": 0.12},
        "color1": {"type": "rgb", "value": 0.3},
        "to_uv": mi.ScalarTransform4f().scale([40, 40, 1]),
    }
    means = []
    for roughness in (alpha, 0.12):
        scene = mi.load_dict(plate(POINT, {"type": "roughconductor", "alpha": roughness}))
        settings = Settings(map="global", photon_count=100_000, initial_radius=0.2)
        prepared = prepare(scene, settings, False)
        map_ = prepared.photon_map(0, 0)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 4096)
        points = prepared.trace(sampler, pilot.camera_rays(scene.sensors()[0], 0))[2]
        found = prepared.gather(map_, dr.opaque(mi.Float, 0.2), 0, points)
        # Light of the mean gather point: those on smooth texels are the last.
        means.append(found[-1].radiance.numpy().mean())
    assert means[0] == pytest.approx(means[1], rel=0.1)
