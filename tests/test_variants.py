"""Mono, spectral, scalar variants, switching; other sensors."""

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from conftest import slow
from renders import SMALL, array, integrator
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


def test_mono_sees_the_luminance_of_grey_scenes(variant_llvm_mono):
    definition = room(size=16)
    scene = mi.load_dict(definition)
    image = array(mi.render(scene, integrator=integrator(photon_count=50_000), spp=64))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=256))
    assert image.mean() == pytest.approx(path.mean(), rel=0.03)


@pytest.mark.parametrize(
    "emitter",
    ["textured", "envmap", *slow("area", "point")],
)
def test_spectral_agrees_with_path(variant_llvm_spectral, emitter):
    """The lamps' spectra differ and the rays' wavelengths are not the lamps' own: a wrong spectrum
    or pairing shows in the colour."""
    tungsten = {
        "type": "irregular",
        "wavelengths": "360, 500, 600, 700, 830",
        "values": "0.2, 1, 3, 6, 8",
    }
    definition = room(size=8)
    if emitter == "area":
        definition["light"]["emitter"]["radiance"] = tungsten
    elif emitter == "textured":
        texels = np.random.default_rng(2).uniform(0, 9, (4, 4, 3)).astype(np.float32)
        radiance = {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True}
        definition["light"]["emitter"]["radiance"] = radiance | {"raw": False}
        definition["lamp"] = {"type": "point", "position": [0, 0.5, 0], "intensity": tungsten}
    elif emitter == "point":
        definition["light"] = {"type": "point", "position": [0, 0.5, 0], "intensity": tungsten}
    else:
        sky = np.full((8, 16, 3), 0.4, np.float32)
        sky[1:3, 3:6] = [9, 4, 1]
        definition["light"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
        del definition["ceiling"]
    scene = mi.load_dict(definition)
    ours = integrator(photon_count=20_000, passes=32, initial_radius=0.05)
    image = array(mi.render(scene, integrator=ours, spp=512)).mean((0, 1))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    np.testing.assert_allclose(image, path.mean((0, 1)), rtol=0.03)


def test_specfilm_agrees_with_path(variant_llvm_spectral):
    """Bands of its own instead of RGB."""
    definition = room(size=8)
    definition["sensor"]["film"] = {
        "type": "specfilm",
        "width": 8,
        "height": 8,
        "rfilter": {"type": "box"},
        "component_format": "float32",
        "band1_low": {"type": "spectrum", "value": [(400, 1.0), (500, 1.0), (550, 0.0)]},
        "band2_high": {"type": "spectrum", "value": [(500, 0.0), (600, 1.0), (700, 1.0)]},
    }
    scene = mi.load_dict(definition)
    ours = integrator(photon_count=20_000, passes=32, initial_radius=0.05)
    image = array(mi.render(scene, integrator=ours, spp=512)).mean((0, 1))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))
    assert image.shape == (2,)
    np.testing.assert_allclose(image, path.mean((0, 1)), rtol=0.03)


def test_spectral_refuses_what_cannot_share_wavelengths(variant_llvm_spectral):
    definition = room(size=4)
    texture = {"type": "bitmap", "data": mi.TensorXf(np.ones((2, 2, 3), np.float32))}
    definition["light"] = {"type": "projector", "irradiance": texture}
    with pytest.raises(ValueError, match="is a projector.*use an RGB variant"):
        integrator().render(mi.load_dict(definition), spp=1)


@pytest.mark.parametrize("kind", ["thinlens", "orthographic", "batch"])
def test_other_sensors_see_what_path_sees(rgb, kind):
    T = mi.ScalarTransform4f
    definition = room(size=16)
    camera = definition["sensor"]
    film = camera["film"]
    if kind == "thinlens":
        definition["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 1.5}
    elif kind == "orthographic":
        to_world = T().look_at([0, 0, 0.9], [0, -0.2, 0], [0, 1, 0]).scale([0.8, 0.8, 1])
        definition["sensor"] = {"type": "orthographic", "to_world": to_world, "film": film}
    else:
        cameras = {}
        for k in range(2):
            to_world = T().look_at([0.4 * k, 0, 0.97], [0, -0.15, 0], [0, 1, 0])
            cameras[f"camera{k}"] = {"type": "perspective", "fov": 75, "to_world": to_world}
        definition["sensor"] = {"type": "batch", "film": film | {"width": 32}} | cameras
    scene = mi.load_dict(definition)
    image = array(mi.render(scene, integrator=integrator(photon_count=100_000, passes=2), spp=128))
    path = array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=512))
    assert image.shape == path.shape
    columns = lambda a: a.reshape(16, -1, 8, 3).mean((0, 2))  # noqa: E731
    np.testing.assert_allclose(columns(image), columns(path), rtol=0.04)


def test_scalar_variants_are_refused_at_loading():
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(Exception, match='the variant "scalar_rgb" has no'):
            mi.load_dict({"type": "aniso_pm"})
    finally:
        mi.set_variant(before or "llvm_ad_rgb")


def test_switching_variants_there_and_back_changes_nothing():
    before = mi.variant()
    images = []
    for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"):
        mi.set_variant(variant)
        assert type(mi.load_dict(SMALL)).__name__ == "AnisoPhotonMapper"
        assert type(mi.load_dict({"type": "asgconductor"})).__name__ == "ASGConductor"
        if variant == "llvm_ad_rgb":
            scene = mi.load_dict(room_with_plate(8))
            images.append(array(mi.render(scene, integrator=integrator(), spp=4)))
    mi.set_variant(before or "llvm_ad_rgb")
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-4)
