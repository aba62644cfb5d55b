"""``map=auto``: the pilot chooses the use of least error, and never one that loses light."""

import math
from dataclasses import replace
from types import SimpleNamespace

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import footprint, pilot, survey
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.tiles import Tiles
from conftest import slow
from renders import array
from rooms import room, room_with_ball, wall


def ball(light, bsdf, size=24):
    """A ball over a large plate."""
    T = mi.ScalarTransform4f
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at(origin=[0, 2, 5], target=[0, 0.3, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "light": light,
        "plate": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(3),
            "bsdf": diffuse,
        },
        "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.6, "bsdf": bsdf},
    }


SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 1}}
POINT = {
    "type": "point",
    "position": [2, 4, 1],
    "intensity": {"type": "rgb", "value": 30},
}
PLASTIC = {"type": "roughplastic", "alpha": 0.1}
GLASS = {"type": "dielectric"}


def settled(definition, **settings):
    scene = mi.load_dict(definition)
    prepared = prepare(scene, Settings(**settings), False)
    return pilot.settle(prepared, scene.sensors()[0], 0, 16), prepared


def test_what_path_tracing_does_well_is_path_traced(variant_llvm_rgb, monkeypatch):
    """Also where no map is read, because even photons without noise or cost would gain little."""
    promised = []
    for close in (survey._CLOSE, 0):
        monkeypatch.setattr(survey, "_CLOSE", close)
        found, prepared = settled(ball(SKY, PLASTIC, 64))
        assert prepared.undecided
        assert found.use == "none"
        promised.append(found.errors)
    at_once, compared = promised
    assert list(at_once) == ["none"]
    assert at_once["none"] == pytest.approx(compared["none"], rel=0.05)
    assert compared["none"] < compared["global"]


def test_maps_are_read_where_eye_paths_may_have_missed_caustics(variant_llvm_rgb, monkeypatch):
    """However good path tracing looks."""
    monkeypatch.setattr(survey, "_CLOSE", math.inf)
    asked, answers = [], iter((1.0, None, None))

    def doubt(*given):
        asked.append(given)
        return next(answers)

    monkeypatch.setattr(survey, "_doubt", doubt)
    found, _ = settled(ball(SKY, PLASTIC, 64))
    assert found.use != "none" and found.errors["none"] is None
    seen, at_once, compared = asked
    assert seen[1][0] is seen[0]  # before any map is asked
    # The light of caustics that the decision goes by is that of the map.
    assert np.mean(at_once[1]) == pytest.approx(np.mean(compared[1]), rel=0.1)


@pytest.mark.parametrize("bsdf", [PLASTIC, GLASS], ids=["plastic", "glass"])
def test_light_that_only_photons_find_has_a_map(variant_llvm_rgb, bsdf):
    """A point cannot be hit: what it sends over a mirror is lost to eye paths."""
    found, _ = settled(ball(POINT, bsdf))
    assert found.use in ("global", "caustic")
    assert "none" not in found.errors


def test_caustics_that_eye_paths_rarely_find_have_a_map(variant_llvm_rgb):
    lamp = {
        "type": "sphere",
        "center": [1, 4, 1],
        "radius": 0.03,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2000}},
    }
    found, _ = settled(ball(lamp, GLASS))
    assert found.use in ("global", "caustic")
    assert found.errors.get("none") is None


@pytest.mark.parametrize("use", ["caustic", *slow("global", "final_gather")])
def test_a_use_that_is_given_is_kept(variant_llvm_rgb, use):
    given = {"final_gather": True} if use == "final_gather" else {"map": use}
    found, prepared = settled(ball(SKY, PLASTIC), **given)
    assert found.use == use and not found.errors and not prepared.undecided


SCENES = {
    "plastic": lambda: ball(SKY, PLASTIC),
    "glass": lambda: ball(SKY, GLASS),
    "room": lambda: room_with_ball(size=12),
}


@pytest.mark.parametrize(
    "scene",
    ["room", *slow("plastic", "glass")],
)
def test_what_uses_leave_to_eye_paths_is_told_apart(variant_llvm_rgb, scene):
    """The parts add up to what eye paths of each use see, and all of them to path's picture."""
    scene = mi.load_dict(SCENES[scene]())
    sensor, spp = scene.sensors()[0], 4096
    prepared = prepare(scene, Settings(), False)
    width, height = sensor.film().crop_size()
    lanes = width * height * spp

    def rays(seed):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, lanes)
        pixel = dr.arange(mi.UInt32, lanes) // spp
        place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
        ray, _ = sensor.sample_ray(0, 0.5, place / mi.Point2f(width, height), mi.Point2f(0.5))
        return sampler, ray

    def mean_and_error(values):
        values = values.numpy().astype(np.float64)
        return values.mean(), values.std() / lanes**0.5

    def seen(use, seed):
        return replace(prepared, chosen=use).trace(*rays(seed))[0]

    parts = seen("survey", 1)
    total = dr.sum(parts.radiance) / 3
    for seed, use, value in (
        (2, "global", total - parts.later),
        (3, "caustic", total),
        (4, "none", total + parts.caustic),
    ):
        a, error_a = mean_and_error(value)
        b, error_b = mean_and_error(dr.sum(seen(use, seed)) / 3)
        error = np.hypot(error_a, error_b)
        assert error < 0.01 * b
        assert abs(a - b) < 4 * error, use
    image = mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=spp)
    assert abs(float(np.mean(image)) - b) < 4 * 1.5 * error_b


@pytest.mark.parametrize(
    "chosen",
    ["caustic", *slow("global", "none")],
)
def test_every_choice_gives_the_picture_of_path(variant_llvm_rgb, monkeypatch, chosen):
    from aniso_pm.rendering import beginning

    scene = mi.load_dict(ball(SKY, PLASTIC))

    def settle(prepared, *args, **more):
        assert prepared.undecided
        return pilot.settle(replace(prepared, chosen=chosen), *args, **more)

    monkeypatch.setattr(beginning, "settle", settle)
    plugin = mi.load_dict({"type": "aniso_pm", "initial_radius": 0.03, "photon_count": 300_000})
    ours = [np.mean(mi.render(scene, integrator=plugin, spp=256, seed=s)) for s in range(4)]
    assert plugin.statistics["map"] == chosen
    path = mi.load_dict({"type": "path"})
    theirs = [np.mean(mi.render(scene, integrator=path, spp=1024, seed=s)) for s in range(4)]
    error = np.hypot(np.std(ours), np.std(theirs)) / np.mean(theirs) / 3**0.5
    assert error < 0.003
    assert abs(np.mean(ours) / np.mean(theirs) - 1) < 0.005 + 3 * error


def test_after_path_tracing_sample_path_traces(variant_llvm_rgb):
    """``aov`` samples with what render() has left: no map of another use."""
    scene = mi.load_dict(ball(SKY, PLASTIC, 64))
    plugin = mi.load_dict({"type": "aniso_pm"})
    image = mi.render(scene, integrator=plugin, spp=64)
    assert plugin.statistics["map"] == "none"
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1 << 18)
    sensor = scene.sensors()[0]
    ray, _ = sensor.sample_ray(0, 0.5, sampler.next_2d(), mi.Point2f(0.5))
    L, _, _ = plugin.sample(scene, sampler, ray)
    found = float(np.mean(dr.sum(L).numpy() / 3))
    assert found == pytest.approx(float(np.mean(image)), rel=0.01)


def test_noise_of_a_film_filter(variant_llvm_rgb):
    """∫f²/(∫f)²: 1 for a box; 4/9 for a tent; 1/(4πσ²) for a Gaussian that is not cut."""
    from aniso_pm.rendering.film import noise_share

    def share(**rfilter):
        return noise_share(mi.load_dict({"type": "hdrfilm", "rfilter": rfilter}))

    assert share(type="box") == pytest.approx(1)
    assert share(type="tent") == pytest.approx(4 / 9, rel=1e-3)
    assert share(type="gaussian", stddev=0.4) == pytest.approx(1 / (4 * np.pi * 0.16), rel=0.01)


def test_uneven_samples_only_where_they_were_tried(variant_llvm_rgb):
    """Noise that is in one half of the picture is followed; single bright pairs are not."""
    tiles = Tiles(1, 64, 64)
    random = np.random.default_rng(3)
    half = np.where(np.arange(64 * 64) % 64 < 32, 20.0, 1.0) * random.chisquare(8, 64 * 64)
    work = np.ones(64 * 64)
    counts = tiles.counts(half, work, 16).reshape(64, 64)
    assert counts[:, :28].mean() > 2 * counts[:, 36:].mean()
    assert counts.mean() == 16
    rare = (random.random(64 * 64) < 0.01) * 100.0 + 0.1
    assert tiles.counts(rare, work, 16) is None


def close_up():
    """A glass ball of three hundredths in a room of two, on a floor of six hundred beside a hill of
    rough metal: of ten thousand photons over metal and glass one falls where the camera looks."""
    T = mi.ScalarTransform4f
    scene = room(size=48)
    del scene["back"], scene["front"]
    scene["sensor"]["fov"] = 50
    scene["sensor"]["to_world"] = T().look_at(
        origin=[0.05, -0.93, 1.05], target=[0.02, -0.97, 0.9], up=[0, 1, 0]
    )
    metal = {"type": "roughconductor", "alpha": 0.3}
    hill = {"type": "sphere", "center": [0, 0, -30], "radius": 20, "bsdf": metal}
    glass = {"type": "sphere", "center": [0, -0.97, 0.9], "radius": 0.03, "bsdf": GLASS}
    far = wall(T().translate([0, -60, 0]).rotate([1, 0, 0], -90).scale(300), 0.5)
    return scene | {"hill": hill, "glass": glass, "far": far}


@pytest.mark.with_pilot
def test_photons_that_are_there_by_luck_decide_nothing(variant_llvm_rgb, monkeypatch):
    """Maps that miss the caustic, or have it from a handful of photons, promised less error than
    path tracing; kernels of three units then spread it beyond the picture."""
    monkeypatch.setattr(footprint, "TRIED", math.inf)
    scene = mi.load_dict(close_up())
    path, installed = (mi.load_dict({"type": name}) for name in ("path", "aniso_pm"))
    plain = array(mi.render(scene, integrator=path, spp=1024))
    assert plain.mean() > 0.01
    for seed in range(3):
        found = array(mi.render(scene, integrator=installed, spp=64, seed=seed))
        assert found.mean() == pytest.approx(plain.mean(), rel=0.02)


@pytest.mark.with_pilot
def test_kernels_fit_what_the_camera_sees_however_few_photons(variant_llvm_rgb, monkeypatch):
    """Those of the bandwidth are wider than the picture here."""
    scene = mi.load_dict(close_up())
    plain = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024)).mean()

    def energy():
        caustic = mi.load_dict({"type": "aniso_pm", "map": "caustic"})
        seeds = range(1, 4)  # the pilot of seed 0 finds no photon
        means = [array(mi.render(scene, integrator=caustic, spp=64, seed=s)).mean() for s in seeds]
        return np.mean(means) / plain

    assert energy() == pytest.approx(1, abs=0.02)
    monkeypatch.setattr(footprint, "TRIED", math.inf)
    assert energy() < 0.96


def test_maps_miss_what_they_have_too_little_of_or_too_few_photons_for(variant_llvm_rgb):
    light = np.ones((100, 2))
    weight = np.ones(100)

    def misses(has=(light, light), photons=1000, needed=False, met=light):
        scene = SimpleNamespace(photons_are_dispensable=not needed)
        given = survey._Pilot(scene, None, 0, None, None, None, None)
        return given._misses(met, has, photons, weight)

    assert not misses()
    assert misses(photons=10)
    assert misses(has=(0.1 * light, 3 * light))  # by luck in one of them
    assert not misses(has=(0.6 * light, 0.7 * light))
    assert not misses(photons=10, needed=True)
    assert not misses(photons=10, met=1e-5 * light)
    rare = 0 * light
    rare[:5] = 20.0
    assert not misses(photons=10, met=rare)  # nor do eye paths know
