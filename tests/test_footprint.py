"""Kernels as wide as pixels where many passes share the picture; some eye paths gather for all."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import footprint
from aniso_pm.rendering.allotment import Allotment
from aniso_pm.transport.thinning import Thinning
from rooms import room, room_with_ball


def camera(kind="perspective", **more):
    film = {"type": "hdrfilm", "width": 100, "height": 80}
    return mi.load_dict({"type": kind, "film": film} | more)


def late(found):
    """In a late pass of many."""
    return found.in_pass(10**6)


def shares(found, distances):
    return found.share(mi.Float(distances), mi.UInt32(0)).numpy()


def test_footprint_of_a_perspective_camera_is_the_pixels_angle_times_the_path(variant_llvm_rgb):
    sensor = camera(fov=40, fov_axis="x")
    found = late(footprint.of(sensor, radius=0.5, widths=1.75))
    pixel = 2 * np.tan(np.radians(20)) / 100
    wanted = np.clip(1.75 * pixel * np.array([1.0, 10, 20, 100]) / 0.5, 0, 4)
    # angle against tangent; paths begin at the near plane, where a pixel is this wide
    found = shares(found, [1, 10, 20, 100])
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1.75 * 0.011 * pixel / 0.5)


def test_footprint_of_an_orthographic_camera_is_its_pixels_width(variant_llvm_rgb):
    to_world = mi.ScalarTransform4f().scale([3, 3, 1])
    sensor = camera("orthographic", to_world=to_world)
    # 6 world units by 100 pixels, as wide after any path
    found = late(footprint.of(sensor, radius=0.2, widths=2.0))
    np.testing.assert_allclose(shares(found, [0, 1, 50]), 0.6, rtol=1e-3)


def test_every_pixel_has_its_own_width(variant_llvm_rgb):
    to_world = mi.ScalarTransform4f().scale([3, 3, 1])
    widths = np.linspace(1, 8, 8000)
    found = late(footprint.of(camera("orthographic", to_world=to_world), 10.0, widths))
    found = found.seen_by(mi.UInt32([7999, 17, 4000]))
    share = found.share(mi.Float(1), mi.UInt32([1, 0, 2, 1])).numpy()
    np.testing.assert_allclose(share, 0.006 * widths[[17, 7999, 4000, 17]], rtol=1e-3)


def test_kernels_are_never_wider_than_four_bandwidths_nor_narrower_than_passes_allow(
    variant_llvm_rgb,
):
    found = footprint.of(camera(), 1.0, 1e-3)
    for least, index in ((1 / 16, 0), (1 / 16, 15), (1 / 17, 16), (1 / 100, 99)):
        np.testing.assert_allclose(shares(found.in_pass(index), [100]), least, rtol=1e-6)
    # Nor is a kernel wider than eight pixels for that reason.
    one = shares(late(footprint.of(camera(), 1.0)), [0.5])
    np.testing.assert_allclose(shares(found.in_pass(0), [0.5]), footprint.TRIED * one, rtol=1e-5)
    wide = footprint.of(camera(), 1e-6).in_pass(0)
    np.testing.assert_allclose(shares(wide, [100]), 4)
    eight = shares(footprint.of(camera(), 1.0, 8.0).in_pass(0), [20])
    many = footprint.of(camera(), 1.0, 32.0).in_pass(0)
    tried = many.share(mi.Float(20), mi.UInt32(0), footprint.TRIED)
    np.testing.assert_allclose(tried.numpy(), eight)


PIXELS = 4096


def chosen(share, of, index):
    """(chosen, weights) of PIXELS pixels' samples in a pass."""
    lane, each = dr.arange(mi.UInt32, PIXELS * of), dr.full(mi.Float, share, PIXELS)
    number = dr.opaque(mi.UInt32, of, PIXELS * of)
    thinning = Thinning.of_pass(each, 5 + index, lane // of, lane % of, number)
    return (found.numpy().reshape(PIXELS, of) for found in thinning.chosen())


@pytest.mark.parametrize("of", [1, 3, 16, 27])
@pytest.mark.parametrize("share", [0.125, 0.25, 0.6, 1.0])
def test_gathers_of_a_pixel_stand_for_its_samples(variant_llvm_rgb, share, of):
    made = np.zeros((8, PIXELS))
    for index in range(8):
        gathers, weight = chosen(share, of, index)
        made[index] = gathers.sum(1)
        # Each sample with the same chance: five standard deviations of 4096 draws.
        spread = 5 * (share * (1 - share) / PIXELS) ** 0.5
        assert (abs(gathers.mean(0) - share) <= spread).all()
        stood_for = (gathers * weight).sum(1)
        if of * share >= 1:  # for all samples, in every pixel and every pass
            np.testing.assert_allclose(stood_for, of, rtol=1e-6)
        else:
            np.testing.assert_allclose(stood_for.mean(), of, rtol=5 * (1 / share / PIXELS) ** 0.5)
    assert (abs(made - share * of) < 1).all()
    spread = 5 * (0.25 / made.size) ** 0.5
    assert abs(made.mean() - share * of) < spread


def test_gathers_of_a_pixel_are_consecutive_samples(variant_llvm_rgb):
    """Which makes them stratified; behind the last one comes the first."""
    gathers, _ = chosen(0.25, 27, 3)
    begins = gathers & ~np.roll(gathers, 1, axis=1)
    assert (begins.sum(1) == 1).all()


def test_a_choice_does_not_depend_on_wavefronts(variant_llvm_rgb):
    counts = np.arange(1, 61).repeat(4)
    for allotment in (Allotment(240, 30, None), Allotment(240, 30, counts)):
        found = []
        for most in (10**6, 2000):
            made = np.zeros((240, 60))
            for lanes, _ in allotment.wavefronts(3, 0, 0, most):
                share = dr.full(mi.Float, 0.3, 240)
                numbers = lanes.pixel, lanes.place, lanes.of
                gathers, weight = Thinning.of_pass(share, 5, *numbers).chosen()
                pixel, place = lanes.pixel.numpy(), lanes.place.numpy()
                made[pixel, place] = dr.select(gathers, weight, 0).numpy()
                of = np.full(240, 30) if allotment.counts is None else counts
                np.testing.assert_array_equal(lanes.sample.numpy(), 3 * of[pixel] + place)
            found.append(made)
        np.testing.assert_array_equal(*found)
        enough = of * 0.3 >= 1
        np.testing.assert_allclose(found[0].sum(1)[enough], of[enough], rtol=1e-6)


def test_thinned_gathers_have_the_same_mean(variant_llvm_rgb):
    """Eight passes with few gathers against the same with a gather for every eye path."""
    scene = mi.load_dict(room_with_ball(size=24))

    def mean(spp, **parameters):
        plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "passes": 4, **parameters})
        image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=2), dtype=np.float64)
        return image.mean(), plugin.statistics

    few, thinned = mean(4 * 64, photon_count=400_000)  # each gather meets many
    all_, full = mean(4 * 2)
    assert thinned["share_of_gathers"] < 0.5 < 0.8 < full["share_of_gathers"]
    assert thinned["gather_points"] < thinned["eye_samples"]
    assert abs(few / all_ - 1) < 0.01  # eight samples a pixel: 0.3 %


def test_a_crop_window_shows_the_same_pixels(variant_llvm_rgb):
    film = {"type": "hdrfilm", "width": 100, "height": 80}
    crop = {"crop_width": 20, "crop_height": 16, "crop_offset_x": 40, "crop_offset_y": 32}
    whole, cropped = (late(footprint.of(camera(film=film | more), 0.5)) for more in ({}, crop))
    np.testing.assert_allclose(shares(cropped, [1, 10]), shares(whole, [1, 10]), rtol=1e-3)


def test_cameras_side_by_side_have_pixels_as_wide_as_one_alone(variant_llvm_rgb):
    to_world = mi.ScalarTransform4f().translate([5, 0, 0])
    two = {"a": {"type": "perspective"}, "b": {"type": "perspective", "to_world": to_world}}
    film = {"type": "hdrfilm", "width": 200, "height": 80}
    both = late(footprint.of(camera("batch", film=film, **two), 10.0))
    one = late(footprint.of(camera(), 10.0))
    np.testing.assert_allclose(shares(both, [10]), shares(one, [10]), rtol=0.3)


def test_sensors_whose_pixels_have_no_width_have_one_radius(variant_llvm_rgb):
    """The kernels of a radiance meter's passes are as wide as their radius says, which goes with
    the number of light paths, and these are not millions for a few hundred eye paths."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "radiancemeter", "origin": [0, 0, 0.9], "direction": [0.2, -0.6, -1]}
    definition = room(size=4) | {"sensor": meter | {"film": film}}
    scene = mi.load_dict(definition)
    assert footprint.of(scene.sensors()[0], 1.0) is None
    plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "passes": 8})
    image = np.array(mi.render(scene, integrator=plugin, spp=512))
    found = plugin.statistics
    assert found["photons_emitted"] < 8 * 250_000
    assert found["photons_gathered"] > 30 * found["gather_points"]
    path = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    np.testing.assert_allclose(image.mean(), path.mean(), rtol=0.1)
