"""Indirect light of the rooms, averaged over the image and over the pixels of each shape.

``python tests/energy.py [ROOM [DEPTH]]`` makes tests/rooms.json, or that part of it: the converged
values of Mitsuba's ``path`` that the energy tests compare with. It goes on until every region is
known to 0.2 %, which takes some minutes on two cores, and twenty for the few bright paths of the
glass ball at depth 2.
"""

import json
import sys
from pathlib import Path
from unittest import mock

import aniso_pm  # noqa: F401 (registers the plugins)
import drjit as dr
import mitsuba as mi
import numpy as np
from rooms import ROOMS

REFERENCE = Path(__file__).with_name("rooms.json")
DEPTHS = (1, 2, 3, 4, 5, 6, -1)


def regions(scene):
    """Name → mask of the pixels whose centre shows that shape; "image" is all of them."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, width * height)
    centre = mi.Point2f((index % width + 0.5) / width, (index // width + 0.5) / height)
    ray, _ = sensor.sample_ray(0, 0.5, centre, mi.Point2f(0.5))
    hit = scene.ray_intersect_preliminary(ray)
    masks = {"image": np.ones((height, width), bool)}
    for shape in scene.shapes():
        masks[shape.id()] = (hit.shape == mi.ShapePtr(shape)).numpy().reshape(height, width)
    return {name: mask for name, mask in masks.items() if mask.sum() > 30}


def indirect(scene, integrator, max_depth, spp, seed):
    """Image of the light over more than one bounce: all light less direct light. Both are rendered
    with the same seed and as many samples in every pixel, so that most of the noise of direct
    light cancels."""

    def image(depth, **more):
        plugin = mi.load_dict(integrator | more | {"max_depth": depth})
        with mock.patch("aniso_pm.rendering.survey.pixel_counts", return_value=None):
            picture = mi.render(scene, integrator=plugin, spp=spp, seed=seed)
        return np.array(picture, dtype=np.float64)

    if max_depth in (1, 2):
        return image(max_depth)  # there is no indirect light: compare what there is
    few = {"photon_count": 1} if integrator["type"] == "aniso_pm" else {}
    return image(max_depth) - image(2, **few)


def region_values(scene, integrator, max_depth, spp, seeds):
    """Name → mean over the region's pixels and channels, one for each seed."""
    images = [indirect(scene, integrator, max_depth, spp, seed) for seed in seeds]
    return {name: [x[mask].mean() for x in images] for name, mask in regions(scene).items()}


def mean_and_error(values):
    """The mean and its standard error."""
    return np.mean(values), np.std(values, ddof=1) / len(values) ** 0.5


def region_means(scene, integrator, max_depth, spp, seeds):
    """Name → (mean over the region's pixels and channels, its standard error over the seeds)."""
    values = region_values(scene, integrator, max_depth, spp, seeds)
    return {name: mean_and_error(of_region) for name, of_region in values.items()}


def converged(scene, max_depth, precision=2e-3, spp=2048):
    """What ``region_means`` says of ``path``, with as many seeds as bring the standard error of
    every region that is not black below ``precision`` times its mean."""
    path = {"type": "path", "rr_depth": 16}
    values, seeds = {}, range(1000, 1016)
    while True:
        for name, more in region_values(scene, path, max_depth, spp, seeds).items():
            values.setdefault(name, []).extend(more)
        means = {name: mean_and_error(of_region) for name, of_region in values.items()}
        if all(error < precision * mean for mean, error in means.values() if mean > 1e-3):
            return means
        seeds = range(seeds.stop, 2 * seeds.stop - 1000)


def main(rooms=tuple(ROOMS), depths=DEPTHS):
    mi.set_variant("llvm_ad_rgb")
    table = json.loads(REFERENCE.read_text())
    for room in rooms:
        scene = mi.load_dict(ROOMS[room]())
        for depth in depths:
            means = converged(scene, depth)
            row = {k: [float(f"{x:.6g}") for x in v] for k, v in means.items()}
            table.setdefault(room, {})[str(depth)] = row
            print(room, depth, row, flush=True)
            REFERENCE.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main(*([x] for x in (sys.argv[1:2] + [int(x) for x in sys.argv[2:3]])))
