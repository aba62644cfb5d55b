"""What a cluster would do: the model, the simulation, and the command that prints them."""

import json

import pytest
from aniso_pm import cli
from aniso_pm.distributed.model import Conditions, Costs, predict, simulate

CALM = Conditions(spread=0.0, stragglers=0.0, deaths=0.0)


@pytest.mark.parametrize("workers", [1, 64])
def test_workers_that_nothing_limits_render_at_their_own_speed(workers):
    """Five-second tasks of 0.4 s passes, sums of 29 MB: what is lost are overheads."""
    conditions = Conditions(workers, spread=0.0, stragglers=0.0, deaths=0.0)
    model = predict(Costs(), conditions)
    assert model["bottleneck"] == "workers"
    assert 0.97 < model["passes a second"] / (workers / 0.4) < 1
    # Tasks that have not ended at the end do not count: up to one each, of 60 in five minutes.
    played = simulate(Costs(), conditions, seconds=300)
    assert played["passes a second"] == pytest.approx(model["passes a second"], rel=0.03)


def test_the_scheduler_is_the_first_limit_of_many_workers_with_short_tasks():
    conditions = Conditions(500, task_seconds=1.0, spread=0.0, stragglers=0.0, deaths=0.0)
    model = predict(Costs(), conditions)
    assert model["bottleneck"] == "scheduler" and "--task-seconds" in model["advice"]
    assert model["workers that one scheduler serves"] < 500
    played = simulate(Costs(), conditions, seconds=60)
    assert played["client busy"] > 0.95 and played["workers waiting"] > 0.2
    assert played["passes a second"] == pytest.approx(model["passes a second"], rel=0.1)
    longer = predict(Costs(), Conditions(500, task_seconds=10.0))
    assert longer["bottleneck"] == "workers"


def test_large_films_are_limited_by_what_comes_home():
    """4096 × 4096: 1.6 GB, 14 s over a network of 117 MB/s."""
    costs = Costs(pass_seconds=20, pixels=4096**2)
    assert costs.sum_bytes == 4096**2 * 4 * 3 * 8
    model = predict(costs, Conditions(64))
    assert model["bottleneck"] == "client" and "--save-every" in model["advice"]
    assert predict(costs, Conditions(64, home_every=600.0))["bottleneck"] == "workers"


def test_deaths_cost_what_was_not_yet_home():
    often = simulate(Costs(), Conditions(64, deaths=20.0), seconds=300)
    assert often["deaths"] > 30 and 0.01 < often["passes lost"] < 0.2
    assert often["efficiency"] < simulate(Costs(), CALM, seconds=300)["efficiency"] - 0.05
    assert simulate(Costs(), CALM, seconds=60)["passes lost"] == 0


def test_the_command_prints_model_and_simulation(capfd):
    arguments = ["cluster", "-w", "64", "--seconds", "60", "--size", "320x240"]
    assert cli.main(arguments) == 0
    out, _ = capfd.readouterr()
    assert "64 workers: " in out and "first limit: workers" in out and "7.4 MB" in out
    assert cli.main([*arguments, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["costs"]["pixels"] == 320 * 240 and told["rows"][0]["workers"] == 64


@pytest.mark.parametrize(
    "arguments, part",
    [
        (["cluster", "--size", "large"], "--size takes WxH"),
        (["cluster", "-w", "0"], "--workers"),
        (["render", "s.xml", "-o", "a.exr", "--workers", "0"], "--workers"),
    ],
)
def test_wrong_usage_is_one_clear_line(capfd, arguments, part):
    assert cli.main(arguments) == 2
    out, error = capfd.readouterr()
    assert out == "" and error.count("\n") == 1 and part in error


@pytest.mark.parametrize(
    "options, parts",
    [
        (["--workers", "2", "--scheduler", "tcp://x"], ["--workers and --scheduler", "one of"]),
        (["--tls-key", "k.pem"], ["--tls-", "only with --scheduler"]),
        (["--mixed", "--task-seconds", "2"], ["--mixed, --task-seconds", "only with", "--workers"]),
        (["--scheduler-file", "no.json", "--passes", "2"], ["no.json", "no such file"]),
    ],
)
def test_options_of_workers_that_contradict_each_other(tmp_path, capfd, options, parts):
    from command_line import OURS, SCENE

    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.replace("{integrator}", OURS).replace("{extra}", ""))
    assert cli.main(["render", str(scene), "-o", str(tmp_path / "a.exr"), *options]) == 2
    out, error = capfd.readouterr()
    for part in parts:
        assert part in error
    assert error.count("\n") == 1 and not (tmp_path / "a.exr").exists()
