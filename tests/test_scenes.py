"""The scenes that come with the library: they load, and they show what their references show."""

from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.instruments.report import reference as references
from conftest import slow

SCENES = Path(__file__).parents[1] / "scenes"


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.mark.parametrize("name", ["teapot", "fry_pan"])
def test_scene_agrees_with_its_reference_at_a_tenth_of_the_size(name):
    reference = references.read(SCENES / "references" / f"{name}.exr").mean
    scene = mi.load_file(str(SCENES / f"{name}.xml"), width="64", height="48")
    image = np.array(mi.render(scene, spp=256), dtype=np.float64)[..., :3]
    small = reference.reshape(48, 10, 64, 10, 3).mean((1, 3))
    # Highlights 30 times as bright as the rest make the mean noisy: 0.5 % at 256 spp.
    assert image.mean() == pytest.approx(small.mean(), rel=0.02)
    assert np.median(np.abs(image - small) / (small + 0.01)) < 0.05


def test_glass_balls_agree_with_their_reference_at_half_the_size():
    reference = references.read(SCENES / "references" / "glass_balls.exr").mean
    scene = mi.load_file(str(SCENES / "glass_balls.xml"), width="80", height="60")
    image = np.array(mi.render(scene, spp=128), dtype=np.float64)[..., :3]
    small = reference.reshape(60, 2, 80, 2, 3).mean((1, 3))
    # Caustics seen in the mirror and highlights make the mean noisy: about 1 % at 128 spp.
    assert image.mean() == pytest.approx(small.mean(), rel=0.03)
    assert np.median(np.abs(image - small) / (small + 0.01)) < 0.05


@pytest.mark.parametrize("name", ["teapot", *slow("fry_pan")])
def test_kernels_follow_the_metal_and_fallbacks_are_rare(name):
    scene = mi.load_file(str(SCENES / f"{name}.xml"), width="64", height="48")
    plugin = mi.load_dict({"type": "aniso_pm", "kernel": "anisotropic", "map": "global"})
    mi.render(scene, integrator=plugin, spp=16)
    counts = plugin.statistics
    assert counts["gather_points_anisotropic"] > 0.1 * counts["gather_points"]
    for fallback in ("clamped", "capped", "degenerate"):
        assert counts[f"gather_points_{fallback}"] <= 0.01 * counts["gather_points"]
    assert counts["photons_rejected"] == counts["eye_samples_rejected"] == 0


def test_meshes_are_sound():
    """Finite unit normals along the faces' own, and tangents wherever a lobe will need one."""
    for path in sorted((SCENES / "meshes").glob("*.ply")):
        mesh = mi.load_dict({"type": "ply", "filename": str(path)})
        position = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
        normal = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)
        faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
        a, b, c = (position[faces[:, k]] for k in range(3))
        face_normal = np.cross(b - a, c - a)
        assert np.isfinite(position).all() and np.isfinite(normal).all(), path.name
        assert np.linalg.norm(face_normal, axis=1).min() > 0, path.name
        assert np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-3), path.name
        agreement = np.einsum("ij,ij->i", face_normal, normal[faces].mean(1))
        assert (agreement > 0).all(), path.name
        assert mesh.has_vertex_texcoords(), path.name
