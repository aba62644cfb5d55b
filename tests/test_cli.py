"""The program `aniso-pm` ends with the right status and one clear line, and keeps its word."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm import __version__, cli
from aniso_pm.errors import one_line
from aniso_pm.pictures.output import OutputError, plain
from aniso_pm.rendering.state import State

pytestmark = pytest.mark.usefixtures("without_pilot")

SCENE = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  <default name="width" value="16"/>
  <default name="max_depth" value="4"/>
  {integrator}
  <sensor type="perspective">
    <float name="fov" value="39"/>
    <transform name="to_world">
      <lookat origin="0, 0, 3.9" target="0, 0, 0" up="0, 1, 0"/>
    </transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$width"/> <integer name="height" value="16"/>
      <string name="pixel_format" value="rgba"/> <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="rectangle"><bsdf type="diffuse"/></shape>
  <shape type="sphere">
    <point name="center" value="0, 0, 1"/> <float name="radius" value="0.3"/>
    <bsdf type="dielectric"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><rotate y="1" angle="180"/><translate z="4"/></transform>
    <emitter type="area"><rgb name="radiance" value="1"/></emitter>
  </shape>
  {extra}
</scene>
"""
PATH = '<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>'
DEEP = ["-D", "max_depth=-1"]
OTHER = ["--integrator", "aniso_pm", "-p"]
OURS = """<integrator type="aniso_pm">
    <integer name="photon_count" value="20000"/> <integer name="max_depth" value="$max_depth"/>
  </integrator>"""


@pytest.fixture
def run(tmp_path, capfd, monkeypatch):
    """Run the program in this process, in an empty directory: (status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    before = mi.variant()

    def run(*arguments):
        status = cli.main([str(argument) for argument in arguments])
        return status, *capfd.readouterr()

    yield run
    if before:
        mi.set_variant(before)


@pytest.fixture
def scene(tmp_path):
    """Write a scene and return its path."""

    def write(integrator=PATH, extra="", text=SCENE):
        path = tmp_path / "scene.xml"
        path.write_text(text.replace("{integrator}", integrator).replace("{extra}", extra))
        return path

    return write


def assert_one_line(result, *parts):
    status, stdout, stderr = result
    assert status == 2 and stdout == ""
    assert stderr.startswith("aniso-pm: error: ") and stderr.count("\n") == 1, stderr
    for part in parts:
        assert part in stderr


# --- Wrong usage and input ---


@pytest.mark.parametrize(
    "arguments, part",
    [
        ([], "Missing command"),
        (["paint"], "paint"),
        (["render"], "scene"),
        (["render", "scene.xml"], "--output"),
        (["render", "scene.xml", "-o", "a.exr", "--spp", "0"], "--spp"),
        (["render", "scene.xml", "-o", "a.exr", "--spp", "many"], "--spp"),
        (["render", "scene.xml", "-o", "a.exr", "--seed", "-1"], "--seed"),
        (["render", "scene.xml", "-o", "a.exr", "--passes", "0"], "--passes"),
        (["render", "scene.xml", "-o", "a.exr", "--nonsense"], "--nonsense"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "spp"], "KEY=VALUE"),
        (["render", "scene.xml", "-o", "a.jpg"], ".exr"),
        (["render", "scene.xml", "-o", "nowhere/a.exr"], "nowhere"),
        (["render", "none.xml", "-o", "a.exr"], "none.xml"),
        (["render", "scene.xml", "-o", "a.exr", "--sensor", "3"], "no sensor 3"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "unused=1"], "unused"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "max_depth=deep"], "deep"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "max_depth=-9"], "max_depth"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "width=0"], "no pixels"),
        (["render", "scene.xml", "-o", "a.exr", "--passes", "2"], "--passes"),
        (["render", "scene.xml", "-o", "a.exr", "--time", "0"], "--time"),
        (["render", "scene.xml", "-o", "a.exr", "--time", "9"], "--time: PathIntegrator"),
        (["render", "scene.xml", "-o", "a.exr", "--target-error", "-1"], "--target-error"),
        (["render", "scene.xml", "-o", "a.exr", "--resume"], "--resume or --keep-state"),
        (["render", "scene.xml", "-o", "a.exr", "--first-pass", "3"], "--first-pass"),
        (
            ["reference", "scene.xml", "--spp", "4", *DEEP, "--integrator", "diffuse"],
            "no integrator",
        ),
        (["render", "scene.xml", "-o", "n" * 252 + ".exr"], "File name too long"),
        (["render", "scene.xml", "-o", "a.exr", *OTHER, "guard=1"], "boolean (true or false)"),
        (["render", "scene.xml", "-o", "a.exr", *OTHER, "pases=2"], "did you mean passes?"),
        (["cluster", "--task-seconds", "inf"], "--task-seconds"),
        (["merge", "-o", "a.exr"], "states"),
        (["merge", "x.state", "-o", "a.exr"], "x.state"),
        (["merge", "scene.xml", "-o", "a.exr"], "not a whole state file"),
        (["merge", "x.state", "-o", "a.png"], ".exr"),
    ],
)
def test_wrong_usage_is_one_clear_line(run, scene, arguments, part):
    scene()
    assert_one_line(run(*arguments), part)


def test_unknown_variant_is_one_clear_line(run, scene):
    assert_one_line(run("render", scene(), "-o", "a.exr", "-m", "llvm_xyz"), "llvm_xyz", "scalar")


def test_cuda_without_a_device_is_one_clear_line(run, scene):
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        result = run("render", scene(), "-o", "a.exr", "-m", "cuda_ad_rgb")
        assert_one_line(result, "cuda_ad_rgb", "no CUDA device")


@pytest.mark.parametrize(
    "integrator, extra, parts",
    [
        ('<integrator type="nonsense"/>', "", ["line 5", "nonsense"]),
        ('<integrator type="path"><float name="foo" value="1"/></integrator>', "", ["foo"]),
        ('<integrator type="path"', "", ["scene.xml", "line"]),
        ("", "", ["no integrator"]),
        (PATH, '<shape type="ply"><string name="filename" value="x.ply"/></shape>', ["x.ply"]),
        (PATH, '<shape type="sphere"><ref id="nope"/></shape>', ["nope"]),
        (PATH, '<nonsense name="x"/>', ["nonsense", "line"]),
        ('<integrator type="aniso_pm"><float name="foo" value="1"/></integrator>', "", ["foo"]),
        (
            '<integrator type="aniso_pm"><string name="photon_count" value="x"/></integrator>',
            "",
            ["scene.xml", "photon_count"],
        ),
        (
            '<integrator type="aniso_pm"><integer name="photon_count" value="-1"/></integrator>',
            "",
            ["scene.xml", "photon_count"],
        ),
    ],
)
def test_wrong_scene_is_one_clear_line(run, scene, integrator, extra, parts):
    assert_one_line(run("render", scene(integrator, extra), "-o", "a.exr"), *parts)


@pytest.mark.parametrize(
    "text, part",
    [
        ("", "scene.xml"),
        ("not XML at all", "scene.xml"),
        ('<bsdf version="3.0.0" type="diffuse"/>', "not a scene"),
        ('<scene version="3.0.0"><integrator type="path"/></scene>', "no sensor"),
    ],
)
def test_what_is_no_scene_is_one_clear_line(run, scene, text, part):
    assert_one_line(run("render", scene(text=text), "-o", "a.exr"), part)


def test_scalar_variant_is_refused_in_one_line(run, scene):
    result = run("render", scene(OURS), "-o", "a.exr", "-m", "scalar_rgb")
    assert_one_line(result, "scalar_rgb")


def test_nothing_is_written_for_wrong_input(run, scene, tmp_path):
    run("render", scene('<integrator type="nonsense"/>'), "-o", "a.exr", "--png")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_messages_lose_source_positions_and_line_breaks():
    raw = (
        '[parser.cpp:444] While loading a.xml (line 3): Found 2:\n  - float "a": 1\n  - int "b": 2'
    )
    assert one_line(raw) == 'While loading a.xml (line 3): Found 2: float "a": 1; int "b": 2'
    raw = (
        '[p.cpp:1] At a.xml: failed: Traceback (most recent call last):\n  File "x"\nValueError: b'
    )
    assert one_line(raw) == "At a.xml: failed: b"


# --- Pictures ---


def test_any_integrator_renders_to_exr_and_png(run, scene, tmp_path):
    status, stdout, stderr = run("render", scene(), "-o", "a.exr", "--png", "-D", "spp=9")
    assert (status, stderr) == (0, "")
    assert re.fullmatch(r"a\.exr, a\.png: 9 samples a pixel, \d+\.\d s\n", stdout)
    header = OpenEXR.File("a.exr").header()
    assert header["aniso_pm.spp"] == 9 and header["aniso_pm.integrator"] == "PathIntegrator"
    assert header["aniso_pm.versions.mitsuba"] == mi.__version__
    assert {channel.name for channel in header["channels"]} == {"R", "G", "B", "A"}
    assert mi.Bitmap("a.png").pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "scene.xml"]


def test_aov_channels_are_kept(run, scene):
    aov = f'<integrator type="aov"><string name="aovs" value="dd:depth"/>{PATH}</integrator>'
    assert run("render", scene(aov), "-o", "a.exr", "--png")[0] == 0
    names = {channel.name for channel in OpenEXR.File("a.exr").header()["channels"]}
    assert {"R", "G", "B", "A", "dd.T"} <= names


def test_header_and_json_tell_how_the_picture_was_made(run, scene):
    arguments = ["-o", "a.exr", "--spp", "4", "--passes", "2", "--seed", "7", "--json"]
    status, stdout, stderr = run("render", scene(OURS), *arguments)
    assert status == 0, stderr
    told = json.loads(stdout)
    header = OpenEXR.File("a.exr").header()
    written = json.loads(header["aniso_pm"])
    assert told["output"] == "a.exr" and told["png"] is None
    assert written == {key: told[key] for key in written}
    assert told["parameters"]["photon_count"] == header["aniso_pm.parameters.photon_count"] == 20000
    assert told["parameters"]["passes"] == 2 and told["seed"] == 7 and told["statistics"]
    for fallback in ("clamped", "capped", "degenerate", "off_surface"):
        count = header[f"aniso_pm.statistics.gather_points_{fallback}"]
        assert 0 <= count <= header["aniso_pm.statistics.gather_points"]


# --- Passes ---


def channels(path):
    """Name → pixels, float64."""
    found = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: channel.pixels.astype(np.float64) for name, channel in found.items()}


def assert_same_picture(a, b):
    """All channels equal, but for the order of float sums in threads (and its square in variances
    that are differences)."""
    a, b = channels(a), channels(b)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_allclose(a[name], b[name], rtol=0.01, atol=1e-4, err_msg=name)


def test_passes_leave_variance_and_standard_error_as_layers(run, scene, tmp_path):
    assert run("render", scene(OURS), "-o", "a.exr", "--passes", "2", "--png")[0] == 0
    found = channels("a.exr")
    layers = ("", "variance.", "standard_error.")
    assert set(found) == {layer + channel for layer in layers for channel in "RGBA"}
    np.testing.assert_allclose(found["standard_error.G"] ** 2, found["variance.G"], rtol=1e-5)
    assert found["variance.G"].mean() > 0
    assert OpenEXR.File("a.exr").header()["aniso_pm.statistics.relative_error"][0] > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "scene.xml"]
    run("render", scene(OURS), "-o", "b.exr")
    assert set(channels("b.exr")) == set("RGBA")


def test_passes_rendered_apart_merge_into_the_whole(run, scene):
    path = scene(OURS)
    options = ["--keep-state", "--quiet"]
    run("render", path, "-o", "all.exr", "--passes", 5, "--spp", 10, *options)
    run("render", path, "-o", "a.exr", "--passes", 2, "--spp", 4, *options)
    run("render", path, "-o", "b.exr", "--passes", 2, "--spp", 4, "--first-pass", 2, *options)
    run("render", path, "-o", "c.exr", "--passes", 1, "--spp", 2, "--first-pass", 4, *options)
    status, stdout, stderr = run("merge", "a.state", "b.exr", "-o", "ab.exr")
    assert (status, stdout, stderr) == (0, "", "")
    status, stdout, _ = run("merge", "ab.exr", "c.exr", "-o", "abc.exr", "--png", "--json")
    assert status == 0 and json.loads(stdout)["passes"] == [[0, 5]]
    assert_same_picture("all.exr", "abc.exr")
    assert mi.Bitmap("abc.png").pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert_one_line(run("merge", "ab.exr", "a.exr", "-o", "d.exr"), "a.state", "pass 0 is already")
    assert_one_line(run("merge", "a.exr", "a.state", "-o", "d.exr"), "named twice")
    run("render", path, "-o", "s.exr", "--passes", 2, "--spp", 4, "--seed", 7, *options)
    assert_one_line(run("merge", "a.exr", "s.exr", "-o", "d.exr"), "seed was 7, is 0")


def test_kept_states_are_not_lost(run, scene, tmp_path):
    path = scene(OURS)
    run("render", path, "-o", "a.exr", "--passes", 2, "--keep-state", "--quiet")
    before = (tmp_path / "a.state").read_bytes()
    for options in (["--passes", 2], ["--passes", 2, "--keep-state"], ["--spp", 1]):
        assert_one_line(run("render", path, "-o", "a.exr", *options), "a.state", "--resume")
    for out in ("a.exr", tmp_path / "a.exr"):
        assert_one_line(run("merge", "a.exr", "-o", out), "take the place of", "a.state")
    assert (tmp_path / "a.state").read_bytes() == before


def test_a_state_that_cannot_be_written_does_not_cost_the_picture(run, scene, monkeypatch):
    path = scene(OURS)

    def full(self, path):
        raise OutputError(f"cannot write '{path}': no space left")

    monkeypatch.setattr(State, "save", full)
    options = ["--passes", 3, "--save-every", "0.001"]
    status, _, stderr = run("render", path, "-o", "a.exr", *options)
    assert status == 1 and "no space left; the picture so far (3 passes) is written" in stderr
    assert set(channels("a.exr")) > set("RGBA")


def test_states_are_tried_before_anything_slow(run, scene, tmp_path):
    (tmp_path / "a.state").mkdir()
    options = ["-o", "a.exr", "--passes", "2", "--resume"]
    assert_one_line(run("render", scene(OURS), *options), "a.state", "it is a directory")


@pytest.mark.parametrize("command", [["inspect"], ["explain", "--pixel", "8,8"]])
def test_scenes_without_integrator_are_examined_for_aniso_pm(run, scene, command):
    status, stdout, stderr = run(*command, scene(""))
    assert status == 0 and stdout, stderr


def test_closed_streams_are_no_error(run, scene, monkeypatch):
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, None)
        assert cli.main(["render", str(scene()), "-o", "a.exr"]) == 0


def test_the_command_line_replaces_the_scene_s_stopping_rules(run, scene):
    path = scene(OURS.replace("</integrator>", '<integer name="passes" value="2"/></integrator>'))
    _, stdout, _ = run("render", path, "-o", "a.exr", "--target-error", "0.5", "--json")
    assert json.loads(stdout)["statistics"]["passes"] == 4
    _, stdout, _ = run("render", path, "-o", "b.exr", "--time", "0.001", "--json")
    assert json.loads(stdout)["statistics"]["passes"] in (1, 2)  # compilation is not counted


def test_a_damaged_or_foreign_state_is_refused_in_one_line(run, scene, tmp_path):
    path = scene(OURS)
    arguments = ["-o", "a.exr", "--passes", "2", "--resume"]
    _, _, stderr = run("render", path, *arguments)
    assert "starting afresh" in stderr
    scene(OURS.replace("20000", "20001"))
    assert_one_line(run("render", path, *arguments), "photon count was 20000, is 20001")
    scene(OURS)
    assert_one_line(run("render", path, *arguments, "-D", "max_depth=5"), "max_depth")
    state = tmp_path / "a.state"
    state.write_bytes(state.read_bytes()[:-100])
    assert_one_line(run("render", path, *arguments), "a.state", "not a whole state file")


@pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_any_moment_and_resumed_it_ends_in_the_same_picture(scene, tmp_path, kills):
    path = scene(OURS)
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


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_write_pictures(run, scene, variant):
    assert run("render", scene(), "-o", "a.exr", "--png", "-m", variant)[0] == 0
    assert np.isfinite(np.array(mi.Bitmap("a.exr"))).all()


def test_values_become_plain_json():
    value = {"a": np.float32(0.5), "b": np.array([3]), "c": float("nan"), "d": (1, "x"), 5: True}
    assert plain(value) == {"a": 0.5, "b": 3, "c": None, "d": [1, "x"], "5": True}


# --- The program as a process ---


def process(*arguments, cwd, **options):
    command = [sys.executable, "-m", "aniso_pm.cli", *map(str, arguments)]
    return subprocess.Popen(
        command,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells start background jobs with Ctrl-C ignored, and children inherit it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def test_version_and_help(run):
    assert run("--version")[:2] == (0, f"aniso-pm {__version__}\n")
    status, stdout, _ = run("render", "--help")
    assert status == 0 and "--define" in stdout


@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
def test_ctrl_c_writes_the_picture_so_far(scene, tmp_path):
    path = scene(OURS)
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


def test_doctor_finds_this_installation_well(tmp_path):
    program = process("doctor", "--json", cwd=tmp_path)
    stdout, stderr = program.communicate(timeout=600)
    report = json.loads(stdout)
    assert report["ok"] and program.returncode == 0, report
    names = [check["name"] for check in report["checks"]]
    assert {"LLVM", "mitsuba", "kernel llvm_ad_rgb", "plugin llvm_ad_rgb"} <= set(names)


def test_doctor_tells_what_to_do_about_a_missing_llvm(tmp_path):
    script = os.path.join(os.path.dirname(sys.executable), "aniso-pm")
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    doctor = subprocess.run(
        [script, "doctor"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert doctor.returncode == 1 and "Traceback" not in doctor.stderr
    assert "does not exist" in doctor.stdout and "fix: " in doctor.stdout
