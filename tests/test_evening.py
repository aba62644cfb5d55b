"""Light that few samples gather for many, evened out over pixels: less noise, the same mean."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import film as films
from aniso_pm.rendering.allotment import Allotment
from aniso_pm.rendering.evening import Evening
from aniso_pm.transport import layers
from aniso_pm.transport.thinning import Thinning
from rooms import room_with_plate

WIDE, HIGH = 12, 10
COUNTS = np.arange(WIDE * HIGH) % 5 + 2


def wavefronts(index, share, most=10**6, counts=COUNTS):
    """(Evening, Lanes, w) of a pass."""
    each = 4 if counts is None else int(counts.mean())
    allotment = Allotment(WIDE * HIGH, each, counts)
    for lanes, _ in allotment.wavefronts(index, 0, 0, most):
        shares = dr.full(mi.Float, share, WIDE * HIGH)
        thinning = Thinning.of_pass(shares, 7 + index, lanes.pixel, lanes.place, lanes.of)
        gathers, worth = thinning.chosen()
        yield Evening(thinning, lanes, WIDE), lanes, dr.select(gathers, worth, 0).numpy()


@pytest.mark.parametrize("counts", [None, COUNTS], ids=["even", "uneven"])
@pytest.mark.parametrize("most", [10**6, 200, 50])
def test_even_light_is_without_noise(variant_llvm_rgb, counts, most):
    """Whatever parts of the film, and of the samples, are in a wavefront."""
    for even, lanes, w in wavefronts(3, 0.5, most, counts):
        added = even(mi.Color3f(mi.Float(w) * mi.Color3f(1, 2, 3)))[0].numpy()
        pixel = lanes.pixel.numpy()
        places = np.arange(WIDE * HIGH).reshape(HIGH, WIDE) - lanes.first
        here = (places >= 0) & (places < lanes.pixels)
        gathers = np.bincount(pixel, w, WIDE * HIGH).reshape(HIGH, WIDE) > 0
        missing, outside = np.zeros((HIGH, WIDE)), np.zeros((HIGH, WIDE))
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):  # sides
            there, some = (
                sum(
                    np.roll(np.pad(v.astype(int), 2), (step, along), (axis, 1 - axis))
                    for along in (-1, 0, 1)
                )[2:-2, 2:-2]
                for v in (here, gathers)
            )
            missing += (some == 0) & (there > 0)
            outside += there == 0
        known = ((missing < 2) & (missing + outside < 4)).ravel()[pixel]
        assert known.mean() > 0.4 or most == 50
        expected = np.where(known, 1 - w, 0)
        np.testing.assert_allclose(added, expected * np.array([[1], [2], [3]]), atol=1e-5)


@pytest.mark.parametrize("share", [0.125, 0.6])
def test_the_mean_is_what_is_gathered(variant_llvm_rgb, share):
    """Over passes, in each pixel, of light that is different in every sample."""
    passes, light = 400, np.random.default_rng(1).gamma(1, size=int(COUNTS.sum()))
    found = []
    for index in range(passes):
        ((even, lanes, w),) = wavefronts(index, share)
        added = even(mi.Color3f(mi.Float(w * light)))[0].numpy()[0]
        found.append(np.bincount(lanes.pixel.numpy(), w * light + added))
    found = np.array(found)
    expected = np.bincount(lanes.pixel.numpy(), light)
    z = (found.mean(0) - expected) / (found.std(0) / passes**0.5 + 1e-6)
    assert 0.6 < (z**2).mean() < 1.5
    assert abs(z.mean()) < 0.3


def test_what_is_not_finite_stays_where_it_is(variant_llvm_rgb):
    ((even, lanes, w),) = wavefronts(0, 1.0)
    light = np.where(np.arange(len(w)) == 100, np.nan, w)
    assert np.isfinite(even(mi.Color3f(mi.Float(light)))[0].numpy()).all()


@pytest.mark.parametrize("kind", ["gaussian", "lanczos"])
def test_nothing_is_shown_below_zero(variant_llvm_rgb, kind):
    """Of filters with negative lobes it is, as Mitsuba does."""
    film = mi.load_dict({"type": "hdrfilm", "width": 4, "height": 3, "rfilter": {"type": kind}})
    film.prepare([])
    image = np.ones((3, 4, 4), np.float32)
    image[1, 2, 0] = -0.1
    films.show_array(film, image)
    assert np.array(film.develop())[1, 2, 0] == np.float32(0 if kind == "gaussian" else -0.1)


@pytest.mark.parametrize("variant", ["rgb", "mono", "spectral"])
def test_energy_is_that_of_path_where_few_gather(request, variant):
    request.getfixturevalue(f"variant_llvm_{variant}")
    scene = mi.load_dict(room_with_plate(size=16))
    plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "passes": 4})
    image = np.array(mi.render(scene, integrator=plugin, spp=256))
    assert plugin.statistics["share_of_gathers"] < 0.6
    path = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    assert image.mean() == pytest.approx(path.mean(), rel=0.02)


@pytest.mark.parametrize("variant", ["rgb", "mono", "spectral"])
def test_layers_of_light_add_up_where_few_gather(request, variant):
    request.getfixturevalue(f"variant_llvm_{variant}")
    scene = room_with_plate(size=16)
    scene["sensor"]["film"]["rfilter"] = {"type": "lanczos"}  # pictures keep what is below zero
    asked = {"type": "aniso_pm", "map": "global", "passes": 2, "layers": ",".join(layers.LIGHT)}
    plugin = mi.load_dict(asked)
    image = np.array(mi.render(mi.load_dict(scene), integrator=plugin, spp=32))[..., :3]
    assert plugin.statistics["share_of_gathers"] < 0.6
    total = sum(plugin.layers[name] for name in layers.LIGHT)
    np.testing.assert_allclose(total, np.broadcast_to(image, total.shape), atol=2e-5)
