"""Mistakes that people make are told, with the remedy; what is right is rendered without a word."""

import contextlib

import mitsuba as mi
import numpy as np
import pytest
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@contextlib.contextmanager
def warnings():
    """What Mitsuba's log is told while the block runs."""
    told = []

    class Collect(mi.Appender):
        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                told.append(text)

        def log_progress(self, *_):
            pass

    logger = mi.logger()
    before = [logger.appender(k) for k in range(logger.appender_count())]
    logger.clear_appenders()
    logger.add_appender(Collect())
    try:
        yield told
    finally:
        logger.clear_appenders()
        for appender in before:
            logger.add_appender(appender)


def told(definition, **parameters):
    scene = mi.load_dict(definition)
    with warnings() as lines:
        plugin = mi.load_dict({"type": "aniso_pm", "photon_count": 5000} | parameters)
        plugin.render(scene, spp=4)
    return "\n".join(lines)


def quad(texture_coordinates, bsdf):
    """Two triangles in the plane z = 0."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("quad", 4, 2, properties, has_vertex_texcoords=texture_coordinates)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]
    if texture_coordinates:
        parameters["vertex_texcoords"] = [0, 0, 1, 0, 1, 1, 0, 1]
    parameters["faces"] = [0, 1, 2, 0, 2, 3]
    parameters.update()
    return mesh


BRUSHED = {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.2}


def test_mitsuba_turns_the_grooves_of_meshes_without_texture_coordinates():
    """The fact that the warning is about: each triangle has a direction of its own."""
    scene = mi.load_dict({"type": "scene", "quad": quad(False, BRUSHED)})
    ray = mi.Ray3f(mi.Point3f([0.4, -0.6], [-0.6, 0.4], 1), mi.Vector3f(0, 0, -1))
    tangent = np.array(scene.ray_intersect(ray).sh_frame.s).T
    assert tangent[0] @ tangent[1] < 0.9


@pytest.mark.parametrize(
    "texture_coordinates, bsdf, warned",
    [
        (False, BRUSHED, True),
        (False, {"type": "twosided", "bsdf": BRUSHED}, True),
        (True, BRUSHED, False),
        (False, {"type": "roughconductor", "alpha": 0.1}, False),
        (False, {"type": "diffuse"}, False),
    ],
)
def test_anisotropic_meshes_without_texture_coordinates_are_named(
    texture_coordinates, bsdf, warned
):
    text = told(room({"quad": quad(texture_coordinates, bsdf)}, 4))
    assert ("quad: " in text and "texture coordinates" in text) == warned, text
    if warned:
        assert "first edge of every triangle" in text


def test_shapes_that_share_a_bsdf_are_all_looked_at():
    bsdf = mi.load_dict(BRUSHED)
    extra = {"plate": {"type": "rectangle", "bsdf": bsdf}}
    mesh = quad(False, {"type": "diffuse"})
    mesh.set_bsdf(bsdf)
    assert "quad: RoughConductor" in told(room(extra | {"quad": mesh}, 4))


def test_a_scene_without_emitters_says_what_to_add():
    dark = room(size=4)
    del dark["light"]
    text = told(dark)
    assert "no emitters" in text and "area" in text


@pytest.mark.parametrize("target, words", [(5.0, "500% of the picture"), (0.9, "")])
def test_a_target_error_that_looks_like_per_cent_is_told(target, words):
    text = told(room(size=4), target_error=target)
    assert words in text and ("target_error" in text) == bool(words), text


@pytest.mark.parametrize(
    "radius, words",
    [(1e-4, "photons in the mean"), (0.6, "blur everything"), (0.1, ""), (0.0, "")],
)
def test_a_radius_of_the_wrong_magnitude_is_told(radius, words):
    text = told(room_with_plate(8), initial_radius=radius)
    assert words in text and ("initial_radius" in text) == bool(words), text


@pytest.mark.parametrize("radius", [1e-9, 1e3])
def test_a_radius_that_nobody_can_mean_is_refused_with_the_range(radius):
    with pytest.raises(ValueError, match=r"scene is 3\.\d+ large; give a length between .* or 0"):
        told(room(size=4), initial_radius=radius)


@pytest.mark.parametrize("away, size, words", [(3000, 1, "0.27 off"), (0, 1e-3, "size of 1 to")])
def test_scenes_of_which_mitsuba_starts_rays_far_off_surfaces_are_told(away, size, words):
    here = mi.ScalarTransform4f().translate([away, 0, 0])
    lit = {
        "ball": {"type": "sphere", "to_world": here @ mi.ScalarTransform4f().scale(size)},
        "light": {"type": "constant"},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
    }
    text = told({"type": "scene"} | lit)
    assert words in text and "Move the scene to the origin" in text, text


@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "orthogonal", "ldsampler"])
def test_samplers_that_round_the_samples_up_are_counted_as_they_are(sampler):
    definition = room(size=4)
    definition["sensor"]["sampler"] = {"type": sampler}
    plugin = mi.load_dict({"type": "aniso_pm", "photon_count": 1000, "passes": 2})
    with warnings() as lines:
        plugin.render(mi.load_dict(definition), spp=2)
    taken = plugin.statistics["spp"]
    assert taken >= 2 and plugin.statistics["eye_samples"] == 16 * taken
    assert taken == 2 or any("rounding" in line for line in lines)


def test_the_scalar_variant_names_one_that_works():
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="llvm_ad_rgb"):
        mi.load_dict({"type": "aniso_pm"})
    mi.set_variant(before)
