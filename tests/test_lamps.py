"""Rays that may meet emitters (``transport.lamps``): none that does is left out."""

from types import SimpleNamespace

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import prepared
from aniso_pm.transport.lamps import Lamps

pytestmark = pytest.mark.usefixtures("rgb")
WHITE = {"type": "diffuse"}


def room(lamps, walls=WHITE):
    """A box around a mirror ball, lit by shapes."""
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, -0.9, 0.1], [0, 1, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}},
        },
        "room": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": walls}},
        "ball": {
            "type": "sphere",
            "center": [-0.3, 0.3, -0.7],
            "radius": 0.3,
            "bsdf": {"type": "conductor"},
        },
    }
    for number, lamp in enumerate(lamps):
        scene[f"lamp_{number}"] = lamp | {
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4, 3, 2]}}
        }
    return mi.load_dict(scene)


def shapes(count, seed=1):
    """Lamps of all kinds, turned and scaled anyhow."""
    rng = np.random.default_rng(seed)
    lamps = []
    for number in range(count):
        kind = ("rectangle", "sphere", "disk", "cylinder", "cube")[number % 5]
        size = rng.uniform(0.02, 0.15, 3)
        if kind in ("sphere", "cylinder"):  # not to be scaled unevenly
            size[:] = size[0]
        to_world = (
            mi.ScalarTransform4f()
            .translate(rng.uniform(-0.8, 0.8, 3).tolist())
            .rotate(rng.normal(size=3).tolist(), float(rng.uniform(0, 360)))
            .scale(size.tolist())
        )
        lamps.append({"type": kind, "to_world": to_world})
    return lamps


def rays_of(count, seed=2):
    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-0.99, 0.99, (3, count)), rng.normal(size=(3, count))
    d[rng.integers(0, 3, count // 4), np.arange(count // 4)] = 0  # along planes of the axes
    return mi.Ray3f(mi.Point3f(o), dr.normalize(mi.Vector3f(d)))


@pytest.mark.parametrize("count", [1, 5, 30])
def test_no_ray_that_meets_an_emitter_is_left_out(count):
    scene = room(shapes(count))
    lamps = Lamps.of(scene)
    assert 1 <= len(lamps.boxes) <= 8
    ray = rays_of(200_000)
    met = scene.ray_intersect(ray).emitter(scene) != None  # noqa: E711 (a Dr.Jit comparison)
    met, may = met.numpy(), lamps.may_meet(ray).numpy()
    assert met.sum() > 100
    assert not (met & ~may).any()
    assert count == 30 or may.mean() < 0.5


def test_boxes_are_those_of_neighbours():
    """Two rows of lamps at two walls: eight boxes, none of which reaches across the room."""
    rows = [
        {
            "type": "sphere",
            "center": [x, y, 0.5],
            "radius": 0.02,
        }
        for x in (-0.9, 0.9)
        for y in np.linspace(-0.8, 0.8, 12)
    ]
    boxes = [np.array([c.numpy().ravel() for c in box]) for box in Lamps.of(room(rows)).boxes]
    assert len(boxes) == 8
    assert max(high[0] - low[0] for low, high in boxes) < 0.05


def test_no_lamps_where_light_comes_from_everywhere():
    sky = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "shape": {"type": "sphere"}})
    assert Lamps.of(sky) is None


def test_no_lamps_where_a_shape_does_not_know_its_bounds(monkeypatch):
    scene = room(shapes(1))
    lost = SimpleNamespace(bbox=mi.ScalarBoundingBox3f, emitter=lambda: object())
    shapes_of = SimpleNamespace(environment=lambda: None, shapes=lambda: [*scene.shapes(), lost])
    assert Lamps.of(shapes_of) is None


def test_nothing_to_meet_where_points_emit():
    spot = mi.load_dict({"type": "scene", "lamp": {"type": "point"}, "shape": {"type": "sphere"}})
    lamps = Lamps.of(spot)
    assert lamps.boxes == ()
    assert not lamps.may_meet(rays_of(10)).numpy().any()


@pytest.mark.parametrize("options", [{"map": "global"}, {"final_gather": True}])
def test_pictures_are_the_same(monkeypatch, variants_all, options):
    """Paths that are not followed would have found nothing."""
    rough = {"type": "roughconductor", "alpha": 0.4}
    walls = {"type": "blendbsdf", "weight": 0.5, "first": WHITE, "second": rough}
    for surface in (WHITE, walls):
        scene = room(shapes(3), surface)
        integrator = mi.load_dict({"type": "aniso_pm", "passes": 2, **options})
        with_ = np.array(mi.render(scene, integrator=integrator, spp=8, seed=1))
        with monkeypatch.context() as changed:
            changed.setattr(prepared.Lamps, "of", staticmethod(lambda scene: None))
            without = np.array(mi.render(scene, integrator=integrator, spp=8, seed=1))
        assert with_.mean() > 0.01
        np.testing.assert_allclose(with_, without, rtol=1e-4, atol=1e-5)
