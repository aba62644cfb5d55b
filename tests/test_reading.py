"""What pairs of eye paths read from photon maps before the first pass."""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
from aniso_pm.rendering import pairs, reading
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from rooms import room_with_ball


def test_a_part_of_the_pairs_reads_what_all_would_read_there(variant_llvm_rgb, monkeypatch):
    scene = mi.load_dict(room_with_ball(size=64))
    exact = Settings(edge_compensation=False)  # probes of edges are random
    prepared = replace(prepare(scene, exact, False), chosen="survey")
    sensor = scene.sensors()[0]
    seen = pairs.look(prepared, sensor, 0)
    photons = prepared.with_(photon_count=1000)
    maps = [photons.photon_map(0, k, 0, None, remember=True) for k in (0, 1)]
    everyone = reading.Reader.of_all(prepared, sensor, None, 0, seen.tiles)
    few = everyone.of_every_fourth(seen.points)
    assert everyone.pairs.size == 4 * few.pairs.size
    monkeypatch.setattr(reading, "_MET_BY_ALL", math.inf)
    all_, some = (
        reader.found(maps, seen.points, lambda gathered: np.ones(len(gathered)))
        for reader in (everyone, few)
    )
    assert some.light.max() > 0
    for name in ("a", "b", "wide_a", "wide_b", "met", "points"):
        expected = getattr(all_, name)[few.pairs]
        np.testing.assert_allclose(getattr(some, name), expected, rtol=1e-4, atol=1e-6)
    corners = few.spread(some.wide_a)[few.pairs]
    np.testing.assert_allclose(corners[:, 0], some.wide_a.mean(1))
    monkeypatch.setattr(reading, "_TELL", 1e6)
    assert everyone.of_every_fourth(seen.points) is None
