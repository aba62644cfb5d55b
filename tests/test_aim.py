"""Aimed light paths carry the same light as even ones, with the noise that was promised."""

from dataclasses import replace

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.map import density
from aniso_pm.map.gather_points import take
from aniso_pm.rendering import pilot
from aniso_pm.rendering.film import rays_through
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from aniso_pm.transport import aim
from conftest import slow


def learned(score, numbers=None, work=None, paths=40_000):
    """From two maps whose paths score as ``score`` says of their numbers."""
    random = np.random.default_rng(5)
    numbers = random.random((2, paths, 5)) if numbers is None else numbers
    work = np.ones((2, paths)) if work is None else work
    return aim.learn(numbers, score(numbers), work, np.zeros((2, paths)) + work)


def inside(numbers):
    """Is the path one of the 1/32 that matter?"""
    return ((numbers[..., 1] > 0.75) & (numbers[..., 2] < 0.25) & (numbers[..., 4] > 0.5)) * 1.0


def box_of(found, points):
    hit = (points[:, None] >= found.low) & (points[:, None] < found.low + found.size)
    return hit.all(2)


def test_boxes_cover_the_cube_once():
    found = learned(lambda u: inside(u) * u[..., 0])
    points = np.random.default_rng(1).random((5000, 5))
    assert (box_of(found, points).sum(1) == 1).all()
    assert found.size.prod(1).sum() == pytest.approx(1)
    assert found.chance.sum() == pytest.approx(1)
    assert (found.size.prod(1) / found.chance).max() < 1 / aim._EVEN + 1e-9


def test_the_best_aim_is_found_where_it_is_known():
    """A share s of the paths counts, all alike: at best variance s of what even ones have, but for
    the tenth that stays even, and for what boxes beside it get on trust; work is the same."""
    found = learned(inside)
    assert len(found.low) < 40
    share = (1 - aim._EVEN) + aim._EVEN / 32  # of the paths
    assert 0.99 < found.variance / (1 / 32 / share) < 2
    assert found.work == pytest.approx(1)


def test_dear_paths_are_taken_less_often(monkeypatch):
    """q = 1 everywhere, c = 9 in one half: p ∝ 1/√c there, hence 0.75 and 0.25."""
    random = np.random.default_rng(5)
    numbers = random.random((2, 40_000, 5))
    work = np.where(numbers[..., 3] < 0.5, 9.0, 1.0)
    score = lambda u: np.ones(u.shape[:-1])  # noqa: E731
    monkeypatch.setattr(aim, "_WORTH", 2.0)
    found = learned(score, numbers, work)
    dear = found.chance[(found.low[:, 3] < 0.5) & (found.size[:, 3] <= 0.5)].sum()
    assert dear == pytest.approx(0.9 * 0.25 + 0.1 * 0.5, abs=0.02)
    even = 0.5 * (1 + 9)
    assert found.work == pytest.approx((dear * 9 + (1 - dear)) / even, rel=0.03)
    assert found.variance == pytest.approx(0.25 / dear + 0.25 / (1 - dear), rel=0.03)


@pytest.mark.parametrize("rare", [False, True])
def test_nothing_is_aimed_where_that_does_not_pay(rare):
    """Scores that numbers do not tell, frequent or rare."""
    random = np.random.default_rng(7)
    score = lambda u: (random.random(u.shape[:-1]) < 1e-3) * 1.0  # noqa: E731
    even = lambda u: np.ones(u.shape[:-1])  # noqa: E731
    assert learned(score if rare else even) is None
    assert learned(lambda u: np.zeros(u.shape[:-1])) is None


def test_the_promise_holds_for_other_paths():
    """Scores with a heavy tail: what one half of the pilot says of the other is true of more."""
    random = np.random.default_rng(9)

    def score(u):
        return inside(u) * random.pareto(2.5, u.shape[:-1]) + 0.01

    found = learned(score, paths=100_000)
    fresh = random.random((200_000, 5))
    box = box_of(found, fresh[:20_000]).argmax(1)
    q = score(fresh[:20_000])
    weight = found.size.prod(1) / found.chance
    assert (q * weight[box]).sum() / q.sum() == pytest.approx(found.variance, rel=0.15)


# --- In a scene ---


def scene(light):
    """A small glass ball over a plate, which little of the light ever meets."""
    T = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 25,
                "to_world": T().look_at(origin=[0, 3, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 32, "height": 24},
            },
            "light": light,
            "far": {
                "type": "rectangle",
                "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(8),
            },
            "plate": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(0.7)},
            "ball": {
                "type": "sphere",
                "center": [0, 0.4, 0],
                "radius": 0.3,
                "bsdf": {"type": "dielectric"},
            },
        }
    )


def lights():
    T = mi.ScalarTransform4f
    down = T().translate([1, 4, 1]).rotate([1, 0, 0], 90).scale(0.3)
    return {
        "area": {"type": "rectangle", "to_world": down, "emitter": {"type": "area"}},
        "point": {"type": "point", "position": [1, 3, 1]},
        "constant": {"type": "constant"},
        "sunsky": {"type": "sunsky"},
        "directional": {"type": "directional", "direction": [0.3, -1, 0.2]},
    }


def found_in(name, seed=0, map_="global"):
    world = scene(lights()[name])
    prepared = prepare(world, Settings(map=map_), False)
    settled = pilot.settle(prepared, world.sensors()[0], seed, 16)
    return world, prepared, settled


@pytest.mark.parametrize(
    "name",
    [
        "area",
        "sunsky",
        *slow("point", "constant", "directional"),
    ],
)
def test_the_same_light_arrives(variant_llvm_rgb, name):
    world, prepared, settled = found_in(name)
    assert settled.aim is not None and settled.aim.variance * settled.aim.work < 0.7
    even = replace(prepared.with_(photon_count=100_000), chosen="global")
    aimed = replace(even.focused(settled.focus), aim=settled.aim.aim())

    def power(scene, seed):
        """Of all photons, and of those on the plate."""
        map_ = scene.photon_map(seed, 0)
        point = dr.gather(mi.Vector4f, map_.index.points, dr.arange(mi.UInt32, map_.stored))
        flux = np.array(map_.flux).reshape(-1, 4)[: map_.stored, :3].mean(1) / map_.emitted
        plate = (np.abs(np.array(point.y)) < 1e-3).astype(np.float64)
        return np.array([flux.sum(), (flux * plate).sum()])

    a, b = (np.array([power(s, k) for k in range(8)]) for s in (even, aimed))
    error = np.hypot(a.std(0, ddof=1), b.std(0, ddof=1)) / 8**0.5
    print(a.mean(0), b.mean(0) / a.mean(0), error / a.mean(0))
    assert (np.abs(a.mean(0) - b.mean(0)) < 4 * error).all()
    # On the plate there is less noise than without.
    assert b[:, 1].std() < a[:, 1].std()


def test_noise_is_what_the_pilot_promises(variant_llvm_rgb):
    """Of radiance where eye paths gather, over maps of many seeds."""
    world, prepared, settled = found_in("area")
    even = replace(prepared.with_(photon_count=20_000), chosen="global")
    sensor = world.sensors()[0]
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 2048)
    ray, _ = rays_through(sensor, sampler, sampler.next_2d() * mi.Point2f(32, 24), 0.5)
    points = even.trace(sampler, ray)[2]

    def noise(scene):
        found = []
        for seed in range(24):
            map_ = scene.photon_map(seed, 0)
            L, _ = density.estimate(
                map_, points, density.disc(points.n, mi.Float(0.15)), mi.Float(0.15), 0, True
            )
            found.append(np.array(L).mean(0))
        found = np.array(found)
        return (found.var(0, ddof=1) / (found.mean() ** 2 + found.mean(0) ** 2)).mean()

    ratio = noise(replace(even, aim=settled.aim.aim())) / noise(even)
    print(ratio, settled.aim.gains())
    # Photons of one path that meet in one pixel are no part of the promise.
    assert 0.7 < ratio / settled.aim.variance < 3 and ratio < 0.25


def test_scores_are_squares_of_what_photons_give(variant_llvm_rgb):
    """At one gather point: the roots of the scores add up to its radiance (all light is white)."""
    world, prepared, _ = found_in("area")
    even = replace(prepared.with_(photon_count=20_000), chosen="global")
    map_ = even.photon_map(0, 0, remember=True)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    ray, _ = rays_through(world.sensors()[0], sampler, mi.Point2f(16, 14), 0.5)
    points = take(even.trace(sampler, ray)[2], mi.UInt32(0))
    column = dr.zeros(mi.Float, map_.stored)
    disc, r = density.disc(points.n, mi.Float(0.2)), mi.Float(0.2)
    L, count = density.estimate(map_, points, disc, r, 0, True, scores=(column, mi.Float(9.0)))
    dr.eval(L, column)
    score = np.array(column)
    assert (score > 0).sum() == int(count[0]) > 20
    assert np.sqrt(score / 9).sum() == pytest.approx(float(np.array(L).mean()), rel=1e-4)
    assert map_.origins.numbers.shape == (20_000, 5)
    assert int(np.array(map_.origins.path).max()) < 20_000


def test_a_shorter_last_wavefront_is_aimed_as_the_others_are(variant_llvm_rgb):
    """Light paths that are replayed in three wavefronts, of 4000, 4000 and 2000."""
    _, prepared, settled = found_in("area")
    scene = replace(prepared.with_(photon_count=10_000), chosen="global", aim=settled.aim.aim())
    whole = scene.photon_map(3, 0).stored
    parts = replace(scene.frozen(), light_wavefront=4000)
    for index in range(3):
        assert parts.photon_map(3, index).stored == pytest.approx(whole, rel=0.03)
