"""Queries/s of the spatial index against a dense grid and against scipy's k-d tree.

All of it on five walls (``walls``), queries in random order, which the index puts in order first,
as the integrator does: the time for that is counted. Flux is gathered and weighted for all alike.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.map import index as spatial

from . import grid, rooms, walls
from .row import Row
from .timing import Times, interleaved, run

ASPECTS = {1: 1.0, 16: 0.85, 64: 0.6}
# Of the sums over nodes.
TOLERANCE = 0.2


def measure(quick: bool) -> Iterator[Row]:
    photons, queries, repetitions = (200_000, 50_000, 3) if quick else (1_000_000, 250_000, 7)
    speed: dict[Any, float] = {}
    yield from _even(photons, queries, repetitions, speed)
    yield from _uneven(photons, queries, repetitions, speed)
    yield _large_kernels(100_000 if quick else 1_000_000, repetitions)


def _ours(index, e, visit, total):
    """Queries in order, and the sum over the index."""
    order = spatial.curve_order(e.center)
    e = spatial.Ellipses(*(dr.gather(type(v), v, order) for v in (e.center, e.a, e.b, e.c)))
    dr.eval(e.center, e.a, e.b, e.c)
    return spatial.gather(index, e, walls.CUT2, visit, total, mi.Bool(True))


def _even(photons, queries, repetitions, speed) -> Iterator[Row]:
    rng = np.random.default_rng(1)
    places, at = walls.even(rng, photons), walls.even(rng, queries)
    radius = walls.even_radius(photons)
    points, word = places.points(), dr.zeros(mi.UInt32, photons)
    flux = dr.full(mi.Float, 1, 4 * photons)
    dr.eval(points, word, flux)
    index, _ = spatial.build(points, word)
    cells = grid.build(points, word, radius)
    visit, zero = walls.visitor(flux)
    ellipses = {aspect: walls.ellipses(rng, at, radius, aspect) for aspect in ASPECTS}

    def ours(e) -> float:
        return run(lambda: _ours(index, e, visit, zero))

    def gridded(rows: bool) -> float:
        return run(lambda: grid.gather(cells, ellipses[1], walls.CUT2, visit, zero, rows))

    tasks: dict[Any, Any] = {aspect: partial(ours, e) for aspect, e in ellipses.items()}
    tasks |= {"grid": partial(gridded, False), "rows": partial(gridded, True)}
    # The tree is slow: few queries tell its speed.
    few = min(queries, 20_000)
    tree = _scipy_tree(places.position)
    if tree is not None:
        tasks["scipy"] = lambda: _scipy_seconds(tree, at.position[:few], radius)
    times = interleaved(tasks, repetitions)
    speed |= {name: (few if name == "scipy" else queries) / t.best for name, t in times.items()}

    found = float(np.mean(_ours(index, ellipses[1], visit, zero)[1].numpy()))
    sizes = f"{photons:g} photons, {queries:g} queries, {found:.1f} photons a query"
    rounds = f"best of {repetitions}"

    def note(*names) -> str:
        return "; ".join(_said(name, speed[name], times[name]) for name in names)

    yield Row(
        "gather: aspect 1 against a dense grid",
        speed[1] / speed["grid"],
        "×",
        (">=", 1.0),
        f"{sizes}, {rounds}: {note(1, 'grid')}",
    )
    yield Row(
        "gather: aspect 1 against a grid that merges rows of cells",
        speed[1] / speed["rows"],
        "×",
        None,
        note("rows"),
    )
    if tree is None:
        missing = "scipy is not installed: pip install 'aniso-pm[report]'"
        yield Row("gather: aspect 1 against scipy's cKDTree", None, "×", (">=", 8.0), missing)
    else:
        yield Row(
            "gather: aspect 1 against scipy's cKDTree",
            speed[1] / speed["scipy"],
            "×",
            (">=", 8.0),
            f"query_ball_point, all cores, counting only, {few:g} queries: {note('scipy')}",
        )
    for aspect, bound in ASPECTS.items():
        if aspect > 1:
            yield Row(
                f"gather: aspect {aspect} against aspect 1",
                speed[aspect] / speed[1],
                "×",
                (">=", bound),
                note(aspect),
            )


def _uneven(photons, queries, repetitions, speed) -> Iterator[Row]:
    rng = np.random.default_rng(2)
    places = walls.uneven(rng, photons, walls.CROWD)
    # Half of the queries where the photons are, half where they are not; none reaches from there
    # into the crowd, or it would find thousands.
    inside, outside = walls.uneven_radii(photons)
    at = walls.uneven(rng, queries, 0.5, outside)
    radius = np.where(at.crowded, inside, outside)
    points, word = places.points(), dr.zeros(mi.UInt32, photons)
    flux = dr.full(mi.Float, 1, 4 * photons)
    dr.eval(points, word, flux)
    index, _ = spatial.build(points, word)
    visit, zero = walls.visitor(flux)
    e = walls.ellipses(rng, at, radius, 1)

    # The cells hold up to a sixth of all photons: a few queries of the grid take long enough.
    few = 256
    cells = grid.build(points, word, outside)
    e_few = walls.ellipses(rng, at.some(few), radius[:few], 1)
    rival = interleaved(
        {"g": lambda: run(lambda: grid.gather(cells, e_few, walls.CUT2, visit, zero, True))}, 1
    )["g"]

    times = interleaved({"uneven": lambda: run(lambda: _ours(index, e, visit, zero))}, repetitions)
    ours = queries / times["uneven"].best
    found = float(np.mean(_ours(index, e, visit, zero)[1].numpy()))
    yield Row(
        "gather: uneven density, aspect 1, against even density",
        ours / speed[1],
        "×",
        (">=", 0.5),
        f"99 % of {photons:g} photons in 1 % of the area, half of the queries there, radius by "
        f"density, {found:.1f} photons a query, best of {repetitions}: "
        f"{_said('uneven', ours, times['uneven'])}; the bound is this benchmark's own",
    )
    yield Row(
        "gather: uneven density against a grid that merges rows of cells",
        ours / (few / rival.best),
        "×",
        None,
        f"cells as large as the largest kernel, {few} queries: "
        f"{_said('grid', few / rival.best, rival)}",
    )


def _large_kernels(photons: int, repetitions: int) -> Row:
    """Sums over nodes against sums over photons, in a picture with thousands of them a kernel."""
    scene = mi.load_dict(rooms.glass_and_metal(48))
    common = {"type": "aniso_pm", "photon_count": photons, "initial_radius": 0.07}
    integrators = {
        tolerance: mi.load_dict(common | {"gather_tolerance": tolerance})
        for tolerance in (0.0, TOLERANCE)
    }

    def gather(integrator) -> float:
        integrator.render(scene, spp=4)
        return integrator.statistics["seconds"]["gather"]

    tasks = {tolerance: partial(gather, plugin) for tolerance, plugin in integrators.items()}
    times = interleaved(tasks, repetitions)
    exact, taken = (np.array(i.render(scene, spp=4)).mean() for i in integrators.values())
    counts = integrators[0.0].statistics
    return Row(
        f"gather: gather_tolerance={TOLERANCE:g} against the exact sum",
        times[0.0].best / times[TOLERANCE].best,
        "×",
        None,
        f"{counts['photons_gathered'] / counts['gather_points']:,.0f} photons a kernel, stage "
        f"gather of a picture, best of {repetitions}: exact {times[0.0]}, with sums "
        f"{times[TOLERANCE]}; "
        f"mean of the picture {taken / exact - 1:+.1e}",
    )


def _said(name, speed: float, times: Times) -> str:
    name = f"aspect {name}" if isinstance(name, int) else name
    return f"{name} {speed * 1e-6:.3g} M queries/s, {times}"


def _scipy_tree(position: np.ndarray):
    try:
        from scipy.spatial import cKDTree
    except ImportError:
        return None
    return cKDTree(position)


def _scipy_seconds(tree, position: np.ndarray, radius: float) -> float:
    began = time.perf_counter()
    tree.query_ball_point(position, radius, workers=-1, return_length=True)
    return time.perf_counter() - began
