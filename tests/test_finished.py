"""From noise to a finished picture: denoising, tone curves, PNG files, other integrators."""

import builtins
import json
from pathlib import Path

import aniso_pm
import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm.errors import InputError
from aniso_pm.pictures import denoising, display
from aniso_pm.rendering.allotment import Allotment
from aniso_pm.rendering.film import pixel_weights, splat
from command_line import OURS, PATH, SCENE, assert_one_line
from PIL import Image
from rooms import room

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture
def without(monkeypatch):
    """Make a module seem not to be installed."""

    def without(module):
        real = builtins.__import__

        def refuse(name, *rest, **kwargs):
            if name == module:
                raise ImportError(name=name)
            return real(name, *rest, **kwargs)

        monkeypatch.setattr(builtins, "__import__", refuse)
        display._aces.cache_clear()

    yield without
    display._aces.cache_clear()


def scene_file(tmp_path, integrator=OURS, extra=""):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(integrator=integrator, extra=extra))
    return path


# --- Denoising ---


def noisy(size=64, sigma=0.3, seed=0):
    """(clean picture with an edge, noise of a standard deviation, albedo, normal)"""
    clean = np.full((size, size, 3), 0.2, np.float32)
    clean[:, size // 2 :] = 0.7
    noise = sigma * np.random.default_rng(seed).standard_normal(clean.shape).astype(np.float32)
    normal = np.zeros_like(clean)
    normal[..., 2] = 1
    return clean, noise, clean, normal


def mse(a, b):
    return float(((a - b) ** 2).mean())


def test_noise_is_removed_and_edges_stay():
    clean, noise, albedo, normal = noisy()
    rendered = np.maximum(clean + noise, 0)
    found = aniso_pm.denoise(rendered, {"albedo": albedo, "normal": normal})
    assert found.shape == clean.shape and found.dtype == np.float32
    assert mse(found, clean) < 0.05 * mse(rendered, clean)
    edge = found[:, 33].mean() - found[:, 30].mean()
    assert edge == pytest.approx(0.5, abs=0.05)


def test_where_the_rendering_has_converged_it_is_left_alone():
    """A fine pattern without noise, which the filter takes for noise."""
    pattern = np.random.default_rng(1).uniform(0.1, 1, (64, 64, 3)).astype(np.float32)
    exact = {"standard_error": np.full_like(pattern, 1e-4)}
    filtered = aniso_pm.denoise(pattern)
    assert mse(filtered, pattern) > 1e-3
    assert mse(aniso_pm.denoise(pattern, exact), pattern) < 1e-6
    np.testing.assert_array_equal(aniso_pm.denoise(pattern, exact, blend=False), filtered)


def test_where_it_is_noise_the_filter_has_its_way():
    clean, noise, *_ = noisy(sigma=0.1)
    rendered = np.maximum(clean + noise, 0)
    known = {"standard_error": np.full_like(clean, 0.1)}
    blended, filtered = aniso_pm.denoise(rendered, known), aniso_pm.denoise(rendered)
    # The blend keeps the little by which differences exceed the noise by chance.
    assert mse(blended, clean) < 0.1 * mse(rendered, clean) > 2 * mse(filtered, clean)


def test_noise_is_removed_whatever_the_reconstruction_filter(variant_llvm_rgb):
    """Filters wider than a pixel make noise look like texture: denoising comes before them."""
    definition = room(size=48)
    definition["sensor"]["film"]["rfilter"] = {"type": "gaussian"}
    scene = mi.load_dict(definition)

    def render(spp, layers):
        plugin = mi.load_dict({"type": "aniso_pm", "passes": 4, "layers": layers})
        return np.array(mi.render(scene, integrator=plugin, spp=spp)), plugin.layers

    right, _ = render(1024, "")
    rendered, found = render(4, "denoising")
    assert mse(aniso_pm.denoise(rendered), right) > 0.5 * mse(rendered, right)
    denoised = aniso_pm.denoise(rendered, found)
    assert mse(denoised, right) < 0.3 * mse(rendered, right)
    assert denoised.mean() == pytest.approx(right.mean(), rel=0.02)


@pytest.mark.parametrize("name", ["box", "tent", "gaussian", "mitchell", "lanczos"])
def test_a_filter_over_whole_pixels_is_the_films(variant_llvm_rgb, name):
    """An edge between pixels, filtered by the film and afterwards."""
    film = mi.load_dict({"type": "hdrfilm", "width": 20, "height": 6, "rfilter": {"type": name}})
    film.prepare([])
    weights = pixel_weights(film)
    assert sum(weights) == pytest.approx(1) and weights == pytest.approx(weights[::-1], abs=1e-6)
    assert (len(weights) == 1) == (name == "box")
    size, each = film.size(), 1024
    lanes = next(Allotment(size[0] * size[1], each).wavefronts(0, 0, 0, 1 << 30))[0]
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, lanes.count)
    column, row = lanes.pixel % size[0], lanes.pixel // size[0]
    position = mi.Point2f(mi.Float(column), mi.Float(row)) + sampler.next_2d()
    bright = dr.select(column >= 10, mi.Float(1), mi.Float(0))
    film.put_block(
        mi.ImageBlock(splat(film, lanes, position, mi.Color3f(bright), mi.Bool(True), None))
    )
    edge = np.zeros((6, 20, 3), np.float32)
    edge[:, 10:] = 1
    found = denoising.filtered_by(edge, weights)
    np.testing.assert_allclose(np.array(film.develop())[..., :3], found, atol=0.02)


def test_layers_of_another_size_are_told():
    with pytest.raises(
        ValueError, match=r'"albedo" has the shape \(4, 4, 3\); it must be 8 × 8 × 3'
    ):
        aniso_pm.denoise(np.zeros((8, 8, 3)), {"albedo": np.zeros((4, 4, 3))})


@pytest.mark.parametrize(
    "module, extra, call",
    [
        ("mitsuba_oidn", "denoise", lambda: aniso_pm.denoise(np.zeros((8, 8, 3)))),
        ("PyOpenColorIO", "tonemap", lambda: display.check_tonemap("aces")),
    ],
)
def test_what_is_missing_is_told_with_what_to_install(without, module, extra, call):
    without(module)
    with pytest.raises(InputError, match=rf"not installed: pip install 'aniso-pm\[{extra}\]'$"):
        call()


# --- Tone curves and PNG ---


def test_exposure_is_in_stops_and_srgb_is_the_standard_curve():
    picture = np.array([[[0.0, 0.18, 0.5], [0.9, 1.0, 7.0]]], np.float32)
    shown = display.displayed(picture)
    np.testing.assert_allclose(shown[0, 0], [0, 0.4613561, 0.7353569], atol=1e-6)
    np.testing.assert_allclose(shown[0, 1, 1:], 1, atol=1e-6)
    np.testing.assert_allclose(display.displayed(picture / 4, 2), shown, atol=1e-6)


def test_aces_rolls_off_highlights_and_keeps_alpha():
    grey = np.geomspace(0.01, 30, 30, dtype=np.float32)
    picture = np.stack([grey, grey, grey, np.full_like(grey, 0.25)], 1)[None]
    shown = display.displayed(picture, 0, "aces")
    assert (np.diff(shown[0, :, 1]) > 0).all() and shown[0, -1, 1] < 1
    np.testing.assert_allclose(np.ptp(shown[..., :3], axis=2), 0, atol=1e-3)
    assert (shown[..., 3] == 0.25).all()
    assert 0.3 < display.displayed(np.full((1, 1, 3), 0.18), 0, "aces").mean() < 0.45


def test_png_has_16_bits_and_tells_what_made_it(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    ramp = np.linspace(0, 1, 4096, dtype=np.float32).reshape(64, 64, 1).repeat(3, 2)
    for bits, steps in ((8, 256), (16, 4000)):
        display.write_png(ramp, tmp_path / "a.png", bits=bits, record={"spp": 7, "a": {"b": "é"}})
        back = mi.Bitmap(str(tmp_path / "a.png"))
        values = np.array(back)
        assert values.dtype == {8: np.uint8, 16: np.uint16}[bits] and back.srgb_gamma()
        assert len(np.unique(values)) >= min(steps, 256)
        np.testing.assert_allclose(values / values.max(), display.srgb(ramp), atol=0.51 / 255)
        made_by = json.loads(Image.open(tmp_path / "a.png").text["aniso_pm"])
        assert made_by == {"spp": 7, "a": {"b": "é"}, "exposure": 0, "tonemap": "srgb"}


# --- The program ---


def channels(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = {name: channel.pixels for name, channel in file.channels().items()}
        return pixels, dict(file.header())


def test_layers_and_denoised_picture_are_written_and_merged(run, tmp_path):
    """As Nuke, Blender and tev name them; the rendered picture stays as it is."""
    scene = scene_file(tmp_path)
    common = ["render", scene, "--passes", "8", "--spp", "8"]
    plain = run(*common, "-o", "plain.exr", "--keep-state")
    assert plain[0] == 0, plain
    asked = ["--layers", "direct,caustic,indirect,depth,position,samples,radius"]
    more = ["--denoise", "--png", "--exposure", "1", "--bits", "16", "--tonemap", "aces"]
    status, stdout, stderr = run(*common, "-o", "a.exr", "--keep-state", *asked, *more)
    assert (status, stderr) == (0, "") and "a.exr, a.png: " in stdout
    found, header = channels("a.exr")
    names = {"R", "G", "B", "A", "depth.Z", "samples.Y", "radius.Y"}
    denoising = [f"denoising_{name}" for name in ("picture", "albedo", "error")]
    for layer in ("direct", "caustic", "indirect", "denoised", *denoising):
        names |= {f"{layer}.{c}" for c in "RGB"}
    for layer in ("variance", "standard_error"):
        names |= {f"{layer}.{c}" for c in "RGBA"}
    names |= {f"{layer}.{c}" for layer in ("denoising_normal", "position") for c in "XYZ"}
    assert set(found) == names
    before, _ = channels("plain.exr")
    for c in "RGB":
        np.testing.assert_allclose(found[c], before[c], rtol=2e-3, atol=1e-4)
        total = sum(found[f"{layer}.{c}"] for layer in ("direct", "caustic", "indirect"))
        np.testing.assert_allclose(total, found[c], atol=1e-4)
    assert np.abs(found["denoised.R"] - found["R"]).max() > 1e-3
    assert header["aniso_pm.denoise.filter"].startswith("Open Image Denoise 2")
    assert header["aniso_pm.denoise.auxiliary"] == '["albedo", "normal"]'
    assert header["aniso_pm.denoise.blended_by"] == "standard error"
    png = mi.Bitmap("a.png")
    assert np.array(png).dtype == np.uint16
    picture = np.stack([found[c] for c in ("denoised.R", "denoised.G", "denoised.B", "A")], 2)
    want = 65535 * display.displayed(picture, 1, "aces")
    np.testing.assert_allclose(np.array(png), want, atol=8)

    status, _, stderr = run("merge", "a.exr", "-o", "b.exr", "--denoise", "--png")
    assert (status, stderr) == (0, "")
    merged, _ = channels("b.exr")
    assert set(merged) == names
    for name in names:
        np.testing.assert_allclose(merged[name], found[name], rtol=1e-3, atol=2e-3, err_msg=name)


@pytest.mark.parametrize(
    "options, parts",
    [
        (["--layers", "albedo", "-p", "layers=normal"], ["--layers", "-p layers", "one of them"]),
        (["--save-every", "9", "--integrator", "path"], ["--save-every", "one pass only"]),
        (
            ["--save-every", "9", "-p", "passes=1"],
            ["--save-every", "a single pass", "--passes"],
        ),
        (["--layers", "albedo,nothing"], ['no layer "nothing"', "albedo"]),
        (["--bits", "12", "--png"], ["--bits is 12", "8 or 16"]),
        (["--exposure", "1"], ["add --png"]),
        (["--tonemap", "agx", "--png"], ["'agx'", "srgb, aces"]),
        (["-p", "photon_count"], ["-p takes NAME=VALUE"]),
        (["-p", "photon_count=-3"], ["photon_count", "-3"]),
        (["-p", "nonsense=3"], ["nonsense"]),
        (["--integrator", "nonsense"], ["--integrator nonsense"]),
        (["--integrator", "diffuse"], ["--integrator diffuse", "no integrator"]),
        (["--integrator", "path", "--layers", "albedo"], ["--layers", "aniso_pm does"]),
    ],
)
def test_wrong_options_are_one_clear_line(run, tmp_path, options, parts):
    assert_one_line(run("render", scene_file(tmp_path), "-o", "a.exr", *options), *parts)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml"]


@pytest.mark.parametrize("option", ["--png", "--denoise"])
def test_bands_that_are_no_colours_are_told_before_rendering(run, tmp_path, option):
    band = '<spectrum name="band" value="400:1, 700:0"/>'
    text = SCENE.replace('"hdrfilm">', f'"specfilm">{band}')
    text = text.replace('<string name="pixel_format" value="rgba"/>', "")
    (tmp_path / "scene.xml").write_text(text.format(integrator=PATH, extra=""))
    variant = ["-m", "llvm_ad_spectral"]
    result = run("render", "scene.xml", "-o", "a.exr", *variant, option)
    assert_one_line(result, f"{option}: the pixels of a SpecFilm are no colours")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml"]
    assert run("render", "scene.xml", "-o", "a.exr", *variant)[0] == 0


def test_parameters_of_another_integrator_need_its_name(run, tmp_path):
    result = run("render", scene_file(tmp_path, PATH), "-o", "a.exr", "-p", "max_depth=2")
    assert_one_line(result, "the scene's integrator is PathIntegrator", "--integrator")


def test_the_integrator_and_its_parameters_are_replaced(run, tmp_path):
    scene = scene_file(tmp_path, PATH)
    common = ["--json", "--quiet", "--spp", "2", "-o", "a.exr"]
    ours = ["--integrator", "aniso_pm", "-p", "map=global", "-p", "guard=false"]
    status, stdout, _ = run("render", scene, *common, *ours, "-p", "max_depth=4")
    record = json.loads(stdout)
    assert status == 0 and record["integrator"] == "AnisoPhotonMapper"
    for name, value in {"map": "global", "guard": False, "max_depth": 4}.items():
        assert record["parameters"][name] == value
    changed = ["-p", "alpha=0.5", "-p", "time=0.01"]
    status, stdout, _ = run("render", scene_file(tmp_path), *common, *changed)
    found = json.loads(stdout)["parameters"]
    assert (status, found["alpha"], found["passes"], found["photon_count"]) == (0, 0.5, 0, 20000)


def test_a_warning_is_printed_once(run, tmp_path, monkeypatch):
    real = mi.load_file

    def noisy_load(*args, **kwargs):
        for _ in range(3):
            mi.Log(mi.LogLevel.Warn, "the same again")
        mi.Log(mi.LogLevel.Warn, "another one")
        return real(*args, **kwargs)

    monkeypatch.setattr(mi, "load_file", noisy_load)
    status, _, stderr = run("render", scene_file(tmp_path, PATH), "-o", "a.exr")
    assert status == 0
    assert stderr.splitlines() == [
        "aniso-pm: warning: the same again",
        "aniso-pm: warning: another one",
        "aniso-pm: 2 warnings came again and are not repeated",
    ]


@pytest.mark.slow
def test_what_blender_exports_renders_untouched(run, tmp_path):
    """The light of `path` by another integrator, with the file as it is but for its assets."""
    tests = Path(__file__).resolve().parent
    given = [tests / "blender_export.xml", "-D", f"assets={tests.parent / 'scenes'}", "--quiet"]
    ours = ["--integrator", "aniso_pm", "-p", "passes=4", "-p", "max_depth=12"]
    pictures = {}
    for name, more in (("path", ["--spp", "1024"]), ("ours", [*ours, "--spp", "256"])):
        for seed in range(3):
            output = f"{name}_{seed}.exr"
            status, _, stderr = run("render", *given, "-o", output, "--seed", seed, *more)
            assert (status, stderr) == (0, "")
            picture = np.array(mi.Bitmap(output).split()[0][1])[..., :3]
            pictures.setdefault(name, []).append(picture.astype(float))
    # Rays off metal that meet the lamp over glass are rare: 4 % of one picture, none of another.
    path, found = (np.median(pictures[name], axis=0) for name in ("path", "ours"))
    assert found.mean() == pytest.approx(path.mean(), rel=0.02)
    # Pixel by pixel as far as noise allows: the camera looks where Blender's did.
    assert np.abs(found - path).mean() < 0.1 * path.mean()
