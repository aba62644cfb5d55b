"""Light agrees with ``path`` whatever shapes, cameras and materials go through
(tests/random_scenes.py has the method and its false alarms)."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import random_materials
import random_scenes
from aniso_pm.rendering import film


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def assert_nothing_is_found(kinds, tries, first_seed, spp):
    done = random_scenes.run(kinds, tries, first_seed, spp)
    findings = [str(t) for t in done if t.is_finding]
    assert not findings, "\n".join(findings)
    return done


# Mirrored by their seeds: their normals are on both sides then.
@pytest.mark.usefixtures("without_pilot")
@pytest.mark.parametrize("kind, seed", [("rectangle", 1), ("cube", 4), ("thinlens", 0)])
def test_indirect_light_agrees_with_path(kind, seed):
    assert_nothing_is_found([kind], 1, seed, 16)


@pytest.mark.slow
def test_indirect_light_of_random_shapes_and_cameras_agrees_with_path():
    kinds = [*random_scenes.SHAPES, *random_scenes.CAMERAS]
    done = assert_nothing_is_found(kinds, 6, 0, 32)
    print(f"{len(done)} tries, {sum(t.again is not None for t in done)} made again")


@pytest.mark.slow
def test_all_light_of_random_materials_agrees_with_path():
    done = random_materials.run(40, 0, 32)
    findings = [str(t) for t in done if t.is_finding]
    assert not findings, "\n".join(findings)


@pytest.mark.parametrize("kind", random_scenes.CAMERAS)
def test_every_sample_has_a_camera_ray_of_its_own(kind):
    """Also where the camera has one ray: decisions per sample are taken for all otherwise."""
    sensor = mi.load_dict(random_scenes.camera(kind, np.random.default_rng(0)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 8 * film.pixel_count(sensor.film()))
    ray, _, _ = film.sample_rays(sensor, sampler, 8, 0.5)
    assert dr.width(ray) == 8 * film.pixel_count(sensor.film())
