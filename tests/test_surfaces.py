"""Which photons and probes lie on the surface of a gather point."""

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.map.photon_word import encode_normal, one_sheet
from rooms import room

pytestmark = pytest.mark.usefixtures("rgb", "without_pilot")


def quadric(curvatures, count=20_000):
    """Points and unit normals of z = (a x² + b y²)/2 around the origin, where it is (0, 0, 1)."""
    random = np.random.default_rng(4)
    x, y = random.uniform(-0.3, 0.3, (2, count))
    a, b = curvatures
    z = 0.5 * (a * x**2 + b * y**2)
    n = np.stack([-a * x, -b * y, np.ones(count)])
    return np.stack([x, y, z]), n / np.linalg.norm(n, axis=0)


def accepted(d, n):
    word = encode_normal(mi.Vector3f(*n.astype(np.float32)))
    up = mi.Vector3f(0, 0, 1)
    return one_sheet(word, up, mi.Vector3f(*d.astype(np.float32)), mi.Float(1e-6)).numpy()


@pytest.mark.parametrize("curvatures", [(0, 0), (1, 0), (-1, -1), (1, -1), (2, 0.5)])
def test_curved_surfaces_are_one(curvatures):
    assert accepted(*quadric(curvatures)).all()


def test_a_sphere_is_one():
    random = np.random.default_rng(2)
    n = random.normal(size=(3, 20_000))
    n /= np.linalg.norm(n, axis=0)
    n = n[:, n[2] > 0.75]
    assert accepted(n - np.array([[0], [0], [1]]), n).all()


@pytest.mark.parametrize("height", [0.02, -0.02])
def test_parallel_sheets_are_two(height):
    d, n = quadric((0, 0))
    near = np.linalg.norm(d, axis=0) < 0.35
    assert not accepted(d + np.array([[0], [0], [height]]), n)[near].any()


# --- In renderings ---


def lamp(size=0.5, height=2.0):
    T = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, height]).rotate([0, 1, 0], 180).scale(size),
        "emitter": {"type": "area"},
    }


def bright_wall():
    """Beside a floor around the origin: what its indirect light comes from."""
    T = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
        "bsdf": {"type": "diffuse", "reflectance": 0.9},
    }


def looking_down(offset=0.0, fov=20):
    T = mi.ScalarTransform4f
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": T().look_at(origin=[offset, -2, 2.5], target=[offset, 0, 0], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
    }


def ratio(definition, radius, seeds=4):
    """Mean of our picture over that of ``path``, and its standard error."""
    scene = mi.load_dict(definition)
    ours = mi.load_dict(
        {"type": "aniso_pm", "map": "global", "photon_count": 200_000, "initial_radius": radius}
    )
    path = mi.load_dict({"type": "path"})
    a = [np.mean(mi.render(scene, integrator=ours, spp=64, seed=s)) for s in range(seeds)]
    b = [np.mean(mi.render(scene, integrator=path, spp=1024, seed=s)) for s in range(seeds)]
    error = np.hypot(np.std(a, ddof=1), np.std(b, ddof=1)) / np.mean(b) / seeds**0.5
    return np.mean(a) / np.mean(b), error


def test_light_under_a_tile_stays_there():
    """A lamp shines under a tile, where light goes to and fro: the tile's upper side, less than
    half a bandwidth above the floor, reads none of these photons."""
    T = mi.ScalarTransform4f
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.8}}
    definition = {
        "type": "scene",
        "sensor": looking_down(fov=6),
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 1, 0.02]).rotate([1, 0, 0], 90).scale([0.5, 0.02, 1]),
            "emitter": {"type": "area", "radiance": 100.0},
        },
        "sky": {"type": "constant", "radiance": 0.1},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 2, 0]).rotate([1, 0, 0], 90)},
        "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": white},
        "tile": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 0.04]).scale(0.35),
            "bsdf": white,
        },
    }
    found, error = ratio(definition, 0.15)
    print(found, error)
    assert abs(found - 1) < 0.015 + 3 * error


def test_glass_over_a_floor_does_not_brighten_it():
    """The floor goes on under a pane: probes that meet the pane first find it all the same."""
    T = mi.ScalarTransform4f
    definition = {
        "type": "scene",
        "sensor": looking_down(fov=12),
        "sky": {"type": "constant"},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 1, 0]).rotate([1, 0, 0], 90)},
        "floor": {"type": "rectangle", "to_world": T().scale(3)},
        "pane": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 0.02]).scale(0.2),
            "bsdf": {"type": "thindielectric"},
        },
    }
    found, error = ratio(definition, 0.15)
    print(found, error)
    assert abs(found - 1) < 0.01 + 3 * error


METAL = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.05}}


@pytest.mark.parametrize(
    "thickness, bsdf",
    [(0, METAL), (0.01, METAL), (0.01, {"type": "diffuse"}), (-0.01, {"type": "diffuse"})],
)
def test_what_lies_on_a_floor_does_not_darken_it(thickness, bsdf):
    """Kernels of the floor beside a sheet or a coin, mirrored or not, reach under it, where no
    photons are."""
    T = mi.ScalarTransform4f
    flat = T().translate([0, 0, 0.001]).scale(0.3)
    thick = T().translate([0, 0, abs(thickness) / 2]).scale([0.3, 0.3, thickness / 2])
    definition = {
        "type": "scene",
        "sensor": looking_down(offset=0.38, fov=2.5),
        "light": {"type": "point", "position": [0.3, 0.5, 1.5]},
        "floor": {"type": "rectangle"},
        "wall": bright_wall(),
        "thing": {
            "type": "cube" if thickness else "rectangle",
            "to_world": thick if thickness else flat,
            "bsdf": bsdf,
        },
    }
    found, error = ratio(definition, 0.15)
    print(found, error)
    assert abs(found - 1) < 0.015 + 3 * error


@pytest.mark.parametrize("bsdf", ["thindielectric", "dielectric", "null"])
def test_a_floor_ends_where_a_pane_begins(bsdf):
    """No photons lie on glass in the plane of the floor."""
    T = mi.ScalarTransform4f
    definition = {
        "type": "scene",
        "sensor": looking_down(offset=-0.04, fov=1.5),
        "light": {"type": "point", "position": [-0.3, 0.5, 1.5]},
        "floor": {"type": "rectangle", "to_world": T().translate([-1, 0, 0])},
        "pane": {
            "type": "rectangle",
            "to_world": T().translate([1, 0, 0]),
            "bsdf": {"type": bsdf},
        },
        "wall": bright_wall(),
    }
    found, error = ratio(definition, 0.15)
    print(found, error)
    assert abs(found - 1) < 0.015 + 3 * error


def test_kernels_of_rough_texels_reach_over_smooth_ones():
    """A metal plate of rough and smooth squares, narrower than a kernel: only the rough ones
    gather, but photons lie on all of them."""
    T = mi.ScalarTransform4f
    chequers = {
        "type": "checkerboard",
        "color0": 0.05,
        "color1": 0.5,
        "to_uv": T().scale([10, 10, 1]),
    }
    definition = {
        "type": "scene",
        "sensor": looking_down(fov=12),
        "light": {"type": "point", "position": [0.3, 0, 1.5]},
        "plate": {
            "type": "rectangle",
            "bsdf": {"type": "twosided", "b": {"type": "roughconductor", "alpha": chequers}},
        },
        "wall": bright_wall(),
    }
    found, error = ratio(definition, 0.15)
    print(found, error)
    assert abs(found - 1) < 0.01 + 3 * error


@pytest.mark.parametrize("mirror", [-1, 1])
def test_bump_maps_of_mirrored_cubes_look_where_those_of_path_do(mirror):
    """They turn their normal to the geometric one, which is on the inside of a mirrored cube: it is
    black from outside."""
    T = mi.ScalarTransform4f
    flat = np.full((2, 2, 1), 0.5, np.float32)
    bump = {"type": "bumpmap", "arbitrary": {"type": "bitmap", "bitmap": mi.Bitmap(flat)}}
    cube = {
        "type": "cube",
        "to_world": T().translate([0, -0.2, -0.2]).rotate([1, 1, 0], 30).scale([mirror * 0.4] * 3),
        "bsdf": bump | {"b": {"type": "diffuse", "reflectance": 0.8}},
    }
    found, error = ratio(room({"cube": cube}, size=16), 0.05)
    print(found, error)
    assert abs(found - 1) < 0.01 + 3 * error


def test_light_goes_straight_through_bump_maps_of_what_is_like_air():
    """The bounce does not turn: it has no normal of its own, from which cosines would follow."""
    flat = np.full((2, 2, 1), 0.5, np.float32)
    bump = {"type": "bumpmap", "arbitrary": {"type": "bitmap", "bitmap": mi.Bitmap(flat)}}
    air = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0}
    ball = {"type": "sphere", "center": [0, -0.2, -0.2], "radius": 0.6, "bsdf": bump | {"b": air}}
    scene = mi.load_dict(room({"ball": ball}, size=16))
    ours = mi.load_dict(
        {"type": "aniso_pm", "map": "global", "photon_count": 20_000, "initial_radius": 0.05}
    )
    mi.render(scene, integrator=ours, spp=16)
    assert ours.statistics["photons_rejected"] == 0
    found, error = ratio(room({"ball": ball}, size=16), 0.05)
    print(found, error)
    assert abs(found - 1) < 0.01 + 3 * error
