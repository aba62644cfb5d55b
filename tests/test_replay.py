"""Paths that are traced in Python once and then replayed are those that it would trace."""

from dataclasses import dataclass

import aniso_pm  # noqa: F401
import drjit as dr
import matrix
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import beginning, one_pass, replay
from conftest import slow
from passes import close, integrator, load, render

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


USES = {"global": {}, "caustic": {"map": "caustic"}, "final gather": {"final_gather": True}}


def passes_by_themselves(scene, parameters, count):
    """The picture of ``count`` passes of one sample, each traced in Python for itself."""
    film = scene.sensors()[0].film()
    total = 0.0
    for i in range(count):
        render(scene, integrator(**parameters), 1, first_pass=i)
        total = total + np.array(film.develop(raw=True), dtype=np.float64)
    return total[..., :-1] / total[..., -1:]


def assert_replayed_right(name, use):
    """Nothing of the first pass is frozen that belongs to that pass alone."""
    scene = matrix.make(matrix.rows()[name], 8)
    plugin = integrator(passes=4, **USES[use])
    together = render(scene, plugin, 4)
    alone = passes_by_themselves(scene, USES[use], 4)
    # A path that rounding sends another way changes its pixel; there are few.
    different = np.abs(together - alone) > 2e-3 * np.abs(alone) + 2e-4
    print(f"{name}, {use}: {different.mean():.3f} differ, {plugin.statistics['replayed']=}")
    assert different.mean() < 0.03
    return plugin.statistics["replayed"]


@pytest.mark.parametrize("use", ["caustic", *slow(*(use for use in USES if use != "caustic"))])
def test_replayed_passes_are_those_that_python_traces(use):
    assert assert_replayed_right("roughplastic floor under glass", use)


@pytest.mark.with_pilot
def test_what_cannot_be_replayed_is_traced_pass_by_pass(monkeypatch):
    """An error while Dr.Jit records costs time, not the picture; any other error is raised."""

    def fail(*arguments):
        raise RuntimeError("cannot be recorded")

    monkeypatch.setattr(dr, "freeze", lambda function, **options: fail)
    scene = load()
    plugin = integrator(passes=3)
    image = render(scene, plugin, 6)
    assert plugin.statistics["replayed"] is False and plugin.statistics["passes"] == 3
    monkeypatch.undo()
    close(image, render(scene, integrator(passes=3), 6))
    monkeypatch.setattr(one_pass.films, "splat", fail)
    with pytest.raises(RuntimeError, match="cannot be recorded"):
        render(scene, integrator(passes=3), 6)


def test_errors_of_those_who_watch_are_their_own(monkeypatch):
    """They say nothing about what Dr.Jit can record."""
    monkeypatch.setattr(beginning, "WAVEFRONT", 64)
    plugin, told = integrator(passes=2), []

    def progress(done, total, text):
        told.append(done)
        raise RuntimeError("not recorded")

    plugin.progress = progress
    with pytest.raises(RuntimeError, match="not recorded"):
        render(load(), plugin, 4)
    assert told == [0.5]


@pytest.fixture
def stages(monkeypatch):
    """What is frozen: light paths, eye paths, gathers."""
    frozen, freeze = [], dr.freeze

    def remembered(function, **options):
        frozen.append(freeze(function, **options))
        return frozen[-1]

    monkeypatch.setattr(dr, "freeze", remembered)
    return frozen


@pytest.mark.with_pilot
def test_the_first_pass_is_the_last_that_python_traces(stages):
    """Whatever the sizes of buffers, and whether time is kept."""
    recorded = []
    plugin = integrator(passes=4, time=1000.0)
    plugin.callback = lambda *_: recorded.append([stage.n_recordings for stage in stages])
    render(load(32), plugin, 0)
    assert plugin.statistics["replayed"] and len(stages) == 3 and len(recorded) == 4
    assert recorded[0] == recorded[-1]


@pytest.mark.with_pilot
def test_passes_replay_the_eye_paths_of_the_pilot(stages):
    plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "passes": 2})
    render(load(32), plugin, 2 * 32)
    assert plugin.statistics["share_of_gathers"] < 1 and stages[1].n_recordings == 1


def test_options_are_told_apart():
    """As ``drjit.freeze`` does not where they differ in a truth value that others have as well."""

    @dataclass
    class Options:
        one: bool
        two: bool
        three: bool
        four: str = "four"

    def number(x, options):
        return x + 4 * options.one + 2 * options.two + options.three

    stage, x = replay.frozen(number), dr.opaque(mi.UInt32, 0, 3)
    for k in range(8):
        assert stage(x, Options(bool(k & 4), bool(k & 2), bool(k & 1)))[0] == k
    assert stage.n_recordings == 8


@pytest.mark.slow
def test_every_scene_of_the_matrix_is_replayed_right():
    replayed = {(n, use): assert_replayed_right(n, use) for n in matrix.rows() for use in USES}
    assert sum(replayed.values()) > 0.9 * len(replayed)
