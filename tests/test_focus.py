"""Light from outside that is begun above what the camera sees is the same light."""

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.transport.focus import Discs, Focus, find

pytestmark = pytest.mark.usefixtures("rgb")


def discs(radius=0.01, centre=(0.3, -0.2, 0.4)):
    return Discs.of(Focus(centre, radius), mi.Point3f(0), dr.opaque(mi.Float, 1.0))


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.6, -0.48, 0.64)])
@pytest.mark.parametrize("radius", [0.3, 0.01, 1e-4])
def test_the_whole_disc_is_lit_evenly(radius, direction):
    """Weights over the sectors of rings around the small disc, against their areas."""
    made, count = discs(radius), 1 << 20
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    d = mi.Vector3f(*direction)
    across, weight = made.sample(sampler.next_2d(), d)
    assert dr.max(dr.abs(dr.dot(across, d)))[0] < 1e-6
    aside = dr.norm(made.offset - d * dr.dot(made.offset, d))[0]
    distance = dr.norm(across - (made.offset - d * dr.dot(made.offset, d))).numpy()
    weight = weight.numpy()
    # Rings that lie within the whole disc.
    edges = np.geomspace(0.5 * radius, 1 - aside, 8)
    for low, high in zip([0, *edges[:-1]], edges, strict=True):
        given = np.where((low <= distance) & (distance < high), weight, 0)
        error = given.std() / count**0.5
        assert given.mean() == pytest.approx(high**2 - low**2, abs=4 * error)
        assert error < 0.02 * (high**2 - low**2)
    whole = np.where(dr.norm(across).numpy() <= 1, weight, 0)
    assert whole.mean() == pytest.approx(1, abs=4 * whole.std() / count**0.5)


def test_light_above_what_is_seen_has_the_smallest_weight():
    made = discs(0.01)
    _, weight = made.sample(mi.Point2f([0.1, 0.4, 0.99], [0.5, 0.5, 0.5]), mi.Vector3f(0, 0, 1))
    assert weight[0] == pytest.approx(made.weight, rel=0.01) == weight[1]
    assert made.weight < 1e-3 and weight[2] > 0.1


@pytest.mark.parametrize("radius", [0.01, 1e-4, 1e-6])
def test_its_weight_is_even_however_numbers_are_rounded(radius):
    made, count = discs(radius), 1 << 16
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    u = sampler.next_2d()
    u.x *= 0.5  # the first disc
    _, weight = made.sample(u, mi.Vector3f(0, 0, 1))
    np.testing.assert_allclose(weight.numpy(), made.weight, rtol=1e-4)


def test_what_most_paths_read_is_found():
    random = np.random.default_rng(0)
    near = random.normal((5, 1, 0), 1, (900, 3))
    far = random.normal(0, 300, (100, 3))
    focus = find(np.concatenate([near, far]), 500.0)
    assert np.allclose(focus.centre, (5, 1, 0), atol=0.3) and 1.5 < focus.radius < 5
    assert find(near, 5.0) is None and find(near[:10], 500.0) is None


# --- In renderings ---


def plain(light, ball, extent=500.0, **more):
    """Two balls on a wide plain."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T().look_at(origin=[0, 2, 6], target=[0, 0.5, 0], up=[0, 1, 0])
    ground = T().rotate([1, 0, 0], -90).scale(extent)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
            "ground": {"type": "rectangle", "to_world": ground},
            "light": light,
            "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "bsdf": ball},
            "other": {"type": "sphere", "center": [1.2, 0.5, 1], "radius": 0.5},
        }
        | more
    )


def means(scene, spp=64, **ours):
    integrator = mi.load_dict({"type": "aniso_pm", **ours})
    found = [mi.render(scene, integrator=integrator, spp=spp, seed=k) for k in range(3)]
    path = mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096)
    ratios = [np.mean(image) / np.mean(path) for image in found]
    return np.mean(ratios), np.std(ratios, ddof=1) / 3**0.5, np.mean(path)


def test_a_sky_over_a_wide_plain_agrees_with_path():
    sky = {"type": "constant", "radiance": 0.7}
    scene = plain(sky, {"type": "roughconductor", "alpha": 0.1})
    ratio, error, _ = means(scene, map="global", photon_count=400_000)
    print(ratio, error)
    assert abs(ratio - 1) < 0.005 + 3 * error


def test_a_sun_makes_the_same_caustic_on_a_plain_of_any_size():
    """``path`` has no way to find it: what there is more light in ours."""
    sun = {"type": "directional", "direction": [0.4, -1, 0.1], "irradiance": 2.0}
    ours = {"map": "caustic", "photon_count": 400_000, "initial_radius": 0.1}
    found = []
    for extent in (20.0, 2000.0):
        ratio, error, mean = means(plain(sun, {"type": "dielectric"}, extent), 256, **ours)
        found.append(((ratio - 1) * mean, error * mean))
    (small, a), (large, b) = found
    print(found)
    assert small > 0.005 and abs(large / small - 1) < 0.03 + 3 * np.hypot(a, b) / small


@pytest.mark.parametrize("light, looked_for", [("constant", True), ("point", False)])
def test_only_light_from_outside_is_begun_elsewhere(light, looked_for):
    integrator = mi.load_dict({"type": "aniso_pm", "map": "global", "photon_count": 100_000})
    mi.render(plain({"type": light}, {"type": "conductor"}), integrator=integrator, spp=1)
    focus = integrator.statistics["focus"]
    assert bool(focus) == looked_for and (not focus or focus["radius"] < 20)
    assert not looked_for or integrator.statistics["photons_stored"] > 100


def test_light_is_begun_above_what_is_seen_through_a_window():
    T = mi.ScalarTransform4f
    pane = T().look_at(origin=[0, 1.95, 5.8], target=[0, 2, 6], up=[0, 1, 0]).scale(0.3)
    window = {"type": "rectangle", "to_world": pane, "bsdf": {"type": "thindielectric"}}
    found = []
    for more in ({}, {"window": window}):
        integrator = mi.load_dict({"type": "aniso_pm", "map": "global", "photon_count": 100_000})
        scene = plain({"type": "constant"}, {"type": "diffuse"}, **more)
        mi.render(scene, integrator=integrator, spp=1)
        found.append(integrator.statistics["focus"]["radius"])
    print(found)
    assert found[1] == pytest.approx(found[0], rel=0.2)


def test_a_map_without_photons_is_told(capfd):
    integrator = mi.load_dict({"type": "aniso_pm", "map": "global", "photon_count": 10})
    dark = {"type": "point", "position": [0, -1, 0]}
    mi.render(plain(dark, {"type": "conductor"}), integrator=integrator, spp=1)
    assert "none of 10 light paths left a photon" in "".join(capfd.readouterr())
