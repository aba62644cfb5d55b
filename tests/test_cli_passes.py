"""Passes on the command line: states are kept, resumed, merged and never lost."""

import contextlib
import json
import os
import signal
import subprocess
import time

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm.pictures.output import OutputError
from aniso_pm.rendering.state import State
from command_line import OURS, assert_one_line, assert_same_picture, channels, process

pytestmark = pytest.mark.usefixtures("without_pilot")


def test_passes_leave_variance_and_standard_error_as_layers(run, write_scene, tmp_path):
    assert run("render", write_scene(OURS), "-o", "a.exr", "--passes", "2", "--png")[0] == 0
    found = channels("a.exr")
    layers = ("", "variance.", "standard_error.")
    assert set(found) == {layer + channel for layer in layers for channel in "RGBA"}
    np.testing.assert_allclose(found["standard_error.G"] ** 2, found["variance.G"], rtol=1e-5)
    assert found["variance.G"].mean() > 0
    assert OpenEXR.File("a.exr").header()["aniso_pm.statistics.relative_error"][0] > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "scene.xml"]
    run("render", write_scene(OURS), "-o", "b.exr")
    assert set(channels("b.exr")) == set("RGBA")


def test_passes_rendered_apart_merge_into_the_whole(run, write_scene):
    path = write_scene(OURS)
    options = ["--keep-state", "--quiet"]
    run("render", path, "-o", "all.exr", "--passes", 5, "--spp", 10, *options)
    run("render", path, "-o", "a.exr", "--passes", 2, "--spp", 4, *options)
    run("render", path, "-o", "b.exr", "--passes", 2, "--spp", 4, "--first-pass", 2, *options)
    run("render", path, "-o", "c.exr", "--passes", 1, "--spp", 2, "--first-pass", 4, *options)
    status, stdout, stderr = run("merge", "a.state", "b.exr", "-o", "ab.exr")
    assert (status, stdout, stderr) == (0, "ab.exr: 4 passes of 2 states\n", "")
    status, stdout, _ = run("merge", "ab.exr", "c.exr", "-o", "abc.exr", "--png", "--json")
    assert status == 0 and json.loads(stdout)["passes"] == [[0, 5]]
    assert_same_picture("all.exr", "abc.exr")
    assert mi.Bitmap("abc.png").pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert_one_line(run("merge", "ab.exr", "a.exr", "-o", "d.exr"), "a.state", "pass 0 is already")
    assert_one_line(run("merge", "a.exr", "a.state", "-o", "d.exr"), "named twice")
    run("render", path, "-o", "s.exr", "--passes", 2, "--spp", 4, "--seed", 7, *options)
    assert_one_line(run("merge", "a.exr", "s.exr", "-o", "d.exr"), "seed was 7, is 0")


def test_ctrl_c_while_the_picture_is_written_tells_of_the_state(
    run, write_scene, tmp_path, monkeypatch
):
    def interrupted(*_):
        raise KeyboardInterrupt

    path = write_scene(OURS)
    options = ["-o", "a.exr", "--passes", 2]
    with monkeypatch.context() as patch:
        patch.setattr("aniso_pm.cli.pictures.Pictures.write", interrupted)
        result = run("render", path, *options)
    assert result[0] == 130 and "'a.state' holds the passes so far, --resume" in result[2]
    assert State.load(tmp_path / "a.state").passes == [[0, 2]]
    assert run("render", path, *options, "--resume")[0] == 0


def test_kept_states_are_not_lost(run, write_scene, tmp_path):
    path = write_scene(OURS)
    run("render", path, "-o", "a.exr", "--passes", 2, "--keep-state", "--quiet")
    before = (tmp_path / "a.state").read_bytes()
    for options in (["--passes", 2], ["--passes", 2, "--keep-state"], ["--spp", 1]):
        assert_one_line(run("render", path, "-o", "a.exr", *options), "a.state", "--resume")
    other = run("render", path, "-o", "a.exr", "--integrator", "path")
    assert_one_line(other, "a.state", "delete the file")
    assert "--resume" not in other[2]
    for out in ("a.exr", tmp_path / "a.exr"):
        assert_one_line(run("merge", "a.exr", "-o", out), "take the place of", "a.state")
    assert (tmp_path / "a.state").read_bytes() == before


def test_a_state_that_cannot_be_written_does_not_cost_the_picture(run, write_scene, monkeypatch):
    path = write_scene(OURS)

    def full(self, path):
        raise OutputError(f"cannot write '{path}': no space left")

    monkeypatch.setattr(State, "save", full)
    options = ["--passes", 3, "--save-every", "0.001"]
    status, _, stderr = run("render", path, "-o", "a.exr", *options)
    assert status == 1 and "no space left; the picture so far (3 passes) is written" in stderr
    assert set(channels("a.exr")) > set("RGBA")


def test_states_are_tried_before_anything_slow(run, write_scene, tmp_path):
    (tmp_path / "a.state").mkdir()
    options = ["-o", "a.exr", "--passes", "2", "--resume"]
    assert_one_line(run("render", write_scene(OURS), *options), "a.state", "it is a directory")


def test_the_command_line_replaces_the_scene_s_stopping_rules(run, write_scene):
    path = write_scene(
        OURS.replace("</integrator>", '<integer name="passes" value="2"/></integrator>')
    )
    _, stdout, _ = run("render", path, "-o", "a.exr", "--target-error", "0.5", "--json")
    assert json.loads(stdout)["statistics"]["passes"] == 4
    _, stdout, _ = run("render", path, "-o", "b.exr", "--time", "0.001", "--json")
    assert json.loads(stdout)["statistics"]["passes"] in (1, 2)  # compilation is not counted


def test_a_damaged_or_foreign_state_is_refused_in_one_line(run, write_scene, tmp_path):
    path = write_scene(OURS)
    arguments = ["-o", "a.exr", "--passes", "2", "--resume"]
    _, _, stderr = run("render", path, *arguments)
    assert "starting afresh" in stderr
    write_scene(OURS.replace("20000", "20001"))
    assert_one_line(run("render", path, *arguments), "photon count was 20000, is 20001")
    write_scene(OURS)
    assert_one_line(run("render", path, *arguments, "-D", "max_depth=5"), "max_depth")
    state = tmp_path / "a.state"
    state.write_bytes(state.read_bytes()[:-100])
    assert_one_line(run("render", path, *arguments), "a.state", "not a whole state file")


@pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_any_moment_and_resumed_it_ends_in_the_same_picture(write_scene, tmp_path, kills):
    path = write_scene(OURS)
    arguments = ["render", path, "--passes", 150 * kills, "--spp", 150 * kills, "--quiet"]
    whole = process(*arguments, "-o", "whole.exr", cwd=tmp_path)
    assert whole.wait(timeout=600) == 0
    arguments += ["-o", "a.exr", "--resume", "--save-every", "0.02"]
    random = np.random.default_rng(kills)
    done = []
    for _ in range(kills):
        # From before the first import to the midst of a write; the first time, wait for a state.
        program = process(*arguments, cwd=tmp_path)
        while not (tmp_path / "a.state").exists() and program.poll() is None:
            time.sleep(0.1)
        with contextlib.suppress(subprocess.TimeoutExpired):
            program.wait(timeout=random.uniform(0, 4.0))
        program.kill()
        program.communicate()
        with contextlib.suppress(FileNotFoundError):
            done.append(State.load(tmp_path / "a.state").count)
    assert done == sorted(done) and done[-1] > 0
    print("passes after each kill:", done)
    program = process(*arguments, cwd=tmp_path)
    _, stderr = program.communicate(timeout=600)
    assert program.returncode == 0, stderr
    assert State.load(tmp_path / "a.state").passes == [[0, 150 * kills]]
    assert_same_picture(tmp_path / "whole.exr", tmp_path / "a.exr")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a.exr", "a.state", "scene.xml", "whole.exr"]


@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
def test_ctrl_c_writes_the_picture_so_far(write_scene, tmp_path):
    path = write_scene(OURS)
    arguments = ["render", path, "-o", "a.exr", "--spp", "100000", "--passes", "100000"]
    program = process(*arguments, "--save-every", 1, cwd=tmp_path)
    while not (tmp_path / "a.exr").exists():  # until there are passes
        assert program.poll() is None, program.communicate()
        time.sleep(0.1)
    program.send_signal(signal.SIGINT)
    _, stderr = program.communicate(timeout=600)
    assert program.returncode == 130, stderr
    assert "interrupted" in stderr and "Traceback" not in stderr
    assert OpenEXR.File(str(tmp_path / "a.exr")).header()["aniso_pm.statistics.interrupted"] == 1
