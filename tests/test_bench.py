"""The benchmark: its rivals count the same photons, its verdicts follow from its figures."""

import json
import sys
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.instruments.bench import GROUPS, errors, grid, kernels, memory, rooms, timing, walls
from aniso_pm.instruments.bench.row import Row, as_data, line, summary
from aniso_pm.map import index as spatial


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


# --- Rows ---


def test_a_verdict_follows_from_figure_and_target():
    assert Row("a", 0.9, "×", (">=", 0.8)).met is True
    assert Row("a", 0.7, "×", (">=", 0.8)).met is False
    assert Row("a", 64, "B", ("<=", 64)).met is True
    assert Row("a", 0.3, "s", ("<", 0.3)).met is False
    assert Row("a", 0.7, "×").met is None
    assert Row("a", None, "×", (">=", 0.8)).met is None


def test_text_and_data_say_the_same():
    rows = [Row("gather: a", 0.7123, "×", (">=", 0.85), "note"), Row("b", None, "×", ("<", 1))]
    assert line(rows[0]).split() == ["missed", "0.7123", "×", ">=", "0.85", "gather:", "a", "note"]
    assert line(rows[1]).split() == ["-", "-", "×", "<", "1", "b"]
    assert as_data(rows[0]) == {
        "name": "gather: a",
        "figure": 0.7123,
        "unit": "×",
        "target": ">= 0.85",
        "met": False,
        "note": "note",
    }
    assert summary(rows) == "0 of 1 targets met"


def test_tasks_take_turns_after_a_round_that_does_not_count():
    calls = []

    def task(name, seconds):
        return lambda: calls.append(name) or seconds.pop(0)

    times = timing.interleaved({"a": task("a", [9, 2, 3]), "b": task("b", [8, 1, 5])}, 2)
    assert calls == ["a", "b"] * 3
    assert times["a"].seconds == [2, 3] and times["b"].best == 1 and times["b"].median == 3


# --- Data ---


def test_walls_hold_what_they_promise():
    rng = np.random.default_rng(0)
    places = walls.uneven(rng, 20_000, walls.CROWD)
    on_wall = (places.position[:, None] == np.float32([[0], [1]])).any(1)  # (N, 3)
    assert (on_wall.any(1)).all()
    assert np.allclose(np.linalg.norm(places.normal, axis=1), 1)
    # The normal belongs to an axis along which the point lies on a wall, and points inwards.
    axis = np.abs(places.normal).argmax(1)
    at = places.position[np.arange(len(axis)), axis]
    assert np.array_equal(places.normal[np.arange(len(axis)), axis], 1 - 2 * at)
    # 99 % ± 4 standard errors in 1 % of the area
    side = walls.CROWD_AREA**0.5
    x, y, z = places.position.T
    inside = (x == 0) & (np.abs(y - 0.5) < side / 2) & (np.abs(z - 0.5) < side / 2)
    assert np.array_equal(inside, places.crowded)
    assert inside.mean() == pytest.approx(0.99, abs=0.003)
    assert walls.CROWD_AREA / walls.WALLS == pytest.approx(0.01)


def brute_force(places, e):
    """Number of points inside each ellipse, all pairs in double precision."""
    center, a, b, c = (np.array(v).T.astype(np.float64) for v in (e.center, e.a, e.b, e.c))
    d = places.position[None].astype(np.float64) - center[:, None]
    rho2 = np.einsum("qpk,qk->qp", d, a) ** 2 + np.einsum("qpk,qk->qp", d, b) ** 2
    flat = np.abs(np.einsum("qpk,qk->qp", d, c))
    return ((rho2 <= walls.CUT2) & (flat <= 1)).sum(1), np.exp(-rho2) * (rho2 <= walls.CUT2) * (
        flat <= 1
    )


@pytest.mark.parametrize("crowd", [False, True])
def test_grid_and_index_find_what_brute_force_finds(crowd):
    rng = np.random.default_rng(3)
    n, queries = 20_000, 400
    if crowd:
        inside, outside = walls.uneven_radii(n)
        places = walls.uneven(rng, n, walls.CROWD)
        at = walls.uneven(rng, queries, 0.5, outside)
        radius = np.where(at.crowded, inside, outside)
    else:
        places, at = walls.even(rng, n), walls.even(rng, queries)
        radius = np.full(queries, walls.even_radius(n))
    e = walls.ellipses(rng, at, radius, 1)
    points, word = places.points(), dr.zeros(mi.UInt32, n)
    visit, zero = walls.visitor(dr.full(mi.Float, 1, 4 * n))
    index, _ = spatial.build(points, word)
    cells = grid.build(points, word, float(radius.max()))
    found = {
        "index": spatial.gather(index, e, walls.CUT2, visit, zero, mi.Bool(True)),
        "grid": grid.gather(cells, e, walls.CUT2, visit, zero, False),
        "rows": grid.gather(cells, e, walls.CUT2, visit, zero, True),
    }
    expected, weight = brute_force(places, e)
    # Kernels at edges hold fewer or, from two walls, more.
    assert expected.mean() == pytest.approx(walls.PER_QUERY, rel=0.2)
    for name, (power, count) in found.items():
        # A photon within rounding of the rim may go either way.
        assert np.abs(count.numpy().astype(int) - expected).sum() <= 3, name
        assert np.allclose(power.x.numpy(), weight.sum(1), rtol=1e-3, atol=0.1), name
    assert not dr.any(zero[0].x != 0)  # sums must not leak into the next one


# --- What is measured ---


def test_a_plain_room_compiles_the_same_kernels_for_both_kernel_types():
    plain = mi.load_dict(rooms.room(8))
    assert kernels.hashes(plain, "anisotropic") == kernels.hashes(plain, "isotropic")
    metal = mi.load_dict(rooms.brushed_back(8))
    assert kernels.hashes(metal, "anisotropic") != kernels.hashes(metal, "isotropic")


def test_a_map_takes_at_most_64_bytes_a_photon_at_its_peak():
    found = memory.in_process("map_memory", 700_000)
    assert found["stored"] > 1_000_000
    # The measurement is not blind: at rest the map is there.
    assert found["at_rest"] * 0.9 <= found["resident"] / found["stored"] <= 64


def test_unknown_groups_are_named(capsys):
    assert cli.main(["bench", "speed"]) == 2
    message = capsys.readouterr().err
    assert "'speed'" in message and all(group in message for group in GROUPS)
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["pass", "--scene", "any.xml"], "--scene is for the group error"),
        (["error", "--scene", "missing.xml"], "missing.xml"),
        (["error", "-D", "width=4"], "--scene"),
    ],
)
def test_scenes_are_for_the_group_error_and_have_to_be_there(capsys, given, said):
    assert cli.main(["bench", *given]) == 2
    assert said in capsys.readouterr().err


def test_a_scene_without_reference_is_refused_with_how_to_make_one(own_cache, write_scene, capsys):
    scene = write_scene()
    command = ["bench", "error", "--quick", "--scene", str(scene), "--json"]
    assert cli.main(command) == 2
    assert "aniso-pm reference" in capsys.readouterr().err
    size = ["-D", "width=12"]
    assert cli.main(["reference", str(scene), "--spp", "16", "--quiet", *size]) == 0
    assert cli.main(command) == 2  # of another size
    assert cli.main(["bench", "--quick", *size]) == 2
    assert "--scene" in capsys.readouterr().err
    capsys.readouterr()
    assert cli.main([*command, *size]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert all("reference's own error" in row["note"] for row in rows)


def test_a_run_without_a_picture_in_time_is_a_note_and_no_number(
    own_cache, write_scene, capsys, monkeypatch
):
    scene = write_scene()
    assert cli.main(["reference", str(scene), "--spp", "16", "--quiet"]) == 0
    run = errors.runs.run

    def late(stage, method, *given):
        found = run(stage, method, *given)
        return found if method.name == "path" else replace(found, passes=[0])

    monkeypatch.setattr(errors.runs, "run", late)
    monkeypatch.setattr(errors.runs, "warm_up", lambda *_: None)
    capsys.readouterr()
    assert cli.main(["bench", "error", "--quick", "--scene", str(scene), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows and all(row["figure"] is None for row in rows)
    for words in ("in 3 of 3 runs", "reference's own error"):
        assert all(words in row["note"] for row in rows)


def test_bench_prints_json(capsys):
    assert cli.main(["bench", "kernels", "--quick", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {"name", "figure", "unit", "target", "met", "note"} == set(rows[0])
    assert [row["name"].split(":")[0] for row in rows] == ["kernels"] * 2
    assert rows[0]["target"] == "<= 0" and rows[0]["met"] is True


def test_what_is_not_installed_is_a_row_with_a_note(capsys, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("aniso_pm.instruments.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "aniso_pm.instruments.bench.errors", raising=False)
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert cli.main(["bench", "error", "--quick", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["figure"] is None and "pip install 'aniso-pm[report]'" in row["note"]


@pytest.mark.slow
def test_the_whole_benchmark_runs_quickly(capsys):
    assert cli.main(["bench", "all", "--quick", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"].split(":")[0] for row in rows} == set(GROUPS)
    # Large pictures are too slow for that, and say so.
    quick = [row for row in rows if not row["name"].startswith("large")]
    assert all(row["figure"] is not None for row in quick), quick
