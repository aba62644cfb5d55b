"""Pictures out of samples, against Mitsuba's own ``ImageBlock.put``."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import film as films
from aniso_pm.rendering import splat
from aniso_pm.rendering.allotment import Allotment

FILTERS = {
    "box": {"type": "box"},
    "tent": {"type": "tent"},
    "gaussian": {"type": "gaussian"},
    "wide": {"type": "gaussian", "stddev": 1.1},
    "mitchell": {"type": "mitchell"},
    "catmullrom": {"type": "catmullrom"},
    "lanczos": {"type": "lanczos"},
}
CROP = {"crop_width": 9, "crop_height": 7, "crop_offset_x": 5, "crop_offset_y": 3}


def prepared(rfilter, **more):
    film = mi.load_dict({"type": "hdrfilm", "width": 23, "height": 11, "rfilter": rfilter, **more})
    film.prepare([])
    return film


def uneven(pixels):
    counts = np.arange(pixels) % 7 + 1
    counts[0] += -counts.sum() % pixels
    return counts


def compare(film, allotment, most, box=False):
    """Two channels and the weight, of all wavefronts of a pass."""
    sampler = mi.load_dict({"type": "owen_sobol"})
    wide, _ = films.sampled_size(film)
    ours, right = 0, 0
    wavefronts = 0
    for lanes, _ in allotment.wavefronts(0, 0, 0, most):
        sampler.begin(3, lanes.pixel, lanes.sample)
        edge, offset = films.border(film), film.crop_offset()
        x = mi.Float(lanes.pixel % wide) + (offset.x - edge)
        y = mi.Float(lanes.pixel // wide) + (offset.y - edge)
        position = mi.Point2f(x, y) + sampler.next_2d()
        colour = sampler.next_2d()
        weight = mi.Float(1) if lanes.weight is None else lanes.weight
        channels = [colour.x, colour.y, mi.Float(1)]
        ours = ours + splat.image(film, lanes, position, channels, box)
        like = film.create_block()
        rfilter = mi.load_dict({"type": "box"}) if box else film.rfilter()
        block = mi.ImageBlock(like.size(), like.offset(), 3, rfilter, False)
        block.put(position, [c * weight for c in channels])
        right = right + block.tensor()
        wavefronts += 1
    assert np.abs(np.array(right)).max() > 0.1
    np.testing.assert_allclose(np.array(ours), np.array(right), rtol=2e-4, atol=2e-5)
    return wavefronts


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("crop", [{}, CROP], ids=["whole", "crop"])
@pytest.mark.parametrize("border", [False, True], ids=["inside", "border"])
def test_pixels_are_mitsubas(variant_llvm_rgb, name, crop, border):
    film = prepared(FILTERS[name], sample_border=border, **crop)
    pixels = films.pixel_count(film)
    compare(film, Allotment(pixels, 3), 1 << 20)
    compare(film, Allotment(pixels, 8, uneven(pixels)), 1 << 20)
    compare(film, Allotment(pixels, 2), 1 << 20, box=True)


@pytest.mark.parametrize("counts", [None, uneven], ids=["even", "uneven"])
def test_pixels_in_parts_and_bands(variant_llvm_rgb, monkeypatch, counts):
    """Wavefronts that hold a part of the pixels or of their samples; bands of a row or two."""
    film = prepared(FILTERS["gaussian"], sample_border=True)
    pixels = films.pixel_count(film)
    allotment = Allotment(pixels, 8, counts and counts(pixels))
    for band in (1, 60, 1 << 18):
        monkeypatch.setattr(splat, "_BAND", band)
        assert compare(film, allotment, pixels // 3) >= 3
        assert compare(film, allotment, 3 * pixels) >= 2


def test_the_same_samples_make_the_same_bits(variant_llvm_rgb):
    """No atomic additions, whose order would be another one each time."""
    film = prepared(FILTERS["gaussian"])
    lanes, _ = next(Allotment(23 * 11, 64).wavefronts(0, 0, 0, 1 << 20))
    sampler = mi.load_dict({"type": "owen_sobol"})
    sampler.begin(3, lanes.pixel, lanes.sample)
    position = mi.Point2f(mi.Float(lanes.pixel % 23), mi.Float(lanes.pixel // 23))
    position += sampler.next_2d()
    colour = sampler.next_2d()
    dr.eval(position, colour)
    made = [np.array(splat.image(film, lanes, position, [colour.x, mi.Float(1)])) for _ in range(3)]
    assert (made[0] == made[1]).all() and (made[0] == made[2]).all()
