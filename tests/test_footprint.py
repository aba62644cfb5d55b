"""Kernels as wide as pixels where many passes share the picture; some eye paths gather for all."""

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm import eye, footprint
from rooms import room_with_ball


def camera(kind="perspective", **more):
    film = {"type": "hdrfilm", "width": 100, "height": 80}
    return mi.load_dict({"type": kind, "film": film} | more)


def last(found):
    """In a late pass."""
    return footprint.in_pass(found, 1000)


def test_footprint_of_a_perspective_camera_is_the_pixels_angle_times_the_path(variant_llvm_rgb):
    sensor = camera(fov=40, fov_axis="x")
    found = last(footprint.of(sensor, radius=0.5))
    pixel = 2 * np.tan(np.radians(20)) / 100
    wanted = np.clip(1.75 * pixel * np.array([1.0, 10, 20, 100]) / 0.5, 0.2, 1)
    share = found.share(mi.Float([1, 10, 20, 100])).numpy()
    np.testing.assert_allclose(share, wanted, rtol=1e-3)  # angle against tangent


def test_footprint_of_an_orthographic_camera_is_its_pixels_width(variant_llvm_rgb):
    to_world = mi.ScalarTransform4f().scale([3, 3, 1])
    found = last(footprint.of(camera("orthographic", to_world=to_world), radius=1))
    # 6 world units by 100 pixels, as wide after any path
    np.testing.assert_allclose(found.share(mi.Float([0, 1, 50])).numpy(), 0.2, rtol=1e-5)
    found = last(footprint.of(camera("orthographic", to_world=to_world), radius=0.2))
    np.testing.assert_allclose(found.share(mi.Float([0, 1, 50])).numpy(), 0.525, rtol=1e-3)


def test_all_passes_together_keep_the_photons_of_the_first(variant_llvm_rgb):
    """Photons of a kernel grow with its area; the first pass has the whole bandwidth."""
    found = footprint.of(camera(), 1.0)
    for share, passes in ((1, 1), (0.5, 2), (0.2, 5), (0.2, 100)):
        least = footprint.in_pass(found, passes - 1).share(mi.Float(0)).numpy()
        np.testing.assert_allclose(least, share, rtol=1e-6)


def test_of_a_pixels_samples_the_same_number_gathers(variant_llvm_rgb):
    pixels, samples = 4096, 16
    lane = dr.arange(mi.UInt32, pixels * samples)
    for share in (0.125, 0.25, 0.6):
        chosen = eye.Thinning.of(share, 5, lane // samples, lane % samples).chosen().numpy()
        chosen = chosen.reshape(pixels, samples)
        assert (abs(chosen.sum(1) - share * samples) < 2).all()
        # Each sample with the same chance: five standard deviations of 4096 draws.
        spread = 5 * (share * (1 - share) / pixels) ** 0.5
        assert (abs(chosen.mean(0) - share) < spread).all()


def test_thinned_gathers_have_the_same_mean(variant_llvm_rgb):
    """Eight passes with few gathers against the same with a gather for every eye path."""
    scene = mi.load_dict(room_with_ball(size=24))

    def mean(spp):
        plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "passes": 4})
        image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=2), dtype=np.float64)
        return image.mean(), plugin.statistics

    few, thinned = mean(4 * 64)
    all_, full = mean(4 * 2)
    assert thinned["share_of_gathers"] < 1
    assert full["share_of_gathers"] == 1
    assert thinned["gather_points"] < thinned["eye_samples"]
    assert abs(few / all_ - 1) < 0.01  # eight samples a pixel: 0.3 %
