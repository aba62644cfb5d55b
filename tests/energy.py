"""Indirect light of the rooms, averaged over the image and over the pixels of each shape.

``python tests/energy.py`` makes tests/rooms.json, the converged values of Mitsuba's ``path`` that
the energy tests compare with (about ten minutes on two cores).
"""

import json
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


def region_means(scene, integrator, max_depth, spp, seeds):
    """Name → (mean over the region's pixels and channels, its standard error over the seeds)."""
    images = [indirect(scene, integrator, max_depth, spp, seed) for seed in seeds]
    result = {}
    for name, mask in regions(scene).items():
        values = [image[mask].mean() for image in images]
        result[name] = (np.mean(values), np.std(values, ddof=1) / len(values) ** 0.5)
    return result


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    table = {}
    for room, make in ROOMS.items():
        scene = mi.load_dict(make())
        table[room] = {}
        for depth in DEPTHS:
            path = {"type": "path", "rr_depth": 16}
            seeds = range(1000, 1016 if depth == -1 else 1006)
            means = region_means(scene, path, depth, 2048, seeds)
            table[room][str(depth)] = {k: [float(f"{x:.6g}") for x in v] for k, v in means.items()}
            print(room, depth, table[room][str(depth)], flush=True)
    REFERENCE.write_text(json.dumps(table, indent=1) + "\n")
