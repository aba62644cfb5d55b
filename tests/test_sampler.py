"""The sampler: Owen-scrambled Sobol points that go on over passes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import qmc


def points(pixels, samples, seed=3, first_sample=0, first_pixel=0, skip=0):
    """(pixels, samples, 2) of one pair of dimensions, after ``skip`` pairs."""
    sampler = mi.load_dict({"type": "owen_sobol"})
    lane = dr.arange(mi.UInt32, pixels * samples)
    sampler.begin(seed, lane // samples + first_pixel, lane % samples + first_sample)
    for _ in range(skip):
        sampler.next_2d()
    return np.array(sampler.next_2d()).T.reshape(pixels, samples, 2)


def test_every_elementary_interval_holds_one_point(variant_llvm_rgb):
    """The definition of a (0, m, 2)-net in base 2, for consecutive powers of two of samples."""
    for first in (0, 64, 192):
        for pixel in points(5, 64, first_sample=first, skip=2):
            for k in range(7):
                cells = np.floor(pixel * [2**k, 64 // 2**k]).astype(int)
                assert len({tuple(cell) for cell in cells}) == 64


def test_one_dimension_is_stratified(variant_llvm_rgb):
    sampler = mi.load_dict({"type": "owen_sobol", "sample_count": 32})
    sampler.seed(1, 4 * 32)
    for pixel in sampler.next_1d().numpy().reshape(4, 32):
        assert sorted((pixel * 32).astype(int)) == list(range(32))


def test_points_are_those_of_sobol_up_to_scrambling(variant_llvm_rgb):
    """The unscrambled points of SciPy's generator fall into the same pattern of bits: which points
    share their leading bits with which is what an Owen scrambling keeps."""
    from aniso_pm.plugins import sampler as plugin

    index = mi.UInt32(np.arange(256, dtype=np.uint32))
    with np.errstate(all="ignore"):
        ours = np.stack([dr.brev(index).numpy(), plugin._second(index).numpy()], -1) / 2.0**32
    theirs = qmc.Sobol(2, scramble=False).random(256)
    # SciPy's sequence is in the order of Gray's code: the same set.
    assert {tuple(p) for p in ours} == {tuple(p) for p in theirs}


def test_parts_of_a_sequence_join(variant_llvm_rgb):
    whole = points(6, 16)
    parts = [points(6, 4, first_sample=4 * k) for k in range(4)]
    np.testing.assert_array_equal(np.concatenate(parts, 1), whole)
    np.testing.assert_array_equal(points(2, 16, first_pixel=4), whole[4:])


def test_pixels_dimensions_and_seeds_are_independent(variant_llvm_rgb):
    """Correlations of 4096 points are below four standard errors of independent ones."""
    a = points(4096, 1)[:, 0, 0]
    for other in (points(4096, 1, skip=1)[:, 0, 0], points(4096, 1, seed=4)[:, 0, 0]):
        assert abs(np.corrcoef(a, other)[0, 1]) < 4 / 64
    assert abs(np.corrcoef(a[1:], a[:-1])[0, 1]) < 4 / 64
    assert abs(a.mean() - 0.5) < 4 * 12**-0.5 / 64


@pytest.mark.parametrize("spp", [16, 13])
def test_path_renders_with_it(variants_all, spp):
    """Same mean as with independent samples, less noise (a room under an area light)."""
    from rooms import room

    def picture(sampler, seed):
        scene = mi.load_dict(room(size=16))
        sensor = scene.sensors()[0]
        assert sensor is not None
        definition = room(size=16)
        definition["sensor"]["sampler"] = {"type": sampler, "sample_count": spp}
        if mi.is_monochromatic:
            definition["sensor"]["film"]["pixel_format"] = "luminance"
        scene = mi.load_dict(definition)
        plugin = mi.load_dict({"type": "path", "max_depth": 2})
        return np.array(mi.render(scene, integrator=plugin, seed=seed), dtype=np.float64)

    plain = np.array([picture("independent", seed) for seed in range(6)])
    ours = np.array([picture("owen_sobol", seed) for seed in range(6)])
    assert abs(ours.mean() / plain.mean() - 1) < 0.02
    # Spectral noise of wavelengths remains.
    factor = 0.9 if mi.is_spectral else 0.6
    assert ours.var(0, ddof=1).mean() < factor * plain.var(0, ddof=1).mean()


def test_samples_asked_for_are_taken(variant_llvm_rgb, monkeypatch):
    """``mi.render(spp=…)`` is more than the sampler was made for, or less."""
    from rooms import room

    definition = room(size=16)
    definition["sensor"]["sampler"] = {"type": "owen_sobol", "sample_count": 8}
    scene = mi.load_dict(definition)
    kind, sizes = type(scene.sensors()[0].sampler()), []
    seed = kind.seed
    monkeypatch.setattr(kind, "seed", lambda self, *a: sizes.append(a[-1]) or seed(self, *a))
    for spp in (32, 8, 5):
        mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=spp)
    assert [size for size in sizes if size != 1] == [32 * 256, 8 * 256, 5 * 256]
    assert scene.sensors()[0].sampler().sample_count() == 5
