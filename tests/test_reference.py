"""References: independent halves that tell their own error, kept with what they depend on."""

import json

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm import cli
from aniso_pm.errors import InputError
from aniso_pm.instruments.report import reference as references

SCENE = """<scene version="3.0.0">
  <default name="albedo" value="0.5"/> <default name="light" value="100"/>
  <default name="size" value="8"/> <default name="spp" value="4"/> <default name="depth" value="2"/>
  <default name="kernel" value="anisotropic"/>
  <integrator type="aniso_pm">
    <string name="kernel" value="$kernel"/> <integer name="max_depth" value="$depth"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world">
      <lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/>
    </transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$size"/> <integer name="height" value="8"/>
      <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><scale value="4"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="$albedo"/></bsdf>
  </shape>
  <shape type="sphere" id="lamp">
    <point name="center" x="1" y="2" z="3.5"/> <float name="radius" value="0.5"/>
    <emitter type="area"><rgb name="radiance" value="$light"/></emitter>
  </shape>
</scene>
"""


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.fixture
def scene_file(tmp_path, own_cache):
    path = tmp_path / "room.xml"
    path.write_text(SCENE)
    return path


def loaded(path, **defines):
    scene = mi.load_file(str(path), optimize=False, **{k: str(v) for k, v in defines.items()})
    return scene, scene.sensors()[0]


@pytest.fixture
def run(capfd):
    def run(*arguments):
        status = cli.main(["reference", *(str(argument) for argument in arguments)])
        return status, *capfd.readouterr()

    return run


def test_the_mean_is_the_irradiance_that_is_known_in_closed_form(scene_file):
    """A sphere light over a floor: E = π L (r/d)² cos θ exactly, when all of it is above."""
    world, sensor = loaded(scene_file)
    made = references.make(world, sensor, spp=4096)
    width = 2 * 3 * np.tan(np.radians(20)) / 8
    x = (np.arange(8) - 3.5) * width
    # To the right is +x, down is −y; the lamp is at (1, 2, 3.5).
    px, py = np.meshgrid(x, -x)
    square = (px - 1) ** 2 + (py - 2) ** 2 + 3.5**2
    exact = 0.5 * 100 * 0.5**2 / square * 3.5 / np.sqrt(square)
    # The filter averages over pixels: a relative curvature of 0.1 %.
    assert made.mean.mean((2,)) == pytest.approx(exact, rel=0.01)
    assert made.mean.mean() == pytest.approx(exact.mean(), rel=0.002)


def test_own_error_is_the_true_error_and_falls_with_the_root_of_the_samples(scene_file):
    world, sensor = loaded(scene_file)
    truth = references.make(world, sensor, spp=8192, seed=99).mean
    found = {
        spp: [references.make(world, sensor, spp=spp, seed=seed) for seed in range(8)]
        for spp in (16, 256)
    }
    own, true = (
        {spp: np.sqrt(np.mean([f(r) ** 2 for r in made])) for spp, made in found.items()}
        for f in (
            lambda r: r.own_error,
            lambda r: references.relative_rmse(r.mean - truth, truth),
        )
    )
    # Root mean squares over 8 × 192 values of noise that is the same in three colours: 4 %; the
    # truth has a noise of its own, a sixth of that of 256 samples.
    for spp in found:
        assert own[spp] == pytest.approx(true[spp], rel=0.2)
    assert own[16] / own[256] == pytest.approx(4, rel=0.2)


def test_the_same_seed_repeats_and_another_does_not(scene_file):
    world, sensor = loaded(scene_file)
    a, b, c = (references.make(world, sensor, spp=16, seed=seed) for seed in (1, 1, 2))
    # Samples are added up in the order of threads.
    assert a.mean == pytest.approx(b.mean, rel=1e-4)
    assert np.abs(a.mean - c.mean).max() > 1e-4
    assert np.abs(a.half_difference).max() > 1e-4


def test_going_on_equals_having_made_it_at_once(scene_file):
    world, sensor = loaded(scene_file)
    once = references.make(world, sensor, spp=512)
    half = references.make(world, sensor, spp=256)
    twice = references.make(world, sensor, spp=512, start=half)
    assert (once.record["waves"], once.record["spp"]) == (8, 512)
    assert (twice.record["waves"], twice.record["spp"]) == (8, 512)
    assert twice.mean == pytest.approx(once.mean, rel=1e-5)
    assert twice.half_difference == pytest.approx(once.half_difference, abs=1e-5)
    assert twice.record["seconds"] > half.record["seconds"]
    assert sensor.sampler().sample_count() == 4  # as before


def test_a_file_is_read_back_as_it_was_written(scene_file, tmp_path):
    world, sensor = loaded(scene_file)
    made = references.make(world, sensor, spp=16)
    for compact, tolerance in ((False, 1e-6), (True, 1e-2)):
        references.write(tmp_path / "a.exr", made, compact)
        back = references.read(tmp_path / "a.exr")
        assert back.mean == pytest.approx(made.mean, rel=tolerance, abs=tolerance * 0.01)
        assert back.own_error == pytest.approx(made.own_error, rel=0.05 if compact else 1e-4)
        assert {k: back.record[k] for k in made.record} == made.record


def test_what_a_reference_depends_on(scene_file):
    wanted = references.depends_on(*loaded(scene_file))
    for same in ({"spp": 64}, {"kernel": "isotropic"}):
        assert references.depends_on(*loaded(scene_file, **same)) == wanted
    for name, other in (
        ('parameter "max_depth"', {"depth": 3}),
        ("film size", {"size": 9}),
        ("scene, floor", {"albedo": 0.6}),
        ("scene, lamp", {"light": 200}),
    ):
        there = references.depends_on(*loaded(scene_file, **other))
        assert name in {key for key in wanted if there[key] != wanted[key]}


def test_limits_of_any_integrator_are_honoured(scene_file):
    """Depth 1 shows emitters only: the floor is black."""
    world, sensor = loaded(scene_file, depth=1)
    assert references.make(world, sensor, spp=4).mean.max() == 0
    for kind in ("path", "prb", "ptracer"):
        integrator = mi.load_dict({"type": kind, "max_depth": 7})
        assert references.path_limits(integrator) == {"max_depth": 7, "hide_emitters": False}
    hidden = mi.load_dict({"type": "path", "hide_emitters": True})
    assert references.path_limits(hidden) == {"max_depth": -1, "hide_emitters": True}


def test_integrators_that_start_at_the_lights_agree(scene_file):
    world, sensor = loaded(scene_file)
    path, light = (
        references.make(world, sensor, integrator=name, spp=8192) for name in ("path", "ptracer")
    )
    error = np.hypot(path.own_error, light.own_error)
    assert references.relative_rmse(path.mean - light.mean, path.mean) < 2 * error
    assert light.mean.mean() == pytest.approx(path.mean.mean(), rel=3 * error / 8)  # 64 pixels


def test_the_command_makes_goes_on_and_refuses_with_the_entry_that_differs(run, scene_file):
    out = scene_file.parent / "references" / "room.exr"
    out.parent.mkdir()
    status, said, _ = run(scene_file, "--spp", 8, "-o", out, "--json")
    assert status == 0 and json.loads(said)["spp"] == 8
    status, said, _ = run(scene_file, "--spp", 24, "-o", out)
    assert status == 0 and "24 samples per pixel" in said
    assert OpenEXR.File(str(out), header_only=True).header()["spp"] == 24
    status, said, _ = run(scene_file, "--time", 0.1, "-o", out, "--json")
    spp = json.loads(said)["spp"]
    assert status == 0 and spp >= 24 + 2 * 64

    for option, difference in (
        (("-D", "albedo=0.6"), "scene, floor has changed"),
        (("-D", "size=9"), "film size was 8x8, is 9x8"),
        (("--seed", 5), "seed was 0, is 5"),
        (("--integrator", "ptracer"), "integrator was path, is ptracer"),
    ):
        status, _, error = run(scene_file, "--spp", 48, "-o", out, *option)
        assert status == 2 and difference in error and str(out) in error
    # None of that has touched it.
    assert references.read(out).record["spp"] == spp


def test_the_command_refuses_what_cannot_be_a_reference(run, scene_file, tmp_path):
    (tmp_path / "text.exr").write_text("no picture")
    for arguments, message in (
        ((), "--time SECONDS, --spp N"),
        (("--spp", 4, "--integrator", "aniso_pm"), "its own reference"),
        (("--spp", 4, "--integrator", "nonsense"), 'integrator "nonsense" cannot be used here'),
        (("--spp", 4, "-o", tmp_path / "a.png"), "must end in .exr"),
        (("--spp", 4, "-o", tmp_path / "text.exr"), "cannot be read as a reference"),
    ):
        status, _, error = run(scene_file, *arguments)
        assert status == 2 and message in error and error.count("\n") == 1, error


def test_pictures_that_are_no_references_are_named(tmp_path):
    picture = tmp_path / "a.exr"
    mi.Bitmap(np.zeros((4, 4, 3), np.float32)).write(str(picture))
    for path in (picture, tmp_path / "none.exr"):
        with pytest.raises(InputError, match=str(path)):
            references.read(path)


def test_references_are_found_beside_the_scene_by_film_size_and_in_the_cache(run, scene_file):
    beside = scene_file.parent / "references"
    beside.mkdir()
    assert references.find(scene_file, *loaded(scene_file)) is None
    run(scene_file, "--spp", 4, "-o", beside / "room.exr")
    run(scene_file, "--spp", 4, "-D", "size=16", "-o", beside / "room_16x8.exr")
    run(scene_file, "--spp", 4, "-D", "light=300")
    (beside / "room_damaged.exr").write_text("")
    for defines, where in (
        ({}, beside / "room.exr"),
        ({"size": 16, "spp": 2}, beside / "room_16x8.exr"),
        ({"light": 300}, "cache"),
        ({"light": 400}, None),
    ):
        found = references.find(scene_file, *loaded(scene_file, **defines))
        if where is None:
            assert found is None
        else:
            assert str(where) in str(found.path)
