"""Emitters that eye paths ask for direct light (``transport.direct_light``)."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.instruments import inspect
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from aniso_pm.transport import direct_light, emission
from aniso_pm.transport.direct_light import DirectLight
from conftest import leave_out_the_pilot

pytestmark = pytest.mark.usefixtures("rgb")


def square(x, y, z, size, radiance, tilt=180):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([1, 0, 0], tilt).scale(size)
    return {"type": "rectangle", "to_world": to_world, "emitter": area(radiance)}


def area(radiance):
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def emitters():
    """One of each kind; the room is the cube from -1 to 1."""
    t = mi.ScalarTransform4f
    return {
        "flat": square(0.3, 0.2, 0.9, 0.1, 20.0),
        "tilted": square(-0.8, 0.2, 0.3, 0.2, 5.0, 130),
        "ball": {"type": "sphere", "center": [0.6, 0.5, -0.2], "radius": 0.1, "e": area(9.0)},
        "point": {"type": "point", "position": [-0.5, -0.5, 0.4], "intensity": 0.3},
        "spot": {
            "type": "spot",
            "to_world": t().look_at([0.5, -0.8, 0.9], [0, 0, -1], [0, 0, 1]),
            "intensity": 4.0,
            "cutoff_angle": 25,
        },
        "sun": {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": 0.5},
        "sky": {"type": "constant", "radiance": 0.2},
    }


def scene_of(lamps, **more):
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
    }
    return mi.load_dict({"type": "scene", "floor": floor, **lamps, **more})


def prepared(scene):
    return DirectLight.of(scene, emission.prepare(scene))


def places(scene, count, through=False):
    """(interactions, normals, through) near the floor of the cube."""
    rng = np.random.default_rng(5)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p = mi.Point3f(rng.uniform(-1, [[1], [1], [-0.8]], (3, count)))
    si.n = dr.normalize(mi.Normal3f(rng.normal(size=(3, count))))
    si.sh_frame = mi.Frame3f(si.n)
    return si, mi.Vector3f(si.n), dr.full(mi.Bool, through, count)


def uniform(count):
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    return sampler.next_2d()


def test_chances_are_those_of_the_samples():
    scene = scene_of(emitters())
    direct = prepared(scene)
    count = 40_000
    si, n, through = places(scene, 1)
    chances = direct.chances(si, n, through)
    p = np.array([c.numpy()[0] for c in chances])
    np.testing.assert_allclose(p.sum(), 1, rtol=1e-5)
    assert (p > 0.9 * direct_light._BY_WEIGHT / 7).all()
    wide = [dr.repeat(c, count) for c in chances]
    ds, _ = direct.sample(
        dr.gather(type(si), si, dr.zeros(mi.UInt32, count)), wide, uniform(count), True
    )
    drawn = dr.reinterpret_array(mi.UInt32, ds.emitter).numpy()
    ids = dr.reinterpret_array(mi.UInt32, scene.emitters_dr()).numpy()
    members = direct.members.numpy()
    for group, chance in zip(direct.groups, p, strict=True):
        share = np.isin(drawn, ids[members[group.first : group.first + group.count]]).mean()
        assert abs(share - chance) < 5 * np.sqrt(chance / count)


@pytest.mark.parametrize("through", [False, True])
def test_densities_are_those_of_the_samples(through):
    """What a ray meets has the density with which it would have been drawn."""
    lamps = {k: v for k, v in emitters().items() if k not in ("point", "spot", "sun")}
    many = {f"lamp_{k}": square(0.08 * k - 0.8, -0.5, 0.6, 0.02, 50.0) for k in range(20)}
    scene = scene_of(lamps | many)
    direct = prepared(scene)
    assert max(group.count for group in direct.groups) > 1
    si, n, through = places(scene, 50_000, through)
    chances = direct.chances(si, n, through)
    ds, light = direct.sample(si, chances, uniform(50_000), True)
    valid = dr.max(light) > 0
    np.testing.assert_allclose(
        direct.pdf(si, chances, ds, valid).numpy()[valid.numpy()],
        ds.pdf.numpy()[valid.numpy()],
        rtol=2e-3,
    )


@pytest.mark.parametrize("weights", [{}, {"flat": 5.0, "point": 0.0, "tilted": 0.0, "sky": 0.1}])
def test_the_light_is_that_of_mitsuba(weights):
    """Means over many samples, of one emitter after the other; those of weight 0 are not asked."""
    lamps = emitters()
    for name, weight in weights.items():
        given = {"sampling_weight": weight}
        lamp = lamps[name]
        lamps[name] = lamp | ({"emitter": lamp["emitter"] | given} if "emitter" in lamp else given)
    scene = scene_of(lamps)
    direct = prepared(scene)
    count = 1 << 20
    si, n, through = places(scene, count)
    ds, ours = direct.sample(si, direct.chances(si, n, through), uniform(count), True)
    theirs_ds, theirs = scene.sample_emitter_direction(si, uniform(count), False, True)
    for emitter in scene.emitters():
        a, b = (
            dr.mean(dr.select(d.emitter == mi.EmitterPtr(emitter), light[0] / (0.2 + d.dist), 0))
            for d, light in ((ds, ours), (theirs_ds, theirs))
        )
        assert float(a[0]) == pytest.approx(float(b[0]), rel=0.03)


def test_what_cannot_light_a_place_is_hardly_asked():
    lamps = {"above": square(0, 0, 0.9, 0.1, 1.0), "below": square(0, 0, -2.5, 0.1, 100.0, 0)}
    lamps |= {"away": square(0.1, 0, 0.9, 0.1, 100.0, 0)}  # looks up
    scene = scene_of(lamps)
    direct = prepared(scene)
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.p = mi.Point3f(0.2, 0.1, -1)
    ids = [e.get_shape().id() for e in scene.emitters()]

    def chances(through):
        p = direct.chances(si, mi.Vector3f(0, 0, 1), mi.Bool(through))
        return {
            ids[direct.members[g.first]]: c.numpy()[0]
            for g, c in zip(direct.groups, p, strict=True)
        }

    even = direct_light._BY_WEIGHT / 3
    p = chances(False)
    assert p["above"] == pytest.approx(1 - 2 * even, rel=1e-4)
    assert p["below"] == p["away"] == pytest.approx(even, rel=1e-4)
    assert chances(True)["below"] > 0.5


def test_near_lamps_are_asked_most():
    lamps = {f"lamp_{k}": square(0.4 * k - 3, 0, 0.9, 0.05, 1.0) for k in range(40)}
    scene = scene_of(lamps)
    direct = prepared(scene)
    assert len(direct.groups) == 12
    assert sorted(direct.members.numpy()) == list(range(40))
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.p = mi.Point3f(-3, 0, 0.4)
    p = [c.numpy()[0] for c in direct.chances(si, mi.Vector3f(0, 0, 1), mi.Bool(False))]
    centre = [group.centre.x.numpy()[0] for group in direct.groups]
    assert np.argmax(p) == np.argmin(centre)
    assert max(p) > 0.6


def test_an_environment_is_asked_for_what_other_samples_hardly_find(variants_all):
    """A constant one has the density 1/(4π), a diffuse surface up to 1/π."""
    sky = scene_of({"sky": {"type": "constant", "radiance": 0.2}}).emitters()[0]
    assert direct_light._left_to_us(sky) == pytest.approx(1 / 17, rel=1e-4)
    pixels = np.full((32, 64, 3), 0.1, np.float32)
    pixels[8, 20] = 2e4
    lamp = {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f()}
    assert direct_light._left_to_us(scene_of({"sun": lamp}).emitters()[0]) > 0.8
    sun = scene_of({"sun": {"type": "directional", "direction": [0, 0, -1]}}).emitters()[0]
    assert direct_light._left_to_us(sun) == 1
    # Beside a lamp that gives as much: a constant sky is asked for a seventeenth of its light.
    lamps = {k: emitters()[k] for k in ("sky", "flat")}
    direct = prepared(scene_of(lamps))
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.p, n = mi.Point3f(0.3, 0.2, -1), mi.Vector3f(0, 0, 1)
    lamp, sky = (float(g.irradiance(si.p, n, mi.Bool(False))[0]) for g in direct.groups)
    # Their irradiance is E = L A/d² and π L.
    assert sky / lamp == pytest.approx(np.pi * 0.2 / 17 / (20 * 0.04 / 1.9**2), rel=0.02)


def test_a_strong_lamp_among_many_is_a_group_of_its_own():
    lamps = {f"lamp_{k}": square(0.05 * k - 0.8, 0, 0.9, 0.02, 1.0) for k in range(40)}
    lamps["lamp_17"] = square(0.05 * 17 - 0.8, 0, 0.9, 0.02, 500.0)
    scene = scene_of(lamps)
    direct = prepared(scene)
    assert len(direct.groups) <= 12
    assert sorted(direct.members.numpy()) == list(range(40))
    ids = [e.get_shape().id() for e in scene.emitters()]
    members = [ids[k] for k in direct.members.numpy()]
    group = next(g for g in direct.groups if members[g.first] == "lamp_17")
    assert group.count == 1


def test_nothing_is_chosen_where_there_is_one_emitter():
    lamps = {k: emitters()[k] for k in ("point", "sky")}
    assert prepared(scene_of(lamps)) is not None
    dark = {**lamps, "point": lamps["point"] | {"sampling_weight": 0.0}}
    assert prepared(scene_of(dark)) is None
    assert prepared(scene_of({"sky": lamps["sky"]})) is None
    assert DirectLight.of(scene_of({}), None) is None


def test_weights_share_what_no_estimate_does():
    lamps = {"left": square(-0.5, 0, 0.9, 0.1, 1.0), "right": square(0.5, 0, 0.9, 0.1, 1.0)}
    lamps["right"]["emitter"]["sampling_weight"] = 3.0
    direct = prepared(scene_of(lamps))
    p = direct.chances(dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0, 0, 1), mi.Bool(False))
    half, by_weight = 0.5 * (1 - direct_light._BY_WEIGHT), direct_light._BY_WEIGHT
    expected = [half + 0.25 * by_weight, half + 0.75 * by_weight]
    assert sorted(c.numpy()[0] for c in p) == pytest.approx(expected, rel=1e-3)


def test_inspect_says_which_emitters_are_asked():
    lamps = {k: emitters()[k] for k in ("point", "sky")}

    def found(scene):
        return inspect._direct_light(prepare(scene, Settings(), False))

    chosen = found(scene_of(lamps))
    assert chosen.needed and chosen.evidence == ["2 emitters in 2 groups"]
    alone = found(scene_of({"sky": lamps["sky"]}))
    assert not alone.needed and alone.consequence == "nothing to choose"


def lit_by(many, ball):
    """A room with boxes of which each lamp lights a part."""
    lamps = {f"lamp_{k}": square(*xy, 0.98, 0.03, 30.0) for k, xy in enumerate(many)}
    cube = {"type": "cube", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    small = mi.ScalarTransform4f().translate([0.3, 0.3, -0.6]).scale(0.3)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 80,
                "to_world": mi.ScalarTransform4f().look_at([0, -0.95, 0], [0, 1, -0.3], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": 32,
                    "height": 32,
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "owen_sobol", "sample_count": 16},
            },
            "room": cube,
            "block": cube | {"to_world": small},
            "ball": {
                "type": "sphere",
                "center": [-0.5, 0.2, -0.7],
                "radius": 0.25,
                "bsdf": ball,
            },
            **lamps,
        }
    )


@pytest.mark.parametrize("map_", ["none", "global", "caustic"])
def test_many_lamps_cost_less_noise_than_in_path(variants_all, monkeypatch, map_):
    """The same picture as path's, and at equal samples half of its noise and less."""
    places = [(x, y) for x in (-0.8, -0.3, 0.3, 0.8) for y in (-0.8, -0.3, 0.3, 0.8)]
    leave_out_the_pilot(monkeypatch)
    ball, passes = {"type": "conductor"}, 16 if mi.is_spectral else 1
    if map_ == "none":
        ball = {"type": "diffuse"}
    scene = lit_by(places, ball)
    ours = mi.load_dict(
        {"type": "aniso_pm", "map": "auto" if map_ == "none" else map_, "passes": passes}
    )
    rivals = {"path": mi.load_dict({"type": "path"}), "ours": ours}
    means, noise = {}, {}
    for name, integrator in rivals.items():
        images = np.array(
            [np.array(mi.render(scene, integrator=integrator, spp=64, seed=k)) for k in range(4)]
        )
        means[name] = images.mean()
        noise[name] = (images.var(0, ddof=1) / (images.mean(0) ** 2 + 1e-3)).mean()
    assert means["ours"] == pytest.approx(means["path"], rel=0.02)
    assert noise["ours"] < 0.5 * noise["path"]


def test_light_that_both_ways_find_counts_once(monkeypatch):
    """Large lamps near rough metal, met by BSDF sampling as often as they are asked."""
    leave_out_the_pilot(monkeypatch)
    lamps = {"left": square(-0.7, 0, -0.4, 0.6, 1.0, 150), "right": square(0.9, 0, -0.3, 0.4, 3.0)}
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.15}}
    floor = {"type": "rectangle", "bsdf": metal}
    floor["to_world"] = mi.ScalarTransform4f().translate([0, 0, -0.99])
    sensor = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, -2, 0.5], [0, 0, -1], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}},
        "sampler": {"type": "owen_sobol", "sample_count": 16},
    }
    scene = scene_of(lamps, metal=floor, sensor=sensor)
    means = {}
    for name in ("aniso_pm", "path"):
        integrator = mi.load_dict({"type": name})
        means[name] = np.array(mi.render(scene, integrator=integrator, spp=1024, seed=1)).mean()
    assert means["aniso_pm"] == pytest.approx(means["path"], rel=0.003)
