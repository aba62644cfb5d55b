"""Rendering ends by time, by error or by the number of passes."""

import time
from pathlib import Path

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.state import Checkpoint
from aniso_pm.rendering.stopping import Stopping
from passes import integrator, load, render
from rooms import room

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def test_time_ends_rendering(monkeypatch, ticking):
    monkeypatch.setattr(dr, "kernel_history", list)  # what is compiled here takes no time
    plugin = integrator(time=1.0)
    assert plugin.parameters()["passes"] == 0
    scene = load(16)
    began = time.perf_counter()
    image = render(scene, plugin, 16)
    assert plugin.statistics["passes"] >= 2 and np.isfinite(image).all()
    assert time.perf_counter() - began == pytest.approx(1, abs=0.1)


def test_compilation_does_not_count_as_rendering(monkeypatch):
    """Kernels that take 100 s to compile leave a 1 s budget untouched."""
    rules = Stopping(Settings(passes=0, time=1.0))
    with rules.measured():
        time.sleep(0.05)
        kernel = {"codegen_time": 40.0, "backend_time": 1e5 - 40}
        monkeypatch.setattr(dr, "kernel_history", lambda: [kernel])
    rules.close()
    assert not dr.flag(dr.JitFlag.KernelHistory)
    assert rules.spent() == pytest.approx(0.05 - 100, abs=0.1)


def test_compilation_before_the_first_pass_does_not_shorten_it(monkeypatch):
    rules = Stopping(Settings(passes=0, time=1.0))
    kernels = [{"codegen_time": 0.0, "backend_time": 1e5}]
    monkeypatch.setattr(dr, "kernel_history", lambda: [kernels.pop()] if kernels else [])
    rules.count_compilation()
    with rules.measured():
        time.sleep(0.05)
    rules.close()
    assert rules._expected_duration() == pytest.approx(0.05, abs=0.04)
    assert rules.compiling == pytest.approx(100)


def test_the_number_of_passes_still_ends_a_long_budget():
    plugin = integrator(time=1000.0, passes=3)
    render(load(), plugin, 6)
    assert plugin.statistics["passes"] == 3 and plugin.statistics["spp"] == 6


def test_writing_a_state_does_not_decide_when_the_error_is_small_enough(monkeypatch, tmp_path):
    """The estimate that a state comes with is not one that a rendering ends by."""
    monkeypatch.setattr(Stopping, "error_is_due", lambda self, count: count % 7 == 0)
    monkeypatch.setattr(Checkpoint, "due", lambda self: True)
    for checkpoint in (None, Checkpoint(tmp_path / "a.state")):
        plugin = integrator(target_error=0.9)
        render(load(), plugin, 2, checkpoint=checkpoint)
        assert plugin.statistics["passes"] == 7


def test_target_error_ends_rendering_where_it_says():
    scene = load()
    plugin = integrator(target_error=0.1)
    render(scene, plugin, 4)
    count = plugin.statistics["passes"]
    assert plugin.statistics["relative_error"] <= 0.1 and count > 4
    fewer = integrator(passes=int(count * 0.9))
    render(scene, fewer, 4 * fewer.settings.passes)
    assert fewer.statistics["relative_error"] > 0.1


def test_nothing_to_see_reaches_any_target():
    definition = room(size=4)
    del definition["light"]["emitter"]
    plugin = integrator(target_error=0.5)
    plugin.render(mi.load_dict(definition), spp=2)
    assert plugin.statistics["passes"] == 4


def test_stopping_rules_replace_each_other():
    plugin = integrator(passes=3)
    plugin.stop_after(time=2.0)
    assert plugin.parameters()["passes"] == 0 and plugin.parameters()["time"] == 2
    plugin.stop_after()
    assert plugin.settings.automatic_passes
    with pytest.raises(ValueError, match="passes"):
        plugin.stop_after(passes=-1)


@pytest.mark.slow
def test_a_ten_second_budget_ends_within_a_second_of_ten():
    path = Path(__file__).parents[1] / "scenes" / "teapot.xml"
    scene = mi.load_file(str(path), width="320", height="240")
    plugin = scene.integrator()
    plugin.stop_after(passes=1)
    plugin.render(scene, spp=1)  # compile
    plugin.stop_after(time=10.0)
    began = time.perf_counter()
    plugin.render(scene)
    took = time.perf_counter() - began
    print(f"{took:.2f} s, {plugin.statistics['passes']} passes")
    assert 9 < took < 11
