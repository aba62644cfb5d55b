"""Samples of pixels: as many as were asked for, each once, and no picture depends on how many."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import allotment, pilot
from aniso_pm.rendering import film as films
from aniso_pm.rendering.allotment import Allotment
from passes import SMALL
from rooms import room_with_ball


def lanes(found, passes=3, most=1 << 20, more=0):
    """{(pixel, sample)} of some passes, as a list."""
    taken = []
    for index in range(passes):
        for wavefront, _ in found.wavefronts(index, more, more * index, most):
            pairs = zip(wavefront.pixel.numpy(), wavefront.sample.numpy(), strict=True)
            taken += [(int(p), int(s)) for p, s in pairs]
    return taken


@pytest.mark.parametrize("most", [1 << 20, 40, 7])
@pytest.mark.parametrize("more", [0, 1])
def test_every_sample_of_every_pixel_is_taken_once(variant_llvm_rgb, most, more):
    """Whatever fits into a wavefront: the whole pass, some samples of all pixels, some pixels."""
    uneven = np.array([3, 1, 5, 2, 8, 1, 1, 3, 4, 2])
    for found in (Allotment(10, 3), Allotment(10, 3, uneven)):
        counts = np.full(10, 3) if found.counts is None else uneven
        wanted = {(p, s) for p, n in enumerate(counts) for s in range(3 * (n + more))}
        taken = lanes(found, most=most, more=more)
        assert len(taken) == len(set(taken))
        assert set(taken) == wanted


def test_weights_make_up_for_numbers(variant_llvm_rgb):
    """Density times weight is the same in every pixel."""
    counts = np.array([1, 2, 4, 9])
    [(found, done)] = Allotment(4, 4, counts).wavefronts(0, 0, 0, 1 << 20)
    total = np.bincount(found.pixel.numpy(), found.weight.numpy())
    np.testing.assert_allclose(total, 4, rtol=1e-6)
    assert done == 1


def test_wavefronts_of_uneven_samples_are_alike(variant_llvm_rgb):
    """Full, and of about one size: what is frozen is traced anew for other ones."""
    counts = np.repeat([8, 64, 128], [900, 90, 10])
    for most in (1000, 1500, 4000):
        parts = [w.count for w, _ in Allotment(1000, 14, counts).wavefronts(0, 0, 0, most)]
        assert sum(parts) == counts.sum()
        assert max(parts) <= most and min(parts) > 0.85 * most * counts.sum() / sum(parts)


def test_few_wavefronts_are_traced_in_python(variant_llvm_rgb, monkeypatch):
    """Uneven samples in many wavefronts: replayed, not traced anew for every size."""
    scene = mi.load_dict(room_with_ball(size=32))
    random = np.random.default_rng(3)
    counts = random.integers(4, 29, films.pixel_count(scene.sensors()[0].film()))
    frozen, before = [], []

    def settled(*args):
        found = replace(pilot.settle(*args), counts=counts)
        before.extend(function.n_recordings for function in frozen)
        return found

    def freeze(function, **options):
        frozen.append(dr_freeze(function, **options))
        return frozen[-1]

    dr_freeze = dr.freeze
    monkeypatch.setattr("aniso_pm.rendering.beginning.settle", settled)
    monkeypatch.setattr("aniso_pm.rendering.beginning.WAVEFRONT", 1 << 11)
    monkeypatch.setattr("drjit.freeze", freeze)
    plugin = mi.load_dict(SMALL | {"passes": 2, "map": "global"})
    mi.render(scene, integrator=plugin, spp=2 * 16)
    assert plugin.statistics["replayed"]
    after = [function.n_recordings for function in frozen]
    assert len(after) == 3 and max(np.subtract(after, before)) <= 1


def test_numbers_follow_noise_within_bounds():
    random = np.random.default_rng(0)
    noise = random.lognormal(0, 1.5, 20_000)
    counts = allotment.in_proportion(noise, 16)
    assert counts.sum() == 16 * noise.size
    assert counts.min() >= 3 and counts.max() <= 16 * allotment.MOST + 8
    order = np.argsort(noise)
    assert counts[order[-5000:]].mean() > 3 * counts[order[:5000]].mean()
    assert allotment.in_proportion(noise, 3) is None
    assert allotment.in_proportion(np.zeros(4), 16) is None


@pytest.mark.parametrize("filter_", ["box", "gaussian"])
def test_uneven_samples_converge_to_the_same_picture(variant_llvm_rgb, monkeypatch, filter_):
    """Against even samples, numbers drawn at random: what a pixel gets does not depend on its
    number, in filters that reach over pixels neither."""
    definition = room_with_ball(size=16)
    definition["sensor"]["film"]["rfilter"] = {"type": filter_}
    scene = mi.load_dict(definition)
    random = np.random.default_rng(3)

    def picture(counts, seed=1):
        def settled(*args):
            return replace(pilot.settle(*args), counts=counts)

        monkeypatch.setattr("aniso_pm.rendering.beginning.settle", settled)
        plugin = mi.load_dict(SMALL | {"passes": 2, "max_depth": 2})
        image = mi.render(scene, integrator=plugin, spp=2 * 64, seed=seed)
        return np.array(image, dtype=np.float64), plugin.statistics

    even, another = picture(None)[0], picture(None, seed=2)[0]
    pixels = films.pixel_count(scene.sensors()[0].film())
    uneven, statistics = picture(random.integers(24, 105, pixels))
    assert statistics["spp"] == 128
    assert abs(uneven.mean() / even.mean() - 1) < 0.003  # 0.1 % of noise
    # As far from it as another seed, a quarter more for the pixels that have fewer samples.
    spread = np.sqrt(np.mean((another - even) ** 2))
    assert np.sqrt(np.mean((uneven - even) ** 2)) < 1.5 * spread
