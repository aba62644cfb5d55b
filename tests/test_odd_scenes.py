"""Scenes that lack something, or have what cannot be rendered."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering.state import Checkpoint
from renders import array, camera_with_alpha, integrator
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture
def scene(rgb):
    return mi.load_dict(room_with_plate(16))


def test_a_scene_without_emitters_is_black(rgb):
    definition = room(size=8)
    del definition["light"]["emitter"]
    assert array(mi.render(mi.load_dict(definition), integrator=integrator(), spp=4)).max() == 0


@pytest.mark.parametrize("map_", ["auto", "global", "caustic"])
def test_a_black_environment_map_takes_no_light_away(rgb, map_):
    """Its density is 0/0."""
    to_world = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.2)
    emitter = {"type": "area", "radiance": 10.0}
    look = mi.ScalarTransform4f().look_at([0, -3, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    definition = {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": look, "film": film},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((8, 16, 3), np.float32))},
        "floor": {"type": "rectangle"},
        "lamp": {"type": "rectangle", "to_world": to_world, "emitter": emitter},
        "ball": {"type": "sphere", "radius": 0.3},
    }
    scene = mi.load_dict(definition)
    plugin = integrator(initial_radius=0.0, map=map_)
    image = array(mi.render(scene, integrator=plugin, spp=1024))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024))
    np.testing.assert_allclose(image.mean(), path.mean(), rtol=0.02)
    assert plugin.statistics["eye_samples_rejected"] == 0


def test_a_scene_without_receivers_is_path_traced(rgb):
    definition = {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "center": [0, 0, 4], "bsdf": {"type": "roughconductor"}},
    }
    scene = mi.load_dict(definition)
    plugin = integrator(initial_radius=0.0)
    image = array(mi.render(scene, integrator=plugin, spp=256))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=256))
    np.testing.assert_allclose(image.mean(), path.mean(), rtol=0.01)
    assert plugin.statistics["photons_emitted"] == 0


def test_media_are_refused_with_one_sentence(rgb):
    definition = room(size=8)
    definition["fog"] = {
        "type": "sphere",
        "radius": 0.3,
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous"},
    }
    scene = mi.load_dict(definition)
    with pytest.raises(ValueError, match='shape "fog" bounds a participating medium'):
        integrator().render(scene, spp=1)


def test_a_camera_in_a_medium_is_refused(rgb):
    definition = room(size=4)
    definition["sensor"]["medium"] = {"type": "homogeneous", "albedo": 0.5}
    with pytest.raises(ValueError, match='sensor "sensor" is in a participating medium'):
        integrator().render(mi.load_dict(definition), spp=1)


def test_a_point_light_of_sampling_weight_zero_is_dark_as_in_path(rgb):
    definition = room(size=8)
    definition["bulb"] = {"type": "point", "intensity": 20.0, "sampling_weight": 0.0}
    image = array(mi.render(mi.load_dict(definition), integrator=integrator(), spp=64))
    path = array(mi.render(mi.load_dict(definition), integrator=mi.load_dict({"type": "path"})))
    assert image.mean() == pytest.approx(path.mean(), rel=0.1)  # 7 times as bright with the bulb


def test_derivatives_are_refused_with_one_sentence(scene):
    plugin = integrator()
    with pytest.raises(Exception, match="derivatives are not supported"):
        plugin.render_backward(scene, None, None)
    with pytest.raises(Exception, match="derivatives are not supported"):
        plugin.render_forward(scene, None)


def test_rendering_while_a_function_is_frozen_is_refused_with_one_sentence(scene):
    plugin = integrator()

    @dr.freeze
    def frozen(seed):
        return plugin.render(scene, seed=seed, spp=1)

    with pytest.raises(RuntimeError) as raised:
        frozen(mi.UInt32(1))
    causes = [raised.value.__cause__, getattr(raised.value.__cause__, "__cause__", None)]
    assert any("take the decorator away" in str(cause) for cause in causes)
    assert array(plugin.render(scene, spp=1)).mean() > 0


def test_lamps_coloured_by_a_mesh_attribute_are_refused_with_one_sentence(rgb, tmp_path):
    lamp = mi.Mesh("lamp", 3, 1)
    found = mi.traverse(lamp)
    found["vertex_positions"], found["faces"] = [-1, -1, 0, 1, -1, 0, 0, 1, 0], [0, 1, 2]
    found.update()
    lamp.add_attribute("vertex_color", 3, [1.0] * 9)
    definition = room(size=4)
    emitter = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}}
    ply = str(tmp_path / "lamp.ply")
    lamp.write_ply(ply)
    definition["lamp"] = {"type": "ply", "filename": ply, "emitter": emitter}
    with pytest.raises(ValueError, match="has a mesh_attribute for its radiance"):
        integrator().render(mi.load_dict(definition), spp=1)


@pytest.mark.with_pilot
def test_a_scene_without_shapes_is_rendered(rgb, tmp_path):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
            "sky": {"type": "constant", "radiance": 0.25},
        }
    )
    for passes in (1, 2, 4):  # the last ones resumed
        plugin = integrator(initial_radius=0.0, passes=passes)
        if passes > 1:
            plugin.checkpoint = Checkpoint(tmp_path / "a.state", resume=True)
        image = array(mi.render(scene, integrator=plugin, spp=4 * passes))
        np.testing.assert_allclose(image[..., :3], 0.25, rtol=1e-3)


@pytest.mark.parametrize("instanced", [False, True])
def test_light_that_only_photons_find_is_refused_among_glossy_surfaces(rgb, instanced):
    definition = room_with_plate(size=4)
    if instanced:
        definition["group"] = {"type": "shapegroup", "plate": definition.pop("plate")}
        definition["copy"] = {"type": "instance", "g": {"type": "ref", "id": "group"}}
    definition["light"]["emitter"] = {"type": "directionalarea"}
    with pytest.raises(ValueError, match="DirectionalArea.*parallel light"):
        integrator().render(mi.load_dict(definition), spp=1)


@pytest.mark.parametrize("radius", [1e-9, 1e3])
def test_a_radius_of_the_wrong_magnitude_is_refused_with_the_right_one(rgb, radius):
    with pytest.raises(ValueError, match='"initial_radius" is .* but the scene is .* large'):
        integrator(initial_radius=radius).render(mi.load_dict(room(size=4)), spp=1)


@pytest.mark.parametrize("front", ["null", "thindielectric"])
def test_hidden_sky_stays_hidden_behind_null_surfaces_as_in_path(rgb, front):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera_with_alpha(8),
            "sky": {"type": "constant", "radiance": 0.5},
            "sheet": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).rotate([0, 1, 0], 180),
                "bsdf": {"type": front},
            },
        }
    )
    ours = array(mi.render(scene, integrator=integrator(hide_emitters=True), spp=256))
    path = mi.load_dict({"type": "path", "hide_emitters": True})
    path = array(mi.render(scene, integrator=path, spp=256))
    np.testing.assert_allclose(ours.mean((0, 1)), path.mean((0, 1)), rtol=0.05, atol=0.005)


def test_an_irradiance_meter_is_a_sensor_like_others(rgb):
    """It knows ray differentials only."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    definition = room(size=4)
    del definition["sensor"]
    definition["meter"] = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f()
        .translate([0, -0.4, 0])
        .rotate([1, 0, 0], -90)
        .scale(0.3),
        "sensor": {"type": "irradiancemeter", "film": film},
    }
    scene = mi.load_dict(definition)
    ours = array(mi.render(scene, integrator=integrator(), spp=16_384)).mean()
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=16_384)).mean()
    assert ours == pytest.approx(path, rel=0.1)


def chequers():
    """Mitsuba draws no points by this texture."""
    tiles = mi.ScalarTransform4f().scale([3, 3, 1])
    return {"type": "checkerboard", "color0": 0.0, "color1": 20.0, "to_uv": tiles}


def checkered_lamp(**shape):
    definition = room({"bulb": {"type": "point", "intensity": 0.1}}, size=8)
    if shape:
        definition["light"] = shape
    definition["light"]["emitter"] = {"type": "area", "radiance": chequers()}
    return mi.load_dict(definition)


@pytest.mark.parametrize("angle", [None, 45, 90])
def test_a_lamp_with_any_texture_shines(rgb, angle):
    """A rectangle, and spheres that are turned."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], angle or 0).scale(0.3)
    scene = checkered_lamp(**({"type": "sphere", "to_world": turned} if angle else {}))
    path = mi.load_dict({"type": "path"})
    ours = [mi.render(scene, integrator=integrator(), spp=256, seed=k) for k in range(4)]
    ratios = np.mean(ours, axis=(1, 2, 3)) / np.mean(mi.render(scene, integrator=path, spp=16_384))
    print(ratios)
    assert abs(ratios.mean() - 1) < 0.005 + 3 * ratios.std(ddof=1) / 2


@pytest.mark.parametrize(
    "emitter",
    [
        {"type": "area", "radiance": {"type": "checkerboard"}},
        {"type": "spot", "texture": {"type": "checkerboard"}},
    ],
    ids=lambda emitter: emitter["type"],
)
def test_scenes_that_are_alive_beside_it_do_not_matter(rgb, emitter):
    """Dr.Jit traces the calls of their emitters, too."""
    other = {"type": "scene", "a": emitter}
    if emitter["type"] == "area":
        other = {"type": "scene", "a": {"type": "rectangle", "emitter": emitter}}
    other = mi.load_dict(other)
    scene = mi.load_dict(room({"bulb": {"type": "point", "intensity": 0.1}}, size=8))
    assert array(mi.render(scene, integrator=integrator(), spp=1)).min() > 0
    assert len(other.emitters()) == 1


@pytest.mark.parametrize("kind, name", [("spot", "texture"), ("projector", "irradiance")])
def test_lamps_without_surface_need_a_texture_that_can_be_drawn_from(rgb, kind, name):
    definition = room(size=8)
    definition["light"] = {"type": kind, "id": "lamp", name: {"type": "checkerboard"}}
    with pytest.raises(ValueError, match='"lamp" has a texture from which.*use a bitmap$'):
        integrator().render(mi.load_dict(definition), spp=1)


def test_a_texture_that_cannot_be_drawn_from_is_named_in_spectral_variants(
    variant_llvm_spectral,
):
    with pytest.raises(ValueError, match="texture from which Mitsuba cannot draw.*RGB variant"):
        integrator().render(checkered_lamp(), spp=1)
