"""Environments that are turned and mirrored: light paths carry what emitter sampling sees."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.transport import emission
from energy import indirect

USES = {
    "global": {"map": "global"},
    "caustic": {"map": "caustic"},
    "final gather": {"final_gather": True},
}


def axis(*v):
    """Of length 1: ``rotate`` scales about any other."""
    return list(np.array(v) / np.linalg.norm(v))


def turned():
    return mi.ScalarTransform4f().rotate(axis(1, 2, 3), 70)


def turns():
    """Name → to_world."""
    T = mi.ScalarTransform4f
    return {
        "turned": turned(),
        "tilted": T().rotate([1, 0, 0], 90),
        "mirrored": T().rotate(axis(1, -2, 3), 130).scale([1, -1, 1]),
    }


def sky():
    """A few bright texels, none of them where a quarter turn would put another."""
    texels = np.random.default_rng(1).uniform(0, 1, (16, 32, 3)).astype(np.float32) ** 4
    return mi.Bitmap(5 * texels)


def under(environment):
    """A diffuse and a glass ball on a plate, off the centre."""
    T = mi.ScalarTransform4f
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    camera = T().look_at(origin=[0, 2, 5], target=[0, 0.4, 0], up=[0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "light": environment,
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": camera,
                "film": {
                    "type": "hdrfilm",
                    "width": 16,
                    "height": 16,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance" if mi.is_monochromatic else "rgb",
                },
            },
            "plate": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90).scale(2),
                "bsdf": {"type": "twosided", "b": diffuse},
            },
            "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.6, "bsdf": diffuse},
            "glass": {
                "type": "sphere",
                "center": [1, 0.6, 0.6],
                "radius": 0.3,
                "bsdf": {"type": "dielectric"},
            },
        }
    )


def test_scaled_environment_is_refused_in_one_sentence(variant_llvm_rgb):
    twice = turned().scale(2)
    scene = under({"type": "envmap", "bitmap": sky(), "to_world": twice, "id": "sky"})
    with pytest.raises(ValueError, match='emitter "sky" has a "to_world" that scales'):
        emission.prepare(scene)


def test_brightness_of_the_emitters_own_rays_tells_turned_discs(variant_llvm_rgb):
    """1 unless its discs of origins lie askew; a mended Mitsuba's lie straight under any turn."""
    upright = emission.prepare(under({"type": "envmap", "bitmap": sky()})).environment
    assert abs(upright.own_brightness() - 1) < 0.03  # four standard deviations of 2^16 rays
    light = {"type": "envmap", "bitmap": sky(), "to_world": turned()}
    found = emission.prepare(under(light)).environment
    ray, _ = found.emitter.sample_ray(mi.Float(0), *emission._random(1024))
    ahead = dr.dot(found.centre - ray.o, ray.d) / found.radius
    askew = dr.max(dr.abs(ahead - 1))[0] > 0.01
    assert (found.own_brightness() > 1.05) == askew


@pytest.mark.slow
@pytest.mark.parametrize("turn", ["turned", "tilted", "mirrored"])
def test_indirect_light_of_a_turned_environment_map_agrees_with_path(variants_all, turn):
    scene = under({"type": "envmap", "bitmap": sky(), "to_world": turns()[turn]})

    def mean(integrator, spp, seeds):
        values = [indirect(scene, integrator, -1, spp, seed).mean() for seed in range(seeds)]
        return np.mean(values), np.std(values, ddof=1) / seeds**0.5

    reference, noise = mean({"type": "path"}, 32768, 8)
    for use, more in USES.items():
        passes = 16 if mi.is_spectral else 1
        small = {"initial_radius": 0.01, "photon_count": 3_200_000 // passes, "passes": passes}
        energy, own = mean({"type": "aniso_pm"} | small | more, 4096, 8)
        error = np.hypot(noise, own) / reference
        print(f"{variants_all} {turn} {use}: {energy / reference:.4f} ± {error:.4f}", flush=True)
        assert error < 0.003
        assert abs(energy / reference - 1) < 0.01, use
