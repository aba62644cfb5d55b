"""The report from end to end on a small scene, and what it must not get wrong."""

import json
import re
import sys
from dataclasses import replace
from importlib import resources

import aniso_pm  # noqa: F401
import jsonschema
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.errors import InputError
from aniso_pm.instruments import gallery
from aniso_pm.instruments.report import (
    cells,
    denoised,
    experiment,
    make,
    methods,
    page,
    reference,
    runs,
)
from aniso_pm.instruments.report.plan import Plan
from aniso_pm.rendering.film import pixel_weights
from conftest import leave_out_the_pilot, tick

# One process: the report that most tests look at is made once. What a pilot would choose is no
# matter here.
pytestmark = [pytest.mark.xdist_group("report"), pytest.mark.usefixtures("without_pilot")]

SCENE = """<scene version="3.0.0">
  <default name="width" value="32"/>
  <integrator type="aniso_pm"><integer name="max_depth" value="6"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="60"/>
    <transform name="to_world">
      <lookat origin="0, -2.4, 1.6" target="0, 0, 0.5" up="0, 0, 1"/>
    </transform>
    <sampler type="independent"/>
    <film type="hdrfilm">
      <integer name="width" value="$width"/> <integer name="height" value="24"/>
      <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><scale value="2"/></transform>
    <bsdf type="diffuse"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="0.9"/> <rotate x="1" angle="110"/> <translate y="1" z="0.8"/>
    </transform>
    <bsdf type="twosided"><bsdf type="roughconductor">
      <float name="alpha_u" value="0.05"/> <float name="alpha_v" value="0.3"/>
    </bsdf></bsdf>
  </shape>
  <shape type="sphere">
    <point name="center" x="0.5" y="-0.4" z="0.4"/> <float name="radius" value="0.4"/>
    <bsdf type="dielectric"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="0.7"/> <rotate x="1" angle="180"/> <translate z="2.5"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="4"/></emitter>
  </shape>
</scene>
"""
QUICK = ("--quick", "--time", "1", "--photons", "3000", "--spp", "1")
BRIEF = (*QUICK, "--time", "0.12")  # by the clock that ticks


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene's file with its reference beside it."""
    mi.set_variant("llvm_ad_rgb")
    file = tmp_path_factory.mktemp("scenes") / "tiny.xml"
    file.write_text(SCENE)
    (file.parent / "references").mkdir()
    world, sensor = make.load(file, {}, 0)
    made = reference.make(world, sensor, spp=4096)
    reference.write(file.parent / "references" / "tiny.exr", made)
    return file


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    """A quick report by the program: its directory."""
    out = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        tick(patch)
        leave_out_the_pilot(patch)
        assert cli.main(["report", str(scene), "-o", str(out), *BRIEF]) == 0
    return out


def results(out):
    return json.loads((out / "results.json").read_text())


def schema():
    file = resources.files("aniso_pm.instruments.report").joinpath("results.schema.json")
    return json.loads(file.read_text())


# --- Files ---


def test_results_keep_to_their_schema(done):
    jsonschema.validate(results(done), schema())
    assert not any(row["denoised"] for row in results(done)["rows"])


def test_all_that_was_asked_for_is_in_the_table(done):
    found = results(done)
    last = [r for r in found["rows"] if r["budget"] == found["plan"]["times"][-1]]
    wanted = {
        "aniso_pm",
        "isotropic/default",
        "isotropic/best",
        "lobe/default",
        "lobe/best",
        "path",
    }
    assert {r["method"] for r in last} == wanted
    assert {r["region"] for r in last} == {"whole", "anisotropic", "caustic"}
    for row in found["rows"]:
        assert row["seconds"] <= row["budget"] and row["passes"] >= 1 and row["seeds"] == 3
        parts = row["variance"]["value"] + row["bias2"]["value"]
        assert parts == pytest.approx(row["relative_mse"]["value"], rel=1e-6)
    pairs = {(r["method"], r["base"]) for r in found["ratios"]}
    assert ("lobe/best", "isotropic/best") in pairs and ("lobe/default", "path") in pairs
    assert ("lobe/best", "isotropic/default") not in pairs


def test_path_agrees_with_the_reference_and_photon_mapping_nearly(done):
    found = results(done)
    for row in found["rows"]:
        if row["budget"] == found["plan"]["times"][-1] and row["region"] == "whole":
            # Photon mapping with 3000 light paths a pass has a bias, and path noise.
            assert row["energy"]["value"] == pytest.approx(1, abs=0.05), row["method"]


def test_page_needs_no_other_file_and_shows_every_figure(done):
    text = (done / "index.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]{1,30})', text)
    assert sources and all(s.startswith(("data:image/", "#")) for s in sources)
    assert "built-in" not in text and "Undefined" not in text
    svgs = {p.stem for p in (done / "figures").glob("*.svg")}
    assert {"tiny-error-whole", "tiny-split-anisotropic", "tiny-bandwidth-large"} <= svgs
    assert svgs <= {p.stem for p in (done / "figures").glob("*.png")}
    assert text.count("data:image/svg+xml") == len(svgs)


@pytest.mark.slow
def test_denoised_rows_stand_beside_raw_ones(scene, tmp_path, monkeypatch, ticking):
    monkeypatch.setattr(runs, "CALLS", (1,))
    names = ("lobe/default", "path")
    arguments = [word for name in names for word in ("--method", name)]
    arguments += ["--time", "0.2", "--budgets", "2", "--denoise"]
    assert cli.main(["report", str(scene), "-o", str(tmp_path), *QUICK, *arguments]) == 0
    found = results(tmp_path)
    jsonschema.validate(found, schema())

    last = found["plan"]["times"][-1]
    rows = [r for r in found["rows"] if r["budget"] == last and r["region"] == "whole"]
    assert [r["method"] for r in rows] == [n + more for n in names for more in ("", ", denoised")]
    for before, after in zip(rows[::2], rows[1::2], strict=True):
        assert after["denoised"] and not before["denoised"] and after["seeds"] == 3
        assert after["variance"]["value"] < 0.7 * before["variance"]["value"], after["method"]
        assert after["energy"]["value"] == pytest.approx(1, abs=0.1), after["method"]
    pairs = {(r["method"], r["base"]) for r in found["ratios"]}
    assert ("lobe/default, denoised", "path, denoised") in pairs
    assert not any((", denoised" in one) != (", denoised" in other) for one, other in pairs)
    text = (tmp_path / "index.html").read_text()
    assert re.search(r'class="(limited )?denoised"><td>path <span class="mark">denoised<', text)


def test_mitsubas_integrators_give_albedo_and_normal_where_they_can():
    given = {kind: denoised.with_aovs({"type": kind}) for kind in ("path", "ptracer", "prb")}
    assert [aovs for _, aovs in given.values()] == [True, False, False]
    assert "albedo.R" in given["path"][0].aov_names()


def test_films_are_boxed_whatever_filter_they_have(tmp_path):
    texts = {"box": SCENE, "wide": SCENE.replace('type="box"', 'type="gaussian"')}
    texts["none"] = SCENE.replace('<rfilter type="box"/>', "")
    for name, text in texts.items():
        file = tmp_path / f"{name}.xml"
        file.write_text(text)
        world = denoised.boxed(file, {"width": "20"})
        film = world.sensors()[0].film()
        assert pixel_weights(film) == [1.0] and list(film.size()) == [20, 24], name
        assert len(world.shapes()) == len(mi.load_file(str(file), optimize=False).shapes())


def test_boxed_scenes_find_their_textures_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = [str(path) for path in mi.file_resolver()]
    found = denoised.boxed(gallery.directory() / "teapot.xml", {"width": "16", "height": "12"})
    assert pixel_weights(found.sensors()[0].film()) == [1.0]
    assert [str(path) for path in mi.file_resolver()] == before


def test_mitsubas_pictures_get_their_own_filter_back_after_denoising():
    """Calls are weighted by their samples; what is known beside a picture is as of ``aniso_pm``."""
    random = np.random.default_rng(0)
    calls = denoised.Calls([0.25, 0.5, 0.25], aovs=True)
    truth = np.concatenate([np.full((12, 16, 3), 2.0), random.random((12, 16, 6))], 2)
    for spp in (1, 4, 16) * 40:
        noise = random.normal(size=(12, 16, 3)) / np.sqrt(spp)
        calls.add(truth + np.concatenate([noise, np.zeros((12, 16, 6))], 2), spp)
    found = calls.layers
    np.testing.assert_allclose(found["denoising_albedo"], truth[..., 3:6])
    np.testing.assert_allclose(found["denoising_normal"], truth[..., 6:])
    assert found["denoising_picture"].mean() == pytest.approx(2, abs=0.01)
    assert "denoising_error" not in found
    # 840 samples of variance 1.
    assert (found["denoising_picture"] - 2).std() == pytest.approx(840**-0.5, rel=0.15)
    assert (calls.picture - 2).std() < 0.6 * (found["denoising_picture"] - 2).std()


@pytest.mark.slow
def test_running_it_twice_gives_the_same_ratios_within_their_intervals(scene, tmp_path):
    """By the real clock."""

    def ratios(name):
        out = tmp_path / name
        assert cli.main(["report", str(scene), "-o", str(out), *QUICK]) == 0
        return {
            (r["method"], r["base"], r["region"], r["budget"]): r
            for r in results(out)["ratios"]
            if r["low"] is not None
        }

    first, second = ratios("first"), ratios("second")
    both = first.keys() & second.keys()
    assert len(both) >= 12
    # Each interval has 95 %: two of them miss each other more rarely still.
    apart = [
        key
        for key in both
        if first[key]["high"] < second[key]["low"] or second[key]["high"] < first[key]["low"]
    ]
    assert len(apart) <= 0.1 * len(both), apart
    verdicts = {(first[key]["verdict"], second[key]["verdict"]) for key in both}
    assert not verdicts & {("better", "worse"), ("worse", "better")}


# --- Going on, failing ---


def test_a_report_goes_on_from_the_cells_that_are_there(
    scene, done, tmp_path, monkeypatch, ticking
):
    """As after kill -9: some cells are there, one was damaged, the rest was never begun."""
    (tmp_path / "cells").symlink_to(done / "cells")
    kept = {path: path.stat().st_mtime_ns for path in (done / "cells" / "tiny").iterdir()}
    (done / "cells/tiny/path-1.npz").unlink()
    (done / "cells/tiny/lobe_default-2.npz").write_bytes(b"PK half a file")
    ran = []
    run = runs.run

    def counted(stage, method, radius, seed, budgets):
        ran.append((method.name, seed))
        return run(stage, method, radius, seed, budgets)

    monkeypatch.setattr(runs, "run", counted)
    assert cli.main(["report", str(scene), "-o", str(tmp_path), *BRIEF]) == 0
    assert set(ran) == {("lobe/default", 2), ("path", 1)}
    again = [r for r in results(tmp_path)["rows"] if r["method"] == "isotropic/best"]
    assert again == [r for r in results(done)["rows"] if r["method"] == "isotropic/best"]
    untouched = [p for p in kept if p.name not in ("path-1.npz", "lobe_default-2.npz")]
    assert all(p.stat().st_mtime_ns == kept[p] for p in untouched)


def test_a_cell_that_fails_does_not_take_the_others_with_it(
    scene, tmp_path, monkeypatch, capfd, ticking
):
    run, done = runs.run, {}

    def swift(stage, method, radius, seed, budgets):
        """The first run of a method, a little brighter with each seed."""
        if method.name not in done:
            done[method.name] = run(stage, method, radius, seed, budgets)
        found = done[method.name]
        return replace(found, images=found.images * (1 + 0.01 * seed))

    def failing(stage, method, radius, seed, budgets):
        if method.name == "path" and seed == 1:
            raise RuntimeError("the lamp fell over")
        return swift(stage, method, radius, seed, budgets)

    monkeypatch.setattr(runs, "run", failing)
    names = ("--method", "path", "--method", "isotropic/default", "--seeds", "4", "--budgets", "2")
    arguments = ["report", str(scene), "-o", str(tmp_path), *BRIEF, *names]
    assert cli.main(arguments) == 1
    assert "path, seed 1 failed: the lamp fell over" in capfd.readouterr().out
    found = results(tmp_path)
    assert found["scenes"][0]["failures"][0]["reason"] == "the lamp fell over"
    assert {row["seeds"] for row in found["rows"] if row["method"] == "path"} == {3}
    assert any(r["base"] == "path" and r["value"] for r in found["ratios"])
    # The next time the failed one is tried again, and nothing else.
    monkeypatch.setattr(runs, "run", swift)
    assert cli.main(arguments) == 0
    assert {row["seeds"] for row in results(tmp_path)["rows"]} == {4}


def test_a_scene_that_is_not_for_photons_is_still_rendered_by_path(scene, tmp_path, monkeypatch):
    def refuse(*_):
        raise ValueError("aniso_pm: fog is not supported")

    monkeypatch.setattr(experiment, "prepare", refuse)
    names = ("--method", "path", "--method", "lobe/default", "--budgets", "2")
    assert cli.main(["report", str(scene), "-o", str(tmp_path), *QUICK, *names]) == 1
    found = results(tmp_path)
    assert {row["method"] for row in found["rows"]} == {"path"}
    (failure,) = found["scenes"][0]["failures"]
    assert failure["method"] == "lobe/default" and "fog" in failure["reason"]
    assert "fog is not supported" in (tmp_path / "index.html").read_text()


def test_cells_of_another_plan_do_not_count(tmp_path):
    store = cells.Store(tmp_path)
    store.put("a", {"seed": 1}, {"x": float("nan")}, {"image": np.ones(3)})
    assert store.get("a", {"seed": 2}) is None and store.stale == ["a"]
    assert store.get("a", {"seed": 1}).arrays["image"].tolist() == [1, 1, 1]
    store.put("b", {}, {"error": "no"})
    assert store.get("b", {}) is None


def test_interrupted_reports_keep_what_is_done(scene, tmp_path, monkeypatch, capfd):
    run = runs.run

    def interrupted(stage, method, radius, seed, budgets):
        if seed == 1:
            raise KeyboardInterrupt
        return run(stage, method, radius, seed, budgets)

    monkeypatch.setattr(runs, "run", interrupted)
    assert cli.main(["report", str(scene), "-o", str(tmp_path), *QUICK, "--method", "path"]) == 130
    assert "goes on from here" in capfd.readouterr().err
    assert (tmp_path / "cells/tiny/path-0.npz").exists()
    assert not (tmp_path / "cells/tiny/path-1.npz").exists()


# --- Wrong input ---


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--method", "pathh"], "pathh"),
        (["--method", "lobe/worst"], "default, best"),
        (["--method", "aniso_pm:spp=4"], "without parameters"),
        (["--method", "path:max_depth"], "KEY=VALUE"),
        (["--seeds", "2"], "seeds is 2"),
        (["--time", "0.01"], "seconds is 0.01"),
        (["-D", "width=40"], "aniso-pm reference"),
    ],
)
def test_wrong_input_is_said_in_one_line_before_anything_runs(
    scene, tmp_path, capfd, arguments, words
):
    assert cli.main(["report", str(scene), "-o", str(tmp_path), *arguments]) == 2
    error = capfd.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not (tmp_path / "results.json").exists()


def test_a_missing_package_is_named_with_its_remedy(scene, tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert cli.main(["report", str(scene), "-o", str(tmp_path)]) == 2
    assert "pip install 'aniso-pm[report]'" in capfd.readouterr().err


def test_a_missing_denoiser_is_named_before_anything_runs(scene, tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert cli.main(["report", str(scene), "-o", str(tmp_path), "--denoise"]) == 2
    error = capfd.readouterr().err
    assert "pip install 'aniso-pm[denoise]'" in error and error.count("\n") == 1
    assert not (tmp_path / "cells").exists()


def test_names_stand_for_methods():
    found = methods.parse_all(["isotropic", "lobe/best", "path:max_depth=3,hide_emitters=true"])
    assert [m.name for m in found][:3] == ["isotropic/default", "isotropic/best", "lobe/best"]
    assert found[2].plugin["rule"] == "lobe"
    assert found[3].plugin == {"type": "path", "max_depth": 3, "hide_emitters": True}
    with pytest.raises(InputError, match="not an integrator"):
        methods.parse("independent")
    (installed,) = methods.parse("aniso_pm")
    assert installed.plugin == {"type": "aniso_pm"} and installed.label == "as installed"
    assert installed.ours and methods.parse_all(Plan().methods)[0] == installed
    with pytest.raises(InputError, match="without parameters"):
        methods.parse("aniso_pm:photon_count=5")


def test_budgets_span_two_decades():
    times = Plan().times
    assert len(times) >= 6 and times[-1] / times[0] == pytest.approx(100, rel=0.01)


def test_results_have_a_line_for_each_row_of_a_table():
    made = {
        "schema": 1,
        "rows": [{"a": [1, 2], "b": "ü"}, {"a": []}],
        "ratios": [],
        "plan": {"x": 1},
    }
    text = page.as_json(made)
    assert json.loads(text) == made and text.count("\n") == 9 and '  {"a": []}\n ]' in text
