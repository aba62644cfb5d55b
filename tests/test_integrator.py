"""Mitsuba's render() contract, the parameters, and switching variants."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import slow
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")

SMALL = {"type": "aniso_pm", "map": "global", "photon_count": 5000, "initial_radius": 0.1}


@pytest.fixture
def rgb(variant_llvm_rgb):
    pass


@pytest.fixture
def scene(rgb):
    return mi.load_dict(room_with_plate(16))


def integrator(**parameters):
    return mi.load_dict(SMALL | parameters)


def array(image):
    return np.array(image, dtype=np.float64)


# --- render() ---


def test_sensor_may_be_an_index_or_an_object_and_seed_an_int_or_an_array(scene):
    plugin = integrator()
    first = array(plugin.render(scene, sensor=0, seed=3, spp=4))
    second = array(plugin.render(scene, scene.sensors()[0], mi.UInt32(3), 4))
    # The order in which threads store photons changes the order of float sums.
    np.testing.assert_allclose(first, second, rtol=1e-3, atol=1e-4)


def test_the_seed_decides(scene):
    plugin = integrator()
    images = [array(mi.render(scene, integrator=plugin, spp=4, seed=s)) for s in (1, 1, 2)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-4)
    assert np.abs(images[0] - images[2]).max() > 1e-2


def test_every_pixel_is_finite_and_lit(scene):
    image = array(mi.render(scene, integrator=integrator(), spp=16))
    assert image.shape == (16, 16, 3)
    assert np.isfinite(image).all() and image.min() > 0


def test_spp_is_what_was_asked_for_whatever_the_sampler(rgb):
    definition = room(size=8)
    definition["sensor"]["sampler"] = {"type": "multijitter"}
    plugin = integrator()
    image = mi.render(mi.load_dict(definition), integrator=plugin, spp=5)
    assert plugin.statistics["spp"] == 5
    assert plugin.statistics["eye_samples"] == 5 * 64
    assert np.isfinite(array(image)).all()


def test_spp_is_shared_by_the_passes_and_none_is_lost(scene):
    plugin = integrator(passes=4)
    mi.render(scene, integrator=plugin, spp=10)
    assert plugin.statistics["spp"] == 10
    assert plugin.statistics["passes"] == 4
    assert plugin.statistics["photons_emitted"] == 4 * 5000


def test_fewer_samples_than_passes_are_refused_with_the_remedy(scene):
    with pytest.raises(ValueError, match="raise the sample count to 8"):
        integrator(passes=8).render(scene, spp=4)


def test_develop_false_leaves_the_picture_in_the_film(scene):
    plugin = integrator()
    nothing = plugin.render(scene, spp=4, develop=False, evaluate=False)
    assert dr.width(nothing) == 0
    image = array(mi.TensorXf(scene.sensors()[0].film().bitmap()))
    expected = array(plugin.render(scene, spp=4))
    np.testing.assert_allclose(image, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "rfilter, border",
    [
        ("gaussian", False),
        ("lanczos", True),
        *slow(("box", False), ("mitchell", False), ("gaussian", True), ("box", True)),
    ],
)
def test_reconstruction_filters_agree_with_path(rgb, rfilter, border):
    """In an empty box lit by its own walls path and photon mapper see the same radiance."""
    definition = room(size=12)
    definition["sensor"]["film"] |= {"rfilter": {"type": rfilter}, "sample_border": border}
    scene = mi.load_dict(definition)
    ours = array(mi.render(scene, integrator=integrator(photon_count=50_000), spp=64))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=64))
    assert ours.shape == path.shape
    assert ours.mean() == pytest.approx(path.mean(), rel=0.05)
    # Pixel by pixel: a shift of the image by one pixel would show at the edges of the walls.
    assert np.abs(ours - path).mean() < 0.08 * path.mean()


def test_crop_window_is_that_part_of_the_picture(rgb):
    definition = room(size=16)
    whole = array(mi.render(mi.load_dict(definition), integrator=integrator(), spp=256))
    definition["sensor"]["film"] |= {
        "crop_width": 8,
        "crop_height": 6,
        "crop_offset_x": 5,
        "crop_offset_y": 7,
    }
    part = array(mi.render(mi.load_dict(definition), integrator=integrator(), spp=256))
    assert part.shape == (6, 8, 3)
    np.testing.assert_allclose(part.mean((0, 1)), whole[7:13, 5:13].mean((0, 1)), rtol=0.05)


def camera_with_alpha(size):
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"}
    return {"type": "perspective", "film": film | {"rfilter": {"type": "box"}}}


@pytest.mark.parametrize("hide", [False, True])
def test_alpha_and_hidden_emitters_are_those_of_path(rgb, hide):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera_with_alpha(16),
            "sky": {"type": "constant", "radiance": 0.5},
            "lamp": {
                "type": "sphere",
                "center": [0, 0, 5],
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2.0}},
            },
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([-2, 0, 8]).rotate([0, 1, 0], 180),
            },
        }
    )
    ours = array(mi.render(scene, integrator=integrator(hide_emitters=hide), spp=256))
    path = mi.load_dict({"type": "path", "hide_emitters": hide})
    path = array(mi.render(scene, integrator=path, spp=256))
    # 256 samples: standard error of a pixel's coverage at most 3 %, of its radiance 5 %.
    np.testing.assert_allclose(ours[..., 3], path[..., 3], atol=0.15)
    np.testing.assert_allclose(ours[..., 3].mean(), path[..., 3].mean(), atol=0.01)
    np.testing.assert_allclose(ours[..., :3].mean(), path[..., :3].mean(), rtol=0.03)


def test_inside_aov_it_renders_the_same_picture(scene):
    plain = array(mi.render(scene, integrator=integrator(), spp=64))
    outer = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": SMALL})
    image = array(mi.render(scene, integrator=outer, spp=64))
    assert image.shape[2] == plain.shape[2] + 1
    np.testing.assert_allclose(image[..., :3].mean(), plain.mean(), rtol=0.05)


def test_aov_uses_the_map_that_render_left(scene, monkeypatch):
    from aniso_pm.transport import photons

    built = []
    build_map = photons.build_map
    monkeypatch.setattr(photons, "build_map", lambda *a: built.append(a[2]) or build_map(*a))
    mi.render(scene, integrator=mi.load_dict({"type": "aov", "aovs": "d:depth", "i": SMALL}), spp=1)
    assert built.count(SMALL["photon_count"]) == 1  # the others are the pilot's


def test_inside_moment_it_sees_the_scene_as_it_is_now(rgb):
    scene = mi.load_dict(room(size=8))
    outer = mi.load_dict({"type": "moment", "image": SMALL})
    before = array(mi.render(scene, integrator=outer, spp=64))[..., :3].mean()
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] = mi.Color3f(0)
    parameters.update()
    after = array(mi.render(scene, integrator=outer, spp=64))[..., :3].mean()
    assert before > 0.05 and after == 0


def test_isotropic_and_anisotropic_are_the_same_where_nothing_is_anisotropic(rgb):
    scene = mi.load_dict(room(size=8))
    images = [
        array(mi.render(scene, integrator=integrator(kernel=k), spp=4))
        for k in ("isotropic", "anisotropic")
    ]
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-4)


def test_statistics_count_what_happened(scene):
    plugin = integrator(photon_count=20_000)
    mi.render(scene, integrator=plugin, spp=4)
    s = plugin.statistics
    assert s["eye_samples"] == 4 * 256
    assert 0 < s["gather_points_anisotropic"] < s["gather_points"] <= s["eye_samples"]
    assert s["photons_stored"] > s["photons_emitted"] == 20_000
    assert s["photons_rejected"] == s["eye_samples_rejected"] == 0
    assert set(s["seconds"]) == {"pilot", "photons", "index", "eye", "gather", "film"}


def test_progress_is_reported_after_every_pass(scene):
    calls = []
    plugin = integrator(passes=3)
    plugin.progress = lambda done, total, text: calls.append((done, total))
    mi.render(scene, integrator=plugin, spp=3)
    assert calls == [(1, 3), (2, 3), (3, 3)]  # one wavefront a pass


def test_interruption_keeps_the_passes_so_far(scene):
    plugin = integrator(passes=3)

    def interrupt(done, total, text):
        if done == 2:
            raise KeyboardInterrupt

    plugin.progress = interrupt
    image = array(plugin.render(scene, spp=3))
    assert plugin.statistics["interrupted"] and plugin.statistics["spp"] == 2
    assert np.isfinite(image).all() and image.mean() > 0


def test_a_real_interrupt_ends_in_a_picture(scene):
    """SIGINT at any moment after the first wavefront, also while Dr.Jit traces a loop."""
    import signal

    plugin = integrator(passes=1000)
    handler = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    ctrl_c = signal.signal(signal.SIGINT, signal.default_int_handler)  # in background jobs, too
    try:
        for delay in (0.01, 0.3, 0.7):
            armed = []

            def after_first_wavefront(*_, armed=armed, delay=delay):
                if not armed:
                    signal.setitimer(signal.ITIMER_REAL, delay)
                    armed.append(True)

            plugin.progress = after_first_wavefront
            image = array(plugin.render(scene, spp=1000))
            assert plugin.statistics["interrupted"]
            assert 0 < plugin.statistics["spp"] < 1000
            assert np.isfinite(image).all() and image.mean() > 0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        signal.signal(signal.SIGINT, ctrl_c)


def test_statistics_of_an_earlier_render_do_not_survive_a_failure(scene):
    plugin = integrator(passes=2)
    mi.render(scene, integrator=plugin, spp=2)
    with pytest.raises(ValueError):
        plugin.render(scene, spp=1)
    assert plugin.statistics.get("spp", 0) == 0


@pytest.mark.with_pilot
def test_later_passes_compile_nothing(scene):
    """The radius of a pass is data, not part of the kernels."""
    mi.render(scene, integrator=integrator(passes=2), spp=2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        mi.render(scene, integrator=integrator(passes=4, initial_radius=0.13), spp=4)
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    misses = [k for k in history if not k["cache_hit"]]
    # Photon numbers differ between passes; what depends on them is of the size of an array.
    assert len(misses) == 0, [(k["size"], k["operation_count"]) for k in misses]


@pytest.mark.with_pilot
def test_automatic_radius_scales_with_the_scene_and_the_photons(rgb):
    """Sixty photons a kernel, whatever the unit of length; √2 smaller with twice the photons."""
    radii = {}
    for scale in (1, 100):
        T = mi.ScalarTransform4f
        definition = room(size=16)
        for name, part in definition.items():
            if isinstance(part, dict) and "to_world" in part:
                if name == "sensor":
                    part["to_world"] = T().look_at(
                        origin=[0, 0, 0.97 * scale], target=[0, -0.15 * scale, 0], up=[0, 1, 0]
                    )
                else:
                    part["to_world"] = T().scale(scale) @ part["to_world"]
        scene = mi.load_dict(definition)
        for count in (50_000, 100_000):
            plugin = integrator(initial_radius=0.0, photon_count=count)
            mi.render(scene, integrator=plugin, spp=4)
            radii[scale, count] = plugin.statistics["initial_radius"]
            s = plugin.statistics
            # Up to twice as wide where light is smooth.
            assert 30 < s["photons_gathered"] / s["gather_points"] < 4 * 120
    assert radii[100, 50_000] == pytest.approx(100 * radii[1, 50_000], rel=0.1)
    assert radii[1, 100_000] == pytest.approx(radii[1, 50_000] / 2**0.5, rel=0.1)


# --- Scenes with little in them ---


def test_a_scene_without_emitters_is_black(rgb):
    definition = room(size=8)
    del definition["light"]["emitter"]
    assert array(mi.render(mi.load_dict(definition), integrator=integrator(), spp=4)).max() == 0


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


def test_a_scene_without_shapes_is_rendered(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
            "sky": {"type": "constant", "radiance": 0.25},
        }
    )
    image = array(mi.render(scene, integrator=integrator(initial_radius=0.0), spp=4))
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


# --- Parameters ---


@pytest.mark.parametrize(
    "name, value, word",
    [
        ("kernel", "round", "anisotropic, isotropic"),
        ("rule", "best", "taylor, paper, lobe"),
        ("size", "huge", "bandwidth, epsilon"),
        ("epsilon", 0.0, "between"),
        ("epsilon", float("nan"), "between"),
        ("max_aspect", 0.5, "between"),
        ("gather_tolerance", 1.5, "between 0 and 1"),
        ("photon_count", -5, "between"),
        ("photon_count", 1.5, "integer"),
        ("photon_count", "many", "integer"),
        ("passes", 0, "between"),
        ("alpha", 0.0, "above 0"),
        ("alpha", 1.5, "at most 1"),
        ("initial_radius", -1.0, "positive"),
        ("initial_radius", float("inf"), "positive"),
        ("max_depth", 0, "unlimited"),
        ("max_depth", -2, "unlimited"),
        ("rr_depth", 0, "between"),
        ("map", "local", "global, caustic, auto"),
        ("max_memory", -1.0, "0 (automatic)"),
        ("max_memory", float("nan"), "0 (automatic)"),
        ("max_memory", "8G", "float"),
        ("guard", 1, "boolean"),
        ("guard", "true", "boolean"),
    ],
)
def test_wrong_parameters_are_refused_by_name_value_and_range(rgb, name, value, word):
    with pytest.raises(Exception) as caught:
        mi.load_dict({"type": "aniso_pm", name: value})
    text = str(caught.value)
    assert "aniso_pm" in text and f'"{name}"' in text and word in text


def test_unknown_parameters_are_reported(rgb):
    with pytest.raises(Exception, match="photons_count"):
        mi.load_dict({"type": "aniso_pm", "photons_count": 5})


def test_parameters_round_trip(rgb):
    plugin = integrator(rule="taylor", passes=7, hide_emitters=True)
    values = plugin.parameters()
    assert (values["rule"], values["passes"], values["hide_emitters"]) == ("taylor", 7, True)
    again = mi.load_dict({"type": "aniso_pm"} | values)
    assert again.parameters() == values


def test_integers_serve_as_floats(rgb):
    assert integrator(initial_radius=1).parameters()["initial_radius"] == 1.0


# --- Variants ---


def test_mono_sees_the_luminance_of_grey_scenes(variant_llvm_mono):
    definition = room(size=16)
    scene = mi.load_dict(definition)
    image = array(mi.render(scene, integrator=integrator(photon_count=50_000), spp=64))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=256))
    assert image.mean() == pytest.approx(path.mean(), rel=0.03)


@pytest.mark.parametrize(
    "emitter",
    ["textured", "envmap", *slow("area", "point")],
)
def test_spectral_agrees_with_path(variant_llvm_spectral, emitter):
    """The lamps' spectra differ and the rays' wavelengths are not the lamps' own: a wrong spectrum
    or pairing shows in the colour."""
    tungsten = {
        "type": "irregular",
        "wavelengths": "360, 500, 600, 700, 830",
        "values": "0.2, 1, 3, 6, 8",
    }
    definition = room(size=8)
    if emitter == "area":
        definition["light"]["emitter"]["radiance"] = tungsten
    elif emitter == "textured":
        texels = np.random.default_rng(2).uniform(0, 9, (4, 4, 3)).astype(np.float32)
        radiance = {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True}
        definition["light"]["emitter"]["radiance"] = radiance | {"raw": False}
        definition["lamp"] = {"type": "point", "position": [0, 0.5, 0], "intensity": tungsten}
    elif emitter == "point":
        definition["light"] = {"type": "point", "position": [0, 0.5, 0], "intensity": tungsten}
    else:
        sky = np.full((8, 16, 3), 0.4, np.float32)
        sky[1:3, 3:6] = [9, 4, 1]
        definition["light"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
        del definition["ceiling"]
    scene = mi.load_dict(definition)
    ours = integrator(photon_count=20_000, passes=32, initial_radius=0.05)
    image = array(mi.render(scene, integrator=ours, spp=512)).mean((0, 1))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    np.testing.assert_allclose(image, path.mean((0, 1)), rtol=0.03)


def test_specfilm_agrees_with_path(variant_llvm_spectral):
    """Bands of its own instead of RGB."""
    definition = room(size=8)
    definition["sensor"]["film"] = {
        "type": "specfilm",
        "width": 8,
        "height": 8,
        "rfilter": {"type": "box"},
        "component_format": "float32",
        "band1_low": {"type": "spectrum", "value": [(400, 1.0), (500, 1.0), (550, 0.0)]},
        "band2_high": {"type": "spectrum", "value": [(500, 0.0), (600, 1.0), (700, 1.0)]},
    }
    scene = mi.load_dict(definition)
    ours = integrator(photon_count=20_000, passes=32, initial_radius=0.05)
    image = array(mi.render(scene, integrator=ours, spp=512)).mean((0, 1))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    assert image.shape == (2,)
    np.testing.assert_allclose(image, path.mean((0, 1)), rtol=0.03)


def test_spectral_refuses_what_cannot_share_wavelengths(variant_llvm_spectral):
    definition = room(size=4)
    texture = {"type": "bitmap", "data": mi.TensorXf(np.ones((2, 2, 3), np.float32))}
    definition["light"] = {"type": "projector", "irradiance": texture}
    with pytest.raises(ValueError, match="is a projector.*use an RGB variant"):
        integrator().render(mi.load_dict(definition), spp=1)


@pytest.mark.parametrize("kind", ["thinlens", "orthographic", "batch"])
def test_other_sensors_see_what_path_sees(rgb, kind):
    T = mi.ScalarTransform4f
    definition = room(size=16)
    camera = definition["sensor"]
    film = camera["film"]
    if kind == "thinlens":
        definition["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 1.5}
    elif kind == "orthographic":
        to_world = T().look_at([0, 0, 0.9], [0, -0.2, 0], [0, 1, 0]).scale([0.8, 0.8, 1])
        definition["sensor"] = {"type": "orthographic", "to_world": to_world, "film": film}
    else:
        cameras = {}
        for k in range(2):
            to_world = T().look_at([0.4 * k, 0, 0.97], [0, -0.15, 0], [0, 1, 0])
            cameras[f"camera{k}"] = {"type": "perspective", "fov": 75, "to_world": to_world}
        definition["sensor"] = {"type": "batch", "film": film | {"width": 32}} | cameras
    scene = mi.load_dict(definition)
    image = array(mi.render(scene, integrator=integrator(photon_count=100_000, passes=2), spp=128))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=512))
    assert image.shape == path.shape
    columns = lambda a: a.reshape(16, -1, 8, 3).mean((0, 2))  # noqa: E731
    np.testing.assert_allclose(columns(image), columns(path), rtol=0.04)


def test_scalar_variants_are_refused_at_loading():
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(Exception, match='the variant "scalar_rgb" has no'):
            mi.load_dict({"type": "aniso_pm"})
    finally:
        mi.set_variant(before or "llvm_ad_rgb")


def test_switching_variants_there_and_back_changes_nothing():
    before = mi.variant()
    images = []
    for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"):
        mi.set_variant(variant)
        assert type(mi.load_dict(SMALL)).__name__ == "AnisoPhotonMapper"
        assert type(mi.load_dict({"type": "asgconductor"})).__name__ == "ASGConductor"
        if variant == "llvm_ad_rgb":
            scene = mi.load_dict(room_with_plate(8))
            images.append(array(mi.render(scene, integrator=integrator(), spp=4)))
    mi.set_variant(before or "llvm_ad_rgb")
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-4)


def test_it_loads_from_xml(rgb):
    scene = mi.load_string(
        """<scene version="3.0.0">
             <integrator type="aniso_pm">
               <string name="kernel" value="isotropic"/>
               <integer name="photon_count" value="1234"/>
               <float name="initial_radius" value="0.5"/>
             </integrator>
             <shape type="sphere"><bsdf type="asgconductor">
               <string name="material" value="Al"/>
               <float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.3"/>
             </bsdf></shape>
           </scene>"""
    )
    values = scene.integrator().parameters()
    assert values["photon_count"] == 1234 and values["kernel"] == "isotropic"


def test_parameters_are_reachable_through_traverse(rgb):
    own = {"type": "aniso_pm", "photon_count": 100, "map": "global"}
    scene = mi.load_dict(room(size=4) | {"integrator": own})
    parameters = mi.traverse(scene)
    parameters["integrator.photon_count"] = 200
    parameters["integrator.guard"] = False
    parameters.update()
    settings = scene.integrator().settings
    assert (settings.photon_count, settings.guard) == (200, False)
    assert settings.alpha == 2 / 3  # untouched, not rounded
    mi.render(scene, spp=1)
    assert scene.integrator().statistics["photons_emitted"] == 200
    with pytest.raises(Exception, match='"photon_count" is -5'):
        parameters["integrator.photon_count"] = -5
        parameters.update()


def test_what_traverse_changed_is_in_the_next_picture(rgb):
    """A lamp twice as bright, walls twice as dark, a mirror that turns matt: no map, need or
    kernel outlives what it was made from."""
    definition = room_with_plate(size=8)
    scene = mi.load_dict(definition)
    plugin = integrator(photon_count=50_000)
    render = lambda s: np.array(plugin.render(s, seed=3, spp=256)).mean()  # noqa: E731
    before = render(scene)
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] *= 2
    parameters.update()
    assert render(scene) == pytest.approx(2 * before, rel=1e-3)
    parameters["plate.bsdf.brdf_0.alpha_u.value"] = 0.4
    parameters["plate.bsdf.brdf_0.alpha_v.value"] = 0.4
    parameters.update()
    definition["light"]["emitter"]["radiance"]["value"] = [16, 15, 14]
    definition["plate"]["bsdf"]["bsdf"] |= {"alpha_u": 0.4, "alpha_v": 0.4}
    fresh = render(mi.load_dict(definition))
    assert render(scene) == pytest.approx(fresh, rel=1e-3)
    assert fresh != pytest.approx(2 * before, rel=1e-3)
