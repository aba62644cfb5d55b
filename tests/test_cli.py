"""The program `aniso-pm` ends with the right status and one clear line."""

import json
import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm import __version__, cli
from aniso_pm.errors import one_line
from aniso_pm.pictures.output import OutputError, plain
from command_line import OURS, PATH, assert_one_line, process

pytestmark = pytest.mark.usefixtures("without_pilot")

DEEP = ["-D", "max_depth=-1"]
OTHER = ["--integrator", "aniso_pm", "-p"]


# --- Wrong usage and input ---


@pytest.mark.parametrize(
    "arguments, part",
    [
        ([], "Missing command"),
        (["paint"], "paint"),
        (["render"], "scene"),
        (["render", "scene.xml"], "--output"),
        (["render", "scene.xml", "-o", "a.exr", "--spp", "0"], "--spp"),
        (["render", "scene.xml", "-o", "a.exr", "--spp", "many"], "'many'"),
        (["render", "scene.xml", "-o", "a.exr", "--seed", "-1"], "-1"),
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
        (["render", "scene.xml", "-o", "a.exr", "--time", "0"], "(see aniso-pm render --help)"),
        (["render", ".", "-o", "a.exr"], "a directory"),
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
def test_wrong_usage_is_one_clear_line(run, write_scene, arguments, part):
    write_scene()
    assert_one_line(run(*arguments), part)


def test_unknown_variant_is_one_clear_line(run, write_scene):
    assert_one_line(
        run("render", write_scene(), "-o", "a.exr", "-m", "llvm_xyz"), "llvm_xyz", "scalar"
    )


def test_cuda_without_a_device_is_one_clear_line(run, write_scene):
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        result = run("render", write_scene(), "-o", "a.exr", "-m", "cuda_ad_rgb")
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
def test_wrong_scene_is_one_clear_line(run, write_scene, integrator, extra, parts):
    assert_one_line(run("render", write_scene(integrator, extra), "-o", "a.exr"), *parts)


@pytest.mark.parametrize(
    "text, part",
    [
        ("", "scene.xml"),
        ("not XML at all", "scene.xml"),
        ('<bsdf version="3.0.0" type="diffuse"/>', "not a scene"),
        ('<scene version="3.0.0"><integrator type="path"/></scene>', "no sensor"),
    ],
)
def test_what_is_no_scene_is_one_clear_line(run, write_scene, text, part):
    assert_one_line(run("render", write_scene(text=text), "-o", "a.exr"), part)


def test_scalar_variant_is_refused_in_one_line(run, write_scene):
    result = run("render", write_scene(OURS), "-o", "a.exr", "-m", "scalar_rgb")
    assert_one_line(result, "scalar_rgb")


def test_nothing_is_written_for_wrong_input(run, write_scene, tmp_path):
    run("render", write_scene('<integrator type="nonsense"/>'), "-o", "a.exr", "--png")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


@pytest.mark.parametrize("wrapped", [False, True], ids=["plain", "wrapped"])
def test_ctrl_c_before_there_is_a_picture_is_told(run, write_scene, tmp_path, monkeypatch, wrapped):
    def load(*_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            if not wrapped:
                raise
            raise RuntimeError("error while performing a symbolic loop (see above)") from error

    monkeypatch.setattr("aniso_pm.cli.render.load", load)
    result = run("render", write_scene(OURS), "-o", "a.exr")
    assert result == (130, "", "aniso-pm: error: interrupted, nothing written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_what_ctrl_c_cannot_save_is_told(run, write_scene, monkeypatch):
    def load(*_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise OutputError("cannot write 'a.exr': no space left")  # noqa: B904

    monkeypatch.setattr("aniso_pm.cli.render.load", load)
    assert_one_line(run("render", write_scene(OURS), "-o", "a.exr"), "no space left")


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


def test_any_integrator_renders_to_exr_and_png(run, write_scene, tmp_path):
    status, stdout, stderr = run("render", write_scene(), "-o", "a.exr", "--png", "-D", "spp=9")
    assert (status, stderr) == (0, "")
    assert re.fullmatch(r"a\.exr, a\.png: 9 samples a pixel, \d+\.\d s\n", stdout)
    header = OpenEXR.File("a.exr").header()
    assert header["aniso_pm.spp"] == 9 and header["aniso_pm.integrator"] == "PathIntegrator"
    assert header["aniso_pm.versions.mitsuba"] == mi.__version__
    assert {channel.name for channel in header["channels"]} == {"R", "G", "B", "A"}
    assert mi.Bitmap("a.png").pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "scene.xml"]


def test_aov_channels_are_kept(run, write_scene):
    aov = f'<integrator type="aov"><string name="aovs" value="dd:depth"/>{PATH}</integrator>'
    assert run("render", write_scene(aov), "-o", "a.exr", "--png")[0] == 0
    names = {channel.name for channel in OpenEXR.File("a.exr").header()["channels"]}
    assert {"R", "G", "B", "A", "dd.T"} <= names


def test_header_and_json_tell_how_the_picture_was_made(run, write_scene):
    arguments = ["-o", "a.exr", "--spp", "4", "--passes", "2", "--seed", "7", "--json"]
    status, stdout, stderr = run("render", write_scene(OURS), *arguments)
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


@pytest.mark.parametrize("command", [["inspect"], ["explain", "--pixel", "8,8"]])
def test_scenes_without_integrator_are_examined_for_aniso_pm(run, write_scene, command):
    status, stdout, stderr = run(*command, write_scene(""))
    assert status == 0 and stdout, stderr


@pytest.mark.parametrize("command", [["inspect"], ["explain", "--pixel", "8,8"]])
def test_scenes_are_examined_for_as_many_samples_as_are_rendered(run, write_scene, command):
    passes = '<integer name="passes" value="400"/>'
    scene = write_scene(f'<integrator type="aniso_pm">{passes}</integrator>')
    assert_one_line(run(*command, scene), "cannot be shared by 400 passes")
    status, stdout, stderr = run(*command, scene, "--spp", 400)
    assert status == 0 and stdout, stderr


def test_closed_streams_are_no_error(run, write_scene, monkeypatch):
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, None)
        assert cli.main(["render", str(write_scene()), "-o", "a.exr"]) == 0


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_write_pictures(run, write_scene, variant):
    assert run("render", write_scene(), "-o", "a.exr", "--png", "-m", variant)[0] == 0
    assert np.isfinite(np.array(mi.Bitmap("a.exr"))).all()


def test_values_become_plain_json():
    value = {"a": np.float32(0.5), "b": np.array([3]), "c": float("nan"), "d": (1, "x"), 5: True}
    assert plain(value) == {"a": 0.5, "b": 3, "c": None, "d": [1, "x"], "5": True}


# --- The program as a process ---


def test_version_and_help(run):
    assert run("--version")[:2] == (0, f"aniso-pm {__version__}\n")
    status, stdout, _ = run("render", "--help")
    assert status == 0 and "--define" in stdout


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
