"""Photons/s of the spatial index's construction."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
from aniso_pm.map import index as spatial

from . import walls
from .row import Row
from .timing import interleaved, run


def measure(quick: bool) -> Iterator[Row]:
    yield _build(1_000_000, 10.0, 3 if quick else 7)
    if not quick:
        yield _build(30_000_000, 7.0, 2)


def _build(count: int, bound: float, repetitions: int) -> Row:
    # Not walls.even: that would take 3 GB for 3e7 points.
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    x, y, wall = sampler.next_1d(), sampler.next_1d(), mi.UInt32(sampler.next_1d() * walls.WALLS)
    axis, far = wall >> 1, mi.Float(wall & 1)
    points = mi.Point3f(
        dr.select(axis == 0, far, x),
        dr.select(axis == 1, far, dr.select(axis == 0, x, y)),
        dr.select(axis == 2, far, y),
    )
    word = dr.zeros(mi.UInt32, count)
    dr.eval(points, word)

    def task():
        index, order = spatial.build(points, word)
        return index.points, index.boxes, order

    times = interleaved({"build": lambda: run(task)}, repetitions)["build"]
    return Row(
        f"build: index over {count:g} photons",
        count / times.best * 1e-6,
        "M/s",
        (">=", bound),
        f"photons on five walls in random order, best of {repetitions}: {times}",
    )
