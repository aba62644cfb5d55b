"""What the report measures: runs of methods on the clock, their energy and bias, regions."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.instruments.report import methods, metrics, reference, regions, runs
from aniso_pm.map import density
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from energy import regions as shapes
from rooms import room, room_with_ball, room_with_plate

# What a pilot would choose is no matter here.
pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def stage_of(world, photons=30_000):
    return runs.Stage(world, world.sensors()[0], {"map": "global"}, {}, photons, 1)


@pytest.fixture(scope="module")
def small_room():
    """A room and its reference."""
    mi.set_variant("llvm_ad_rgb")
    world = mi.load_dict(room(size=16))
    return world, reference.make(world, world.sensors()[0], spp=8192)


@pytest.mark.parametrize("dark", [0.9, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_dark_method_shows_in_energy_and_bias(small_room, monkeypatch, ticking, dark):
    """Kernels normalised to 0.9 lose a tenth of the indirect light, 3 % of all light here."""
    world, ref = small_room
    estimate = density.estimate

    def darker(*arguments, **options):
        radiance, count = estimate(*arguments, **options)
        return dark * radiance, count

    monkeypatch.setattr(density, "estimate", darker)
    (method,) = methods.parse("isotropic/default")
    stage = stage_of(world)
    images = np.array([runs.run(stage, method, 0.1, seed, [0.2]).images[0] for seed in range(4)])
    weight = metrics.weights(ref.halves)
    mask = np.ones(weight.shape[:2], bool)
    energy = metrics.energy(images, ref.halves, mask)
    bias2 = metrics.estimate(metrics.bias2, metrics.products(images, ref.halves, mask, weight))
    print(energy, bias2)
    if dark < 1:
        assert energy.high < 0.98 and bias2.low > 5e-4
    else:
        assert energy.value == pytest.approx(1, abs=0.005) and bias2.value < 5e-4


def test_looking_at_pictures_does_not_cost_time(monkeypatch, ticking):
    """What the report does with a picture is not on the clock of the method."""
    world = mi.load_dict(room(size=16))
    (method,) = methods.parse("isotropic/default")
    stage = stage_of(world, 2000)
    runs.run(stage, method, 0.1, 0, [0.2])
    add = runs._Recorder.add

    def slow(*arguments):
        ticking(0.2)
        return add(*arguments)

    swift = runs.run(stage, method, 0.1, 1, [0.15, 0.3])
    monkeypatch.setattr(runs._Recorder, "add", slow)
    found = runs.run(stage, method, 0.1, 1, [0.15, 0.3])
    # With 200 ms more a pass there would be 2 of them.
    assert found.passes == swift.passes and found.passes[1] > 10
    assert sum(found.stages.values()) == pytest.approx(found.seconds[1])


def test_path_leaves_nothing_that_others_have_to_compute():
    """The state of its sampler, for example: a kernel as large as its last call."""
    world = mi.load_dict(room(size=16))
    (path,) = methods.parse("path")
    runs.warm_up(stage_of(world), path, None, 9)
    ours = mi.load_dict({"type": "aniso_pm", "photon_count": 2000, "passes": 2})
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        ours.render(world, spp=2)
        sizes = {kernel["size"] for kernel in dr.kernel_history()}
    assert 16**2 in sizes and runs.CALLS[-1] * 16**2 not in sizes


def test_pictures_are_snapshots_of_one_run(ticking):
    world = mi.load_dict(room(size=16))
    for name in ("path", "isotropic/default"):
        (method,) = methods.parse(name)
        stage = stage_of(world, 2000)
        runs.warm_up(stage, method, 0.1, 9)
        found = runs.run(stage, method, 0.1, 0, [1e-6, 0.1, 0.2])
        assert found.passes[0] == 0 and np.isnan(found.images[0]).all()
        assert 0 < found.passes[1] < found.passes[2] and found.spp[1] < found.spp[2]
        assert found.seconds[1] <= 0.1 < found.seconds[2] <= 0.2
        assert np.isfinite(found.images[1:]).all()


def test_path_in_calls_is_path():
    """Calls of several sizes are weighted by their samples."""
    world = mi.load_dict(room(size=16))
    (method,) = methods.parse("path")
    found = runs.run(stage_of(world), method, None, 0, [1.0])
    expected = np.array(mi.render(world, integrator=mi.load_dict({"type": "path"}), spp=2048))
    assert found.images[0].mean() == pytest.approx(expected.mean(), rel=0.01)


def test_regions_lie_where_plate_and_caustic_are():
    def found(dictionary):
        world = mi.load_dict(dictionary)
        sensor = world.sensors()[0]
        image = np.array(mi.render(world, integrator=mi.load_dict({"type": "path"}), spp=64))
        return regions.find(prepare(world, Settings(), False), sensor, image, 0), world

    plate, world = found(room_with_plate(48))
    seen = shapes(world)["plate"]
    overlap = (plate["anisotropic"] & seen).sum()
    assert overlap > 0.9 * seen.sum() and overlap > 0.9 * plate["anisotropic"].sum()

    ball, world = found(room_with_ball(48))
    assert "anisotropic" not in ball
    # Below the ball, seen past it and through it.
    assert ball["caustic"].sum() < 150
    assert ball["caustic"][36:46, 20:34].mean() > 0.2
    assert set(found(room(size=48))[0]) == {"whole"}
