"""Mitsuba's render() contract."""

import gc
import weakref

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import slow
from renders import SMALL, array, camera_with_alpha, integrator
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture
def scene(rgb):
    return mi.load_dict(room_with_plate(16))


def test_sensor_may_be_an_index_or_an_object_and_seed_an_int_or_an_array(scene):
    plugin = integrator()
    first = array(plugin.render(scene, sensor=0, seed=3, spp=4))
    second = array(plugin.render(scene, scene.sensors()[0], mi.UInt32(3), 4))
    # The order in which threads store photons changes the order of float sums.
    np.testing.assert_allclose(first, second, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("sensor", [1, -1])
def test_a_sensor_that_is_not_there_is_named(scene, sensor):
    with pytest.raises(IndexError, match=f"sensor {sensor}: the scene has 1, counted from 0"):
        integrator().render(scene, sensor=sensor, spp=1)


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


def test_inside_aov_it_renders_the_same_picture_in_spectral_variants(variant_llvm_spectral):
    scene = mi.load_dict(room(size=8))
    plain = array(mi.render(scene, integrator=integrator(), spp=16))
    outer = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": SMALL})
    image = array(mi.render(scene, integrator=outer, spp=16))
    np.testing.assert_allclose(image[..., :3], plain, rtol=1e-3, atol=1e-4)


def test_aov_uses_the_map_that_render_left(scene, monkeypatch):
    from aniso_pm.transport import photons

    built = []
    build_map = photons.build_map
    monkeypatch.setattr(
        photons, "build_map", lambda *a, **k: built.append(a[2]) or build_map(*a, **k)
    )
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


def dim(scene, plugin):
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] = mi.Color3f(1e-3)
    parameters.update()


def stay_below(scene, plugin):
    plugin.settings = plugin.settings.with_(max_depth=2)


@pytest.mark.parametrize("change", [dim, stay_below])
def test_inside_moment_no_map_is_used_that_a_render_left_before_a_change(rgb, change):
    scene = mi.load_dict(room(size=8))
    plugin = integrator()
    outer = mi.load_dict({"type": "moment", "image": plugin})
    mi.render(scene, integrator=plugin, spp=4)
    change(scene, plugin)
    first, second = (array(mi.render(scene, integrator=outer, spp=64))[..., :3] for _ in range(2))
    assert first.mean() == pytest.approx(second.mean(), rel=0.1)


def test_no_map_is_left_where_no_integrator_contains_it(scene):
    plugin = integrator()
    mi.render(scene, integrator=plugin, spp=1)
    assert plugin._last_map is None


def test_parameters_are_not_set_as_attributes(rgb):
    with pytest.raises(AttributeError, match=r"\"passes\" is a parameter.*with_\(passes=4\)"):
        integrator().passes = 4


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
    # Not by mi.render, which leaves a sampler behind that the next one has to compute.
    integrator(passes=2).render(scene, spp=2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        integrator(passes=4, initial_radius=0.13).render(scene, spp=4)
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
            # Up to four times as wide where light is smooth, and 60 in the median before.
            assert 30 < s["photons_gathered"] / s["gather_points"] < 16 * 60
    assert radii[100, 50_000] == pytest.approx(100 * radii[1, 50_000], rel=0.1)
    assert radii[1, 100_000] == pytest.approx(radii[1, 50_000] / 2**0.5, rel=0.1)


def test_a_scene_that_holds_its_integrator_is_freed_with_it(rgb):
    """A map that the integrator kept would keep the scene, which keeps the integrator."""
    scene = mi.load_dict(
        room_with_plate(16) | {"integrator": {"type": "aniso_pm", "map": "global"}}
    )
    mi.render(scene, spp=1)
    integrator = weakref.ref(scene.integrator())
    del scene
    gc.collect()
    assert integrator() is None
