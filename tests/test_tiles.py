"""Tiles of a film: whom they stand for, and what follows for pixels."""

import warnings
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering.film import border
from aniso_pm.rendering.tiles import COARSE, SAMPLES, Tiles


@pytest.mark.parametrize("edge", [1, 3])
def test_tiles_cover_every_pixel_once(edge):
    tiles = Tiles(edge, 10, 7)
    numbers = np.arange(tiles.across * tiles.down).reshape(tiles.down, tiles.across)
    pixels = tiles.to_pixels(numbers).reshape(7, 10)
    for y in range(7):
        for x in range(10):
            assert pixels[y, x] == (y // edge) * tiles.across + x // edge


@pytest.mark.parametrize("offset", [0, 3])
def test_positions_reach_over_a_border_that_the_film_samples(variant_llvm_rgb, offset):
    film = {"type": "hdrfilm", "width": 32, "height": 24, "crop_width": 10, "crop_height": 8}
    film |= {"crop_offset_x": offset, "crop_offset_y": offset, "sample_border": True}
    sensor = mi.load_dict({"type": "perspective", "film": film | {"rfilter": {"type": "gaussian"}}})
    tiles = Tiles.of(sensor, 4096)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, tiles.lanes)
    found, edge = tiles.positions(sensor, 0, sampler).numpy(), border(sensor.film())
    assert edge > 0
    for values, size in zip(found, (10, 8), strict=True):
        first = offset - edge
        pixels = np.unique(np.floor(values)).astype(int)
        np.testing.assert_array_equal(pixels, np.arange(first, first + size + 2 * edge))


def test_the_dark_counts_beside_what_is_bright():
    """Errors are relative, but not of what nobody sees beside the bright part of a picture."""
    tiles = Tiles(1, 40, 40)
    even, part = np.full((40, 40), 0.8), np.full((40, 40), 1e-3)
    part[:, 30:] = 1.0  # a quarter of the picture
    for light, floor in ((even, 0.25 * 0.8), (part, 0.1)):
        weight = tiles.weight(light.reshape(-1, 1)).reshape(40, 40)
        expected = 1 / (light**2 + floor**2)
        np.testing.assert_allclose(weight[:, [0, 20, -1]], expected[:, [0, 20, -1]], rtol=1e-6)


def test_several_pairs_stand_for_each_pixel_of_a_small_film(variant_llvm_rgb):
    film = {"type": "hdrfilm", "width": 5, "height": 3, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    tiles = Tiles.of(sensor, COARSE)
    assert tiles.across * tiles.down >= 256 and tiles.edge == 1
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, tiles.lanes)
    x, y = tiles.positions(sensor, 0, sampler).numpy().reshape(2, -1)[:, :: 2 * SAMPLES]
    there = np.floor(y) * 5 + np.floor(x)  # the pixel of each pair
    np.testing.assert_array_equal(tiles.to_pixels(there), np.arange(15))
    np.testing.assert_array_equal(tiles.refined(there, Tiles.of(sensor, 20_000)), there)


def test_a_film_of_one_pixel_has_nothing_to_tell_apart(variant_llvm_rgb):
    tiles = Tiles(1, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tiles.counts(np.ones(1), np.ones(1), 16) is None


def test_every_fourth_tile_is_one_of_twice_the_edge(variant_llvm_rgb):
    film = {"type": "hdrfilm", "width": 101, "height": 75, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    all_ = Tiles.of(sensor, 2000)
    few, pairs = all_.every_fourth()
    assert few == replace(all_, edge=2 * all_.edge)
    assert few.pairs == len(pairs) == few.across * few.down
    of_row, of_column = np.divmod(np.arange(all_.pairs), all_.across)
    # What these have is that of the tile in whose corner they are.
    np.testing.assert_array_equal(few.refined(of_row[pairs], all_), of_row // 2 * 2)
    np.testing.assert_array_equal(few.refined(of_column[pairs], all_), of_column // 2 * 2)
    assert Tiles.of(sensor, 600).every_fourth() is None
