"""Kernels end at walls that stand on the surface."""

from types import SimpleNamespace

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.kernel import disc
from aniso_pm.map import walls
from rooms import room, wall

pytestmark = pytest.mark.usefixtures("rgb", "without_pilot")
LANES = 64


def standing(x, bsdf=None):
    """A wall at x on the floor z = 0, as high as 1."""
    place = mi.ScalarTransform4f().translate([x, 0, 1]).rotate([0, 1, 0], -90)
    return mi.load_dict(
        {
            "type": "scene",
            "floor": wall(mi.ScalarTransform4f(), [0.5] * 3),
            "wall": wall(place, [0.5] * 3, bsdf),
        }
    )


def beside(scene, passes=None):
    """Walls beside the origin, for kernels of half axes 0.2 that reach to 0.4."""
    n = dr.repeat(mi.Normal3f(0, 0, 1), LANES)
    points = SimpleNamespace(
        p=dr.zeros(mi.Point3f, LANES), n=n, lane=dr.arange(mi.UInt32, LANES), depth=mi.UInt32(1)
    )
    kernel = disc(n, dr.full(mi.Float, 0.2, LANES))
    return walls.nearest(scene, 3, points, kernel, 2.0, mi.Float(0.05), passes)


@pytest.mark.parametrize("x", [0.03, 0.19, -0.1])
def test_a_wall_within_half_of_the_reach_is_always_found(x):
    found = beside(standing(x))
    np.testing.assert_allclose(
        np.array(found.n), [[np.sign(x)] * LANES, [0] * LANES, [0] * LANES], atol=1e-6
    )
    np.testing.assert_allclose(found.c.numpy(), abs(x), atol=1e-6)
    assert found.hides(mi.Vector3f(1.01 * x, 0.3, 0)).numpy().all()
    assert not found.hides(mi.Vector3f(0.99 * x, 0.3, 0)).numpy().any()


def test_what_is_farther_or_lets_light_pass_is_none():
    def glass(bsdf, active):
        return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)

    for found in (beside(standing(0.41)), beside(standing(0.1, {"type": "dielectric"}), glass)):
        assert (np.array(found.n) == 0).all()
        assert not found.hides(mi.Vector3f(5, 0, 0)).numpy().any()
    assert (beside(standing(0.1), glass).n.x > 0.999).numpy().all()


def test_a_dark_room_beside_a_bright_one_stays_dark():
    """The camera is in the dark one; what it sees has come through the wall."""
    scene = room(size=32)
    scene["light"]["to_world"] = (
        mi.ScalarTransform4f().translate([0.65, 0.98, 0]).rotate([1, 0, 0], 90).scale(0.2)
    )
    divider = wall(
        mi.ScalarTransform4f().translate([0.3, 0, 0]).rotate([0, 1, 0], -90), [0.5, 0.5, 0.5]
    )
    scene["divider"] = {**divider, "bsdf": {"type": "twosided", "bsdf": divider["bsdf"]}}
    world = mi.load_dict(scene)

    def leaked(**given):
        plugin = {"type": "aniso_pm", "map": "global", "initial_radius": 0.1, "passes": 1} | given
        return float(np.mean(mi.render(world, integrator=mi.load_dict(plugin), spp=16)))

    through = leaked(edge_compensation=False)
    assert through > 1e-4  # or there is nothing to keep out
    assert leaked() < 0.1 * through  # three rays miss some that are far
