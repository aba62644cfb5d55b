"""Light paths carry what emitter sampling and rays find, however an emitter is placed
(tests/random_light.py has the method and its false alarms)."""

import mitsuba as mi
import numpy as np
import pytest
import random_light
from aniso_pm.transport import emission
from random_light import T, colour, texture

RNG = np.random.default_rng(3)
# Kinds that something was wrong with, or easily is, for every run of the tests.
QUICK = (
    "area, sphere",
    "textured area, obj",
    "spot",
    "directional",
    "directionalarea, cube",
    "envmap",
    "several",
)


def assert_nothing_is_found(names, tries, first_seed, count):
    done = random_light.run(names, tries, first_seed, count)
    findings = [str(t) for t in done if t.is_finding]
    assert not findings, "\n".join(findings)
    for name in names:
        z = np.array([t.z for t in done if t.kind == name])
        # Small errors that all tries share; 26 kinds × 12 sums above 5 by chance: 2e-4.
        assert np.abs(z.sum(0)).max() < 5 * len(z) ** 0.5, name
    return done


@pytest.mark.parametrize("name", QUICK)
def test_light_paths_carry_what_arrives(variant_llvm_rgb, name):
    assert_nothing_is_found([name], 2, 100, 1 << 15)


@pytest.mark.slow
def test_light_paths_carry_what_arrives_in_500_tries(variant_llvm_rgb):
    names = list(random_light.kinds())
    tries = -(-500 // len(names))
    done = assert_nothing_is_found(names, tries, 0, 1 << 17)
    again = sum(t.again is not None for t in done)
    print(f"{len(done)} tries, {again} made again, nothing found")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mono", "spectral"])
def test_light_paths_carry_what_arrives_in_other_variants(request, name):
    request.getfixturevalue(f"variant_llvm_{name}")
    assert_nothing_is_found(list(random_light.kinds()), 2, 1000, 1 << 16)


def test_textured_spots_are_refused_in_spectral_variants(variant_llvm_spectral):
    light = {"type": "spot", "texture": texture(RNG)}
    scene = mi.load_dict({"type": "scene", "light": light})
    with pytest.raises(ValueError, match='spot with a "texture"'):
        emission.prepare(scene)
    emission.prepare(mi.load_dict({"type": "scene", "light": {"type": "spot"}}))


def textured(shape, **more):
    return {"type": shape, "e": {"type": "area", "radiance": texture(RNG)}} | more


REFUSED = {
    "a scaled directional light": (
        lambda: {"type": "directional", "to_world": T().scale(2)},
        'emitter "light" has a "to_world" that scales',
    ),
    "a scaled projector": (
        lambda: {"type": "projector", "irradiance": texture(RNG), "to_world": T().scale(2)},
        'emitter "light" has a "to_world" that scales',
    ),
    "an unevenly scaled spot": (
        lambda: {"type": "spot", "to_world": T().scale([1, 2, 1])},
        'spot with a "to_world" that scales unevenly',
    ),
    "a mirrored cylinder": (
        lambda: {"type": "cylinder", "to_world": T().scale([1, 1, -1]), "e": {"type": "area"}},
        'on a cylinder with a "to_world" that mirrors',
    ),
    "a texture on a turned sphere": (
        lambda: textured("sphere", to_world=T().rotate([0, 1, 0], 160)),
        'has a texture on the shape "light"',
    ),
    "a texture on a flipped rectangle": (
        lambda: textured("rectangle", flip_normals=True),
        'has a texture on the shape "light"',
    ),
    "a texture on a cube, whose faces share coordinates": (
        lambda: textured("cube"),
        'has a texture on the shape "light"',
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_mitsubas_own_estimates_differ_on_is_refused(variant_llvm_rgb, name):
    """Its emitter sampling shows other light there than its rays, or its light paths, carry."""
    light, message = REFUSED[name]
    scene = mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}, "light": light()})
    with pytest.raises(ValueError, match=message):
        emission.prepare(scene)


def test_what_mitsuba_samples_right_is_not_refused(variant_llvm_rgb):
    for light in (
        {"type": "spot", "to_world": T().rotate([0, 1, 0], 30).scale(2)},
        textured("sphere", center=[1, 2, 3], radius=2.0),
        {"type": "cylinder", "flip_normals": True, "e": {"type": "area", "radiance": colour(RNG)}},
        {"type": "directional", "to_world": T().rotate([0, 1, 0], 30).scale([1, -1, 1])},
    ):
        emission.prepare(mi.load_dict({"type": "scene", "light": light}))
