"""Indirect light against converged ``path``, in the mean over the image and over each region.

The reference values (tests/rooms.json) are made by ``python tests/energy.py``; their standard
errors are far below those of the renders here.
"""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
from conftest import slow
from energy import REFERENCE, indirect, region_means
from rooms import ROOMS
from rooms import room as empty_room

# Small against the room (2 units): kernel blur moves light by less than the tolerance.
PHOTON_MAPPER = {"type": "aniso_pm", "map": "global", "initial_radius": 0.01, "alpha": 1.0}
KERNELS = {
    "isotropic": {"kernel": "isotropic"},
    "lobe": {"rule": "lobe"},
    "taylor": {"rule": "taylor"},
    "paper": {"rule": "paper"},
    "paper-unguarded": {"rule": "paper", "guard": False},
    "epsilon-sized": {"rule": "taylor", "size": "epsilon"},
}


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def assert_agrees(room, kernel, max_depth, photon_count, passes, spp, seeds, tolerance):
    """Every region's mean within ``tolerance`` of the reference, at a standard error of less than
    a third of that."""
    scene = mi.load_dict(ROOMS[room]())
    integrator = PHOTON_MAPPER | KERNELS[kernel] | {"photon_count": photon_count, "passes": passes}
    expected = json.loads(REFERENCE.read_text())[room][str(max_depth)]
    found = region_means(scene, integrator, max_depth, spp, seeds)
    report = []
    for name, (mean, error) in found.items():
        reference, reference_error = expected[name]
        if reference < 1e-3:
            assert mean == pytest.approx(reference, abs=2e-3)
            continue
        ratio, sigma = mean / reference, math.hypot(error, reference_error) / reference
        report.append(f"{name}: {ratio:.4f} ± {sigma:.4f}")
        assert sigma < 0.3 * tolerance, report
        assert abs(ratio - 1) < tolerance, report
    print(room, kernel, max_depth, "; ".join(report))


@pytest.mark.parametrize("room", ROOMS)
def test_indirect_light_agrees_with_path(room):
    # The glass ball mirrors the light itself: a small bright spot that only eye paths resolve.
    spp, tolerance = (512, 0.05) if room == "ball" else (64, 0.03)
    assert_agrees(room, "lobe", -1, 200_000, 4, spp, range(6), tolerance)


@pytest.mark.usefixtures("without_pilot")
@pytest.mark.parametrize("depth", [2, 3, *slow(1, 4)])
def test_max_depth_means_what_it_means_to_path(depth):
    assert_agrees("plate", "lobe", depth, 200_000, 2, 64, range(6), 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("room", ROOMS)
def test_indirect_light_agrees_with_path_within_one_percent(room, kernel):
    if room != "plate" and kernel != "isotropic":
        pytest.skip("nothing anisotropic in this room: the same kernels as with isotropic")
    spp = 8192 if room == "ball" else 512
    assert_agrees(room, kernel, -1, 400_000, 16, spp, range(6), 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("room", ROOMS)
def test_every_max_depth_agrees_within_one_percent(room, depth):
    spp, passes = 256, 8
    if room == "ball":  # few bright eye paths at depth 2, from there on few bright photons
        spp, passes = (16_384, 8) if depth <= 2 else (4096, 48)
    assert_agrees(room, "lobe", depth, 400_000, passes, spp, range(6), 0.01)


# --- Other materials: receivers or not, every light path is counted exactly once ---

TILES = REFERENCE.parents[1] / "scenes" / "textures" / "tiles.png"
OBJECTS = {
    "plastic": {"type": "plastic"},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2},
    "principled": {"type": "principled", "roughness": 0.4, "anisotropic": 0.8, "metallic": 0.7},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    "thindielectric": {"type": "thindielectric"},
    "mask": {
        "type": "mask",
        "opacity": 0.4,
        "bsdf": {"type": "twosided", "b": {"type": "diffuse"}},
    },
    "blend": {
        "type": "blendbsdf",
        "weight": 0.3,
        "a": {"type": "diffuse"},
        "b": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4},
    },
    "bumped diffuse": {
        "type": "bumpmap",
        "scale": 0.1,
        "texture": {"type": "bitmap", "filename": str(TILES), "raw": True},
        "bsdf": {"type": "diffuse"},
    },
    "asgconductor": {"type": "asgconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3},
}
OTHERS = sorted(OBJECTS.keys() - {"roughplastic"})


# One of each kind for every run of the tests. A conductor and a mixture show what instances do.
@pytest.mark.usefixtures("without_pilot")
@pytest.mark.parametrize(
    "name, instanced",
    [
        ("roughplastic", False),
        ("asgconductor", True),
        *slow(*((name, False) for name in OTHERS)),
        *slow(("blend", True)),
    ],
)
def test_indirect_light_agrees_with_path_around(name, instanced):
    ball = {"type": "sphere", "center": [0, -0.3, -0.2], "radius": 0.5, "bsdf": OBJECTS[name]}
    parts = {"ball": ball}
    if instanced:
        parts = {
            "group": {"type": "shapegroup", "ball": ball},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    scene = mi.load_dict(empty_room(parts, size=24))
    # Mitsuba's own integrators differ by 3 % around a mask: prb and ours against path.
    reference = {"type": "prb", "max_depth": -1} if name == "mask" else {"type": "path"}
    assert_mean_agrees(scene, 0.02, reference=reference)


def assert_mean_agrees(scene, tolerance, spp=512, reference_spp=2048, reference=None):
    """Indirect light in the mean over the image; standard errors of both are below 0.5 %."""
    ours = PHOTON_MAPPER | {"photon_count": 100_000, "passes": 16}
    ours = indirect(scene, ours, -1, spp, 1).mean()
    expected = indirect(scene, reference or {"type": "path"}, -1, reference_spp, 2).mean()
    assert ours == pytest.approx(expected, rel=tolerance)


@pytest.mark.usefixtures("without_pilot")
@pytest.mark.parametrize(
    "emitter",
    [
        "point",
        "sphere",
        *slow("spot", "directional", "constant"),
    ],
)
def test_every_kind_of_light_reaches_merged_walls(emitter):
    """Floor and wall share a BSDF, so Mitsuba merges them, and forgets how large they are."""
    T = mi.ScalarTransform4f
    light = {
        "point": {"type": "point", "position": [0.5, 1.5, 0.5]},
        "spot": {
            "type": "spot",
            "cutoff_angle": 40,
            "to_world": T().look_at([1, 2, 2], [0, 0.2, 0], [0, 1, 0]),
        },
        "directional": {"type": "directional", "direction": [-0.4, -1, -0.6]},
        "constant": {"type": "constant"},
        "sphere": {
            "type": "sphere",
            "center": [0.5, 1.5, 0.5],
            "radius": 0.2,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
        },
    }[emitter]
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": T().look_at([1.5, 1.2, 3], [0, 0.4, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 24,
                    "height": 24,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
            },
            "grey": {"type": "twosided", "b": {"type": "diffuse", "reflectance": 0.7}},
            "floor": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90),
                "bsdf": {"type": "ref", "id": "grey"},
            },
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, -1]),
                "bsdf": {"type": "ref", "id": "grey"},
            },
            "light": light,
        }
    )
    # Most light paths miss these two walls: over 8 seeds these 1.6 million scatter by 0.3 (point)
    # and 0.4 % (constant), path by 0.3 %. Four standard errors are tolerated.
    assert_mean_agrees(scene, 0.02, spp=1024)


def test_smooth_shaded_glass_loses_no_light():
    """A coarse mesh with interpolated normals: shading and geometric sides often disagree."""
    import numpy as np

    theta, phi = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 8), np.arange(10) * 2 * np.pi / 10)
    normals = np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1
    )
    i, j = np.meshgrid(np.arange(10), np.arange(7), indexing="ij")
    at = lambda a, b: ((a % 10) * 8 + b).ravel()  # noqa: E731
    faces = np.concatenate(
        [
            np.stack([at(i, j), at(i + 1, j), at(i, j + 1)], -1),
            np.stack([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], -1),
        ]
    )
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "dielectric"})
    mesh = mi.Mesh("ball", 80, len(faces), has_vertex_normals=True, props=props)
    parameters = mi.traverse(mesh)
    flat = normals.reshape(-1, 3).astype(np.float32)
    parameters["vertex_positions"] = (0.45 * flat + np.float32([0, -0.3, -0.2])).ravel()
    parameters["vertex_normals"] = flat.ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    assert_mean_agrees(mi.load_dict(empty_room({"ball": mesh}, size=24)), 0.02)


# --- Closed forms: no reference needed, no noise to speak of ---


def furnace(edge_compensation, albedo=0.5, radius=0.2):
    """Inside a cube that emits radiance 1 and reflects ``albedo``, every ray sees
    1/(1 − albedo), in its corners too."""
    T = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aniso_pm",
                "map": "global",
                "initial_radius": radius,
                "photon_count": 200_000,
                "edge_compensation": edge_compensation,
            },
            "sensor": {
                "type": "perspective",
                "fov": 80,
                "to_world": T().look_at(origin=[-0.9, -0.8, -0.7], target=[1, 1, 1], up=[0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 32,
                    "height": 32,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
            },
            "box": {
                "type": "cube",
                "flip_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
            },
        }
    )


def test_a_furnace_is_uniform_up_to_its_edges():
    image = np.array(mi.render(furnace(True), spp=256))
    assert image.mean() == pytest.approx(2, rel=0.01)
    # The camera looks into a corner: without compensation its pixels lose up to 3/4 of the
    # indirect half. What is left is the noise of some 100 photons a kernel, the same in all
    # samples of a pixel.
    assert image.min() > 1.8 and image.max() < 2.25


def test_edges_are_dark_without_compensation():
    """Spilling over one straight edge leaves Φ(x√2/r) of the light: the test above can fail."""
    image = np.array(mi.render(furnace(False), spp=64))
    assert image.mean() < 1.975
    assert image.min() < 1.75


def test_kernel_normalisation_is_exact_on_a_curved_surface():
    """Inside an emitting sphere: no edges, but the surface bends away from every kernel."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aniso_pm",
                "map": "global",
                "initial_radius": 0.05,
                "photon_count": 300_000,
            },
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "film": {
                    "type": "hdrfilm",
                    "width": 24,
                    "height": 24,
                    "component_format": "float32",
                },
            },
            "ball": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
            },
        }
    )
    image = mi.render(scene, spp=64)
    # 3e5 photons of equal flux over the sphere: 0.3 % in the mean over the part that is seen.
    assert np.array(image).mean() == pytest.approx(2, rel=0.01)


@pytest.mark.usefixtures("without_pilot")
@pytest.mark.parametrize(
    "use",
    [
        {},
        *slow({"map": "caustic"}, {"final_gather": True}),
    ],
)
def test_a_mirror_that_sees_a_caustic_of_a_point_light(use):
    """Spot → mirror A → floor → mirror B → camera, which no path tracer finds. The light seems to
    come from the spot's image S' = (−2, 1, 0) behind A, so that the floor at p has the radiance
    ρ/π · I (S'_y) / |S' − p|³, and B shows the floor mirrored at z = −1."""
    T = mi.ScalarTransform4f
    mirror = {"type": "conductor"}  # reflects everything
    size, albedo, intensity = 16, 0.5, 10.0
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 2,
                "to_world": T().look_at([0.3, 0.5, 0.8], [0, 0, -2], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
            },
            "floor": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90).scale(3),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
            },
            "A": {
                "type": "rectangle",
                "to_world": T().translate([-1, 0.5, 0]).rotate([0, 1, 0], 90).scale(0.5),
                "bsdf": mirror,
            },
            "B": {
                "type": "rectangle",
                "to_world": T().translate([0.1, 0.3, -1]).scale(0.3),
                "bsdf": mirror,
            },
            "spot": {
                "type": "spot",
                "to_world": T().look_at([0, 1, 0], [-1, 0.5, 0], [0, 0, 1]),
                "cutoff_angle": 20,
                "beam_width": 20,
                "intensity": {"type": "rgb", "value": intensity},
            },
        }
    )
    sensor = scene.sensors()[0]
    lane = np.arange(size * size)
    centre = mi.Point2f((lane % size + 0.5) / size, (lane // size + 0.5) / size)
    ray, _ = sensor.sample_ray(0, 0.5, centre, mi.Point2f(0.5))
    o, d = ray.o.numpy(), ray.d.numpy()
    floor = o - d * (o[1] / d[1])  # seen in B: the floor's mirror image
    floor[2] = -2 - floor[2]
    distance = np.linalg.norm(np.array([[-2], [1], [0]]) - floor, axis=0)
    expected = (albedo / np.pi * intensity / distance**3).reshape(size, size)

    plugin = mi.load_dict(
        {
            "type": "aniso_pm",
            "photon_count": 500_000,
            "passes": 8,
            "initial_radius": 0.02,
            "alpha": 1.0,
        }
        | use
    )
    image = np.array(mi.render(scene, integrator=plugin, spp=64), dtype=np.float64)[..., 0]
    assert image.mean() == pytest.approx(expected.mean(), rel=0.01)
    np.testing.assert_allclose(image, expected, rtol=0.15)
