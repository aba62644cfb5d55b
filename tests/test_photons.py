"""Photon maps against closed forms.

In a closed room whose surfaces all have the albedo ρ, a fraction ρ of the light survives each
bounce, wherever it lands: paths of j segments deposit Φ ρ^(j−1), so that all stored photons
together carry Φ (ρ + ρ² + …), whatever the shape of the room.
"""

import subprocess
import sys
from pathlib import Path

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.map import photon_word
from aniso_pm.map.photon_map import photon_flux
from aniso_pm.transport import emission, photons

ALBEDO = 0.5
UNLIMITED = 0xFFFFFFFE


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def furnace(flip=False, **emitter):
    """A cube seen from inside, emitting and reflecting."""
    T = mi.ScalarTransform4f
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
    return mi.load_dict(
        {
            "type": "scene",
            "box": {
                "type": "cube",
                "flip_normals": not flip,
                "to_world": T().scale([1, 2, 0.5]),
                "bsdf": bsdf,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
            },
        }
    )


def build(scene, count, seed, max_depth, rr_depth, expected=0, **options):
    defaults = {"caustics": "ignored", "general": False, "roughness": 0.2, "unseen_light": False}
    options = photons.TraceOptions(max_depth, rr_depth, **(defaults | {"bent": False} | options))
    return photons.build_map(scene, emission.prepare(scene), count, seed, options, expected)


def total_flux(map_):
    flux = photon_flux(map_, dr.arange(mi.UInt32, map_.stored), mi.Bool(True))
    return dr.sum(mi.Float64(flux.x))[0] / map_.emitted


# Of the cube above: π × area × radiance.
POWER = np.pi * 2 * (2 * 4 + 4 * 1 + 2 * 1)


def test_stored_flux_is_the_geometric_series():
    map_ = build(furnace(), 100_000, 1, UNLIMITED, 5)
    # Every path deposits POWER·(a geometric number of times): relative standard error 0.6 %.
    assert total_flux(map_) == pytest.approx(POWER * ALBEDO / (1 - ALBEDO), rel=0.02)


@pytest.mark.parametrize("depth", [2, 3, 5])
def test_max_depth_cuts_the_series(depth):
    map_ = build(furnace(), 100_000, 2, depth, 100)
    expected = POWER * sum(ALBEDO**j for j in range(1, depth))
    # Without Russian roulette every path deposits exactly this.
    assert total_flux(map_) == pytest.approx(expected, rel=1e-4)
    words = dr.gather(mi.Vector4f, map_.index.points, dr.arange(mi.UInt32, map_.stored)).w
    segments = photon_word.segments(dr.reinterpret_array(mi.UInt32, words)).numpy()
    assert (segments.min(), segments.max()) == (2, depth)


def test_direct_light_is_not_stored():
    assert build(furnace(), 1000, 3, 1, 5).stored == 0


def test_a_buffer_that_is_too_small_grows_and_loses_nothing():
    scene = furnace()
    roomy = build(scene, 20_000, 4, 6, 100)
    tight = build(scene, 20_000, 4, 6, 100, expected=10)
    assert tight.stored == roomy.stored == 5 * 20_000
    assert total_flux(tight) == pytest.approx(total_flux(roomy), rel=1e-6)


def test_wavefronts_together_equal_one(monkeypatch):
    monkeypatch.setattr(photons, "WAVEFRONT", 3000)
    map_ = build(furnace(), 10_000, 5, 4, 100)
    assert map_.stored == 3 * 10_000
    assert total_flux(map_) == pytest.approx(POWER * (0.5 + 0.25 + 0.125), rel=1e-4)


def test_nothing_is_stored_on_the_back_of_one_sided_surfaces():
    """A lamp in a cube that faces outwards: all light arrives at backs."""
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "box": {"type": "cube", "bsdf": {"type": "diffuse"}},
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, -0.5]),
                "bsdf": {"type": "conductor", "material": "none"},
            },
            "lamp": {
                "type": "sphere",
                "radius": 0.1,
                "bsdf": {"type": "conductor", "material": "none"},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
            },
        }
    )
    assert build(scene, 10_000, 6, UNLIMITED, 5).stored == 0


def test_photons_that_are_not_finite_are_dropped_and_counted():
    class Broken(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.m_components = [mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = mi.BSDFSample3f()
            bs.wo, bs.pdf, bs.eta = mi.reflect(si.wi), mi.Float(1), mi.Float(1)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DeltaReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs, mi.Spectrum(dr.select(sample1 < 0.5, dr.nan, 1)) & active

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(0)

        def pdf(self, ctx, si, wo, active=True):
            return mi.Float(0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return mi.Spectrum(0), mi.Float(0)

    mi.register_bsdf("broken_mirror", lambda props: Broken(props))
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "mirror": {"type": "rectangle", "bsdf": {"type": "broken_mirror"}},
            "floor": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(100),
            },
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.01),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
            },
        }
    )
    map_ = build(scene, 10_000, 7, 2, 5)
    assert map_.rejected > 1000
    assert abs(map_.stored - map_.rejected) < 6 * 100  # one half each
    assert np.isfinite(map_.flux.numpy()).all()


def test_normals_survive_their_encoding():
    rng = np.random.default_rng(0)
    n = rng.normal(size=(10_000, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    n[:6] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    v = mi.Vector3f(np.ascontiguousarray(n.T.astype(np.float32)))
    back = photon_word.decode_normal(photon_word.encode_normal(v) | (77 << 24)).numpy().T
    assert (back * n).sum(1).min() > np.cos(np.radians(0.07))  # 12 bits a coordinate


def test_directions_survive_packing():
    """32 bits octahedral: within 1e-4 rad in every direction."""
    rng = np.random.default_rng(3)
    v = rng.normal(size=(3, 10_000))
    v /= np.linalg.norm(v, axis=0)
    back = photon_word.decode(photon_word.encode(mi.Vector3f(v.astype(np.float32)), 16), 16).numpy()
    assert np.linalg.norm(back - v, axis=0).max() < 1e-4


def test_photons_are_shared_in_proportion_to_power():
    """A lamp of 1 W and one of 99 W: the floor of 5 % is shared evenly, the rest by power. Flux is
    divided by the chance, so their sum stays what it is."""
    lamp = lambda power: {"type": "point", "intensity": power / (4 * np.pi)}  # noqa: E731
    scene = mi.load_dict({"type": "scene", "a": lamp(1.0), "b": lamp(99.0)})
    source = emission.prepare(scene)
    count = 100_000
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    u1, u2, u3 = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    _, flux, _ = source.sample_ray(mi.Float(0), u1, u2, u3)
    flux = flux.x.numpy()
    assert np.mean(flux < 50) == pytest.approx(0.95 * 0.01 + 0.025, abs=0.003)
    assert flux.mean() == pytest.approx(100, rel=0.01)


def test_faces_is_the_cosine_of_the_decoded_normal():
    rng = np.random.default_rng(4)
    a, b = (rng.normal(size=(3, 20000)).astype(np.float32) for _ in range(2))
    b[:, ::2] = a[:, ::2] + 0.8 * b[:, ::2]  # half of them near the threshold
    a, b = (mi.Normal3f(v / np.linalg.norm(v, axis=0)) for v in (a, b))
    word = photon_word.encode_normal(a) | (5 << 24) | (1 << 31)
    cosine = np.sum(np.array(photon_word.decode_normal(word)) * np.array(b), axis=0)
    clear = np.abs(cosine - 0.75) > 1e-5
    np.testing.assert_array_equal(photon_word.faces(word, b).numpy()[clear], (cosine > 0.75)[clear])


_CURVES = """
import sys
import aniso_pm
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
sys.path.insert(0, sys.argv[1])
import matrix

scene = matrix.make(matrix.rows()["curve"])
prepared = prepare(scene, Settings(map="global", photon_count=200_000), False)
for index in range(6):
    prepared.photon_map(7, index)
"""


def test_paths_that_leave_curves_end_no_process():
    """Rays from a few ulps off a curve did, now and then, and always with one thread."""
    command = [sys.executable, "-c", _CURVES, str(Path(__file__).parent)]
    assert subprocess.run(command, timeout=300).returncode == 0
