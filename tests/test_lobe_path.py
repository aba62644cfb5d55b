"""The lobe that an eye path carries to its gather point."""

import drjit as dr
import matrix
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def gather_points(name, **settings):
    scene = matrix.make(matrix.rows()[name], size=32)
    prepared = prepare(scene, Settings(**settings), False)
    sampler = mi.load_dict({"type": "independent"})
    lane = dr.arange(mi.UInt32, 32 * 32 * 16)
    sampler.seed(1, dr.width(lane))
    position = sampler.next_2d()
    ray, _ = scene.sensors()[0].sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
    return prepared.trace(sampler, ray)[2]


def earlier_blur(path):
    """Variance p that earlier glossy vertices brought, from what the lobe says of itself:
    1/λ' = 1/λ + p, 1/μ' = 1/μ + p and blur = p + 1/√(λμ) give (1/λ' − p)(1/μ' − p) = (blur − p)².
    """
    a, b, blur = (
        np.array(v, dtype=np.float64)
        for v in (1 / path.lobe().lobe.lam, 1 / path.lobe().lobe.mu, path.blur)
    )
    return (a * b - blur**2) / (a + b - 2 * blur)


def test_earlier_glossy_vertices_widen_the_lobe():
    points = gather_points("two brushed plates")
    valid, depth = points.path.valid.numpy(), points.depth.numpy()
    earlier = earlier_blur(points.path)
    assert np.abs(earlier[valid & (depth == 2)]).max() < 1e-5  # one glossy vertex: nothing earlier
    twice = earlier[valid & (depth == 3)]
    assert len(twice) > 100 and twice.min() > 0
    # The first plate's 1/√(λμ) is 4 · 0.05 · 0.3 · cosθ after the warp: at most 0.06.
    assert 1e-3 < np.median(twice) < 0.07


def test_no_lobe_is_carried_where_nothing_is_anisotropic():
    assert gather_points("mirror that sees a caustic").path is None
    assert gather_points("roughconductor 0.1").path is None


def test_lobes_stay_frames_that_face_the_path():
    points = gather_points("brushed conductor")
    valid = points.path.valid.numpy()
    path = points.path.lobe()
    for axis in (path.lobe.x, path.lobe.y, path.lobe.z):
        norm = dr.norm(axis).numpy()[valid]
        np.testing.assert_allclose(norm, 1, atol=1e-5)
    assert (dr.dot(path.r, path.lobe.z).numpy()[valid] > 0).mean() > 0.99
