"""Passes: pure, summed with their variance, as many as one likes."""

import math
import signal
import time
from dataclasses import replace
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import progress, progressive, schedule
from aniso_pm.rendering.accumulate import Sums, mean_and_variance, relative_standard_error
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.state import Checkpoint, State
from passes import close, integrator, load, render
from rooms import room, room_with_ball

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


# --- Pure passes ---


def test_bandwidth_is_the_product_of_the_ratios():
    area = 1.0
    for i in range(300):
        assert schedule.bandwidth(2.0, 2 / 3, i) == pytest.approx(2 * area**0.5, rel=1e-9)
        area *= (i + 1 + 2 / 3) / (i + 2)


@pytest.mark.parametrize("filter_", ["box", "gaussian"])
def test_passes_rendered_one_by_one_add_up_to_the_picture(filter_):
    """The mean over passes, each weighted by the reconstruction filter's weights of its samples."""
    scene = load(filter_=filter_)
    together = render(scene, integrator(passes=4), 8)
    film = scene.sensors()[0].film()
    total = 0.0
    for i in range(4):
        render(scene, integrator(), 2, first_pass=i)
        total = total + np.array(film.develop(raw=True), dtype=np.float64)
    close(total[..., :-1] / total[..., -1:], together)


def test_a_pass_does_not_depend_on_how_many_there_are():
    scene = load()
    three, four = (render(scene, integrator(passes=n), 2 * n) for n in (3, 4))
    last = render(scene, integrator(), 2, first_pass=3)
    close(4 * four - 3 * three, last)


def test_passes_differ_from_each_other_and_between_seeds():
    scene = load()
    images = [render(scene, integrator(), 2, seed, i) for seed, i in ((1, 0), (1, 1), (2, 0))]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(images[a] - images[b]).mean() > 0.01


@pytest.mark.parametrize(
    "parameters, spp, pixels, each",
    [
        ({"passes": 4}, 10, 100, [3, 3, 2, 2]),
        ({"passes": 1}, 7, 100, [7]),
        ({"passes": 0, "time": 9.0}, 7, 100, [7, 7]),
        ({"passes": 0, "time": 9.0}, 64, 2**14, [32, 32]),
        ({"passes": 0, "target_error": 0.1}, 64, 2**18, [4, 4]),
        ({"passes": 0, "target_error": 0.1}, 64, 2**20, [2, 2]),
        ({"passes": 0, "target_error": 0.1}, 64, 2**22, [1, 1]),
        ({"passes": 100, "time": 9.0}, 7, 100, [1, 1]),
    ],
)
def test_samples_are_shared_evenly_and_open_ends_take_short_passes(parameters, spp, pixels, each):
    shares = schedule.shares(Settings(**parameters), spp, pixels)
    assert [shares(i) for i in range(len(each))] == each


def test_a_first_pass_below_zero_is_refused():
    with pytest.raises(ValueError, match="first_pass is -1; passes are counted from 0"):
        render(load(), integrator(), 2, first_pass=-1)


def test_sample_numbers_that_a_pixel_does_not_have_are_refused():
    with pytest.raises(ValueError, match="beyond sample 536870912 of a pixel; count them from"):
        schedule.shares(Settings(passes=1), 1024, 64, first_pass=5_000_000)
    with pytest.raises(ValueError, match="beyond sample 536870912 of a pixel; take less"):
        schedule.shares(Settings(passes=1), 600_000_000, 1)


def test_a_rendering_without_end_stops_where_a_pixel_has_no_more_samples(monkeypatch):
    monkeypatch.setattr(progressive, "LARGEST", 100)
    plugin = integrator(passes=0, time=1e6)
    image = render(load(8), plugin, 16)
    assert plugin.statistics["passes"] == 6 and np.isfinite(image).all()
    assert "pass 6 goes beyond sample 100 of a pixel" in plugin.statistics["failure"]


@pytest.mark.parametrize(
    "parameters, spp, size, passes",
    [
        ({}, 16, 160 * 120, 1),
        ({}, 256, 160 * 120, 10),
        ({}, 256, 64 * 64, 8),
        ({}, 2**20, 1, 8),
        ({}, 64, 640 * 480, 16),
        ({}, 3, 4096 * 4096, 3),
        ({}, 0, 64 * 64, 2),
        ({"passes": 1}, 256, 160 * 120, 1),
        ({"photon_count": 1000}, 256, 160 * 120, 1),
        ({"photon_count": 1000, "layers": "standard_error"}, 256, 160 * 120, 2),
        ({"layers": "standard_error"}, 16, 160 * 120, 2),
        ({"time": 1.0}, 256, 160 * 120, 0),
    ],
)
def test_passes_are_as_many_as_make_them_short(parameters, spp, size, passes, monkeypatch):
    monkeypatch.setattr(schedule, "pixel_count", lambda film: size)
    sampler = {"type": "independent", "sample_count": 64}
    sensor = mi.load_dict({"type": "perspective", "sampler": sampler})
    assert schedule.with_passes(Settings(**parameters), spp, sensor).passes == passes


@pytest.mark.with_pilot
def test_automatic_passes_leave_one_picture_and_no_variance():
    plugin = integrator(photon_count=0)
    image = render(load(64), plugin, 96)
    s = plugin.statistics
    assert s["passes"] == 3 and s["photons_emitted"] == 3 * s["photon_count"] and s["spp"] == 96
    assert plugin.variance is None and plugin.parameters()["passes"] == 0
    explicit = integrator(photon_count=0, passes=3)
    close(render(load(64), explicit, 96), image)
    assert explicit.variance is not None


@pytest.mark.with_pilot
def test_pictures_in_spectral_variants_have_passes_for_their_colours(variant_llvm_spectral):
    plugin = integrator(photon_count=0)
    render(load(8), plugin, 32)
    assert plugin.statistics["passes"] == schedule.SPECTRAL_PASSES


@pytest.mark.with_pilot
def test_automatic_photon_count_grows_with_the_samples_of_a_pass():
    """Not in proportion: every gather meets the photons of all light paths."""
    scene = load(64)
    chosen = {}
    for spp in (64, 256):
        plugin = integrator(photon_count=0, passes=1)
        render(scene, plugin, spp)
        s = plugin.statistics
        assert s["photon_count_automatic"] and s["photon_count"] == s["photons_emitted"]
        chosen[spp] = s["photon_count"]
    assert 1.5 < chosen[256] / chosen[64] < 4


@pytest.mark.with_pilot
def test_automatic_photon_count_is_kept_when_resuming(tmp_path):
    path = tmp_path / "a.state"
    scene = load(48)
    render(scene, integrator(photon_count=0, passes=2), 8, checkpoint=Checkpoint(path))
    state = State.load(path)
    chosen = state.settled.count
    state.settled = replace(state.settled, count=chosen + 1)
    state.identity["photon count"] = chosen + 1
    state.save(path)
    plugin = integrator(photon_count=0, passes=3)
    render(scene, plugin, 12, checkpoint=Checkpoint(path, resume=True))
    assert plugin.statistics["photons_emitted"] == 3 * chosen + 1


@pytest.mark.with_pilot
@pytest.mark.parametrize("parts", [(1, 3), pytest.param((2, 2), marks=pytest.mark.slow)])
def test_passes_that_choose_everything_add_up_too(tmp_path, parts):
    """Resumed, with what a pilot chose for every pixel, and whatever their number was to be."""
    scene = mi.load_dict(room_with_ball(size=24))
    own = {"photon_count": 0, "initial_radius": 0.0}
    whole = render(scene, integrator(passes=4, **own), 4 * 8)
    path = tmp_path / "a.state"
    render(scene, integrator(passes=parts[0], **own), parts[0] * 8, checkpoint=Checkpoint(path))
    resumed = integrator(passes=4, **own)
    image = render(scene, resumed, 4 * 8, checkpoint=Checkpoint(path, resume=True))
    assert resumed.statistics["passes"] == 4
    np.testing.assert_allclose(image, whole, rtol=1e-4, atol=1e-6)


# --- Variance ---


def test_variance_of_equal_passes_is_the_textbook_one():
    """With a box filter all weights are equal: the sample variance of the mean of the passes."""
    scene = load()
    passes = np.array([render(scene, integrator(), 2, first_pass=i) for i in range(6)])
    plugin = integrator(passes=6)
    render(scene, plugin, 12)
    expected = passes.var(axis=0, ddof=1) / 6
    np.testing.assert_allclose(plugin.variance, expected, rtol=0.02, atol=1e-7)


def test_variance_of_a_ratio_is_the_jackknife_s():
    """Weights that differ from pass to pass: delete-one jackknife of Σ A / Σ W, which agrees with
    the linearised variance up to terms of relative order 1/m."""
    rng = np.random.default_rng(3)
    m = 400
    weight = rng.uniform(0.2, 2.0, (m, 3, 3, 1))
    value = np.concatenate([weight * rng.gamma(2.0, 1.0, (m, 3, 3, 2)), weight], axis=3)
    sums = Sums.zeros(value.shape[1:], True)
    for image in value:
        sums = sums.plus(mi.TensorXf(image.astype(np.float32)))
    mean, variance = mean_and_variance(sums.arrays(), m)
    left_out = value.sum(0) - value
    ratios = left_out[..., :-1] / left_out[..., -1:]
    jackknife = (m - 1) / m * ((ratios - ratios.mean(0)) ** 2).sum(0)
    np.testing.assert_allclose(mean, value.sum(0)[..., :-1] / value.sum(0)[..., -1:], rtol=1e-6)
    np.testing.assert_allclose(variance, jackknife, rtol=5 / m)


@pytest.mark.parametrize("filter_", ["gaussian", pytest.param("lanczos", marks=pytest.mark.slow)])
def test_variance_predicts_the_spread_between_seeds(filter_):
    """24 pictures: a pixel's sample variance has a standard error of 29 % and a median 3 % below
    its mean; of the median over 192 values, correlated as they are, a few per cent remain. (Their
    mean would be that of the four pixels at the lamp's edge.)"""
    scene = load(filter_=filter_)
    images, predicted = [], []
    for seed in range(24):
        plugin = integrator(passes=5)
        images.append(render(scene, plugin, 10, seed))
        predicted.append(plugin.variance)
    ratio = np.mean(predicted, axis=0) / np.var(images, axis=0, ddof=1)
    # Passes share one stratified sequence: their mean is better than their spread says.
    assert 0.88 < np.median(ratio) < 2.2


def test_squared_sums_cannot_overflow():
    """Passes of 1e-30, 1 and 1e38 in three channels: m passes of A and 3A have the variance of
    their mean, A²/(m − 1) with A the distance of each from it."""
    shape, scale = (1, 1, 4), np.array([1e-30, 1.0, 1e38])
    sums = Sums.zeros(shape, True)
    for factor in (1, 3, 1, 3):
        film = np.concatenate([factor * scale, [1.0]]).astype(np.float32).reshape(shape)
        sums = sums.plus(mi.TensorXf(film))
    mean, variance = mean_and_variance(sums.arrays(), 4)
    np.testing.assert_allclose(mean[0, 0], 2 * scale, rtol=1e-6)
    np.testing.assert_allclose(variance[0, 0], scale**2 / 3, rtol=1e-5)


def test_one_pass_has_no_variance():
    plugin = integrator()
    render(load(), plugin, 2)
    assert plugin.variance is None and plugin.statistics["relative_error"] is None


def test_relative_error_is_scale_free_and_not_hidden_by_a_lamp():
    mean, variance = np.ones((10, 10, 3)), np.full((10, 10, 3), 0.04)
    expected = 0.2 / math.sqrt(1.01)  # σ = 0.2, M = 1, f = 0.1
    assert relative_standard_error(mean, variance) == pytest.approx(expected)
    assert relative_standard_error(7 * mean, 49 * variance) == pytest.approx(expected)
    mean[0, 0] = 1e4
    assert relative_standard_error(mean, variance) == pytest.approx(expected, rel=0.01)
    assert relative_standard_error(0 * mean, variance) == 0


# --- What programs see ---


def test_callback_gets_every_pass_with_the_picture_so_far():
    calls = []
    plugin = integrator(passes=3)
    plugin.callback = lambda i, image, statistics: calls.append((i, np.array(image), statistics))
    scene = load()
    final = render(scene, plugin, 6, first_pass=2)
    assert [i for i, _, _ in calls] == [2, 3, 4]
    assert [s["passes"] for _, _, s in calls] == [1, 2, 3]
    assert calls[0][2]["relative_error"] is None and calls[1][2]["relative_error"] > 0
    close(calls[-1][1], final)
    close(calls[0][1], render(scene, integrator(), 2, first_pass=2))


def test_progress_bar_counts_passes_and_tells_the_error(capsys):
    plugin = integrator(passes=4)
    with progress.bar(plugin, mininterval=0):
        render(load(), plugin, 8)
    assert plugin.progress is None
    shown = capsys.readouterr().err
    assert "pass 4/4, error " in shown and " 4/4 [" in shown


def test_interruption_between_photons_and_eye_paths_leaves_whole_passes():
    plugin = integrator(passes=4)

    def interrupt(done, total, text):
        if done == 2:
            plugin.progress = None
            raise KeyboardInterrupt

    plugin.progress = interrupt
    scene = load()
    image = render(scene, plugin, 8)
    assert plugin.statistics["interrupted"] and plugin.statistics["passes"] == 2
    close(image, render(scene, integrator(passes=2), 4))
    assert plugin.variance.shape == image.shape


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_that_python_loses_ends_rendering_after_the_pass():
    """Where a finaliser runs, KeyboardInterrupt is printed, and the program goes on."""

    class Dying:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    plugin = integrator(passes=6)

    def last_breath(index, image, statistics):
        if index == 1:
            Dying()

    plugin.callback = last_breath
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in background jobs, too
    try:
        render(load(), plugin, 12)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert plugin.statistics["interrupted"] and plugin.statistics["passes"] == 2


def test_open_passes_are_not_as_small_as_a_sampler_has_them_by_itself():
    scene = load()
    sensor = scene.sensors()[0]
    sensor.sampler().set_sample_count(4)
    endless, fixed = Settings(passes=0, time=1.0), Settings(passes=2)
    assert schedule.sample_count(endless, 0, sensor) == 8
    assert schedule.sample_count(endless, 4, sensor) == 4
    assert schedule.sample_count(fixed, 0, sensor) == 4
    sensor.sampler().set_sample_count(32)
    assert schedule.sample_count(endless, 0, sensor) == 32


# --- Long runs ---


@pytest.mark.slow
def test_a_thousand_passes_need_no_more_memory_than_fifty():
    import resource

    scene = load(16)
    render(scene, integrator(passes=50), 50)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    allocated = []
    plugin = integrator(passes=1000)
    plugin.callback = lambda i, image, statistics: allocated.append(_resident())
    render(scene, plugin, 1000)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 20_000  # kB
    early, late = np.mean(allocated[50:150]), np.mean(allocated[-100:])
    print(f"resident: {early / 1e6:.1f} MB around pass 100, {late / 1e6:.1f} MB at the end")
    assert late < 1.02 * early


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return 4096 * pages


@pytest.mark.slow
@pytest.mark.parametrize("name", ["teapot", "fry_pan", "glass_balls"])
def test_later_passes_cost_python_less_than_20_ms(name):
    """Processor time of the main thread, whatever else the machine does: tracing, launching and
    what it computes itself while it waits."""
    path = Path(__file__).parents[1] / "scenes" / f"{name}.xml"
    scene = mi.load_file(str(path), width="32", height="24", optimize=False)
    plugin = integrator(passes=40, photon_count=1000)
    times = []
    plugin.callback = lambda *_: times.append(time.thread_time())
    render(scene, plugin, 40)
    typical = np.median(np.diff(times))
    print(f"{name}: {1e3 * typical:.1f} ms a pass")
    assert plugin.statistics["replayed"] and typical < 0.02


@pytest.mark.with_pilot
@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.01, 1, 1000])
def test_automatic_radius_suits_a_coin_and_a_stadium(scale):
    """Sixty photons a kernel in the median of the light. In a room of 24 square units, evenly lit,
    that is a kernel area π(2r)² = 24 · 60/photons; light is brightest where kernels are smaller."""
    definition = room(size=16)
    T = mi.ScalarTransform4f
    for name, part in definition.items():
        if isinstance(part, dict) and "to_world" in part:
            if name == "sensor":
                origin, target = [0, 0, 0.97 * scale], [0, -0.15 * scale, 0]
                part["to_world"] = T().look_at(origin=origin, target=target, up=[0, 1, 0])
                part["near_clip"], part["far_clip"] = 1e-3 * scale, 1e3 * scale
            else:
                part["to_world"] = T().scale(scale) @ part["to_world"]
    plugin = integrator(initial_radius=0.0, photon_count=50_000)
    render(mi.load_dict(definition), plugin, 4)
    s = plugin.statistics
    print(f"scale {scale}: radius {s['initial_radius']:.4g}")
    even = math.sqrt(24 * 60 / s["photons_stored"] / (4 * math.pi))
    assert 0.5 * even < s["initial_radius"] / scale < even
    # By itself a kernel may be four times as wide, where light is smooth.
    plugin = integrator(initial_radius=s["initial_radius"], photon_count=50_000)
    render(mi.load_dict(definition), plugin, 4)
    s = plugin.statistics
    assert 30 < s["photons_gathered"] / s["gather_points"] < 120
