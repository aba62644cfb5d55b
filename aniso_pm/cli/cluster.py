"""``aniso-pm cluster``: what a cluster would do, before there is one."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from aniso_pm.errors import InputError


def cluster(
    workers: Annotated[
        list[int] | None,
        typer.Option("--workers", "-w", min=1, max=100_000, help="Numbers of workers."),
    ] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of the film.")] = "640x480",
    pass_seconds: Annotated[
        float | None, typer.Option(min=1e-3, max=1e6, help="Seconds of a pass on one worker.")
    ] = None,
    task_seconds: Annotated[
        float, typer.Option(min=0.01, max=1e6, help="Seconds of a task.")
    ] = 5.0,
    save_every: Annotated[
        float, typer.Option(min=1, max=1e6, help="Seconds between two times that sums come home.")
    ] = 30.0,
    bandwidth: Annotated[
        float, typer.Option(min=0.1, max=1e6, help="Megabytes a second between two machines.")
    ] = 117.0,
    deaths: Annotated[
        float, typer.Option(min=0, max=1e3, help="Deaths of a worker in an hour.")
    ] = 0.1,
    stragglers: Annotated[
        float, typer.Option(min=0, max=1, help="Share of tasks that take five times as long.")
    ] = 0.01,
    seconds: Annotated[
        float, typer.Option(min=1, max=86_400, help="Length of the simulation.")
    ] = 600.0,
    measure: Annotated[
        bool, typer.Option("--measure", help="Measure the costs on this machine first.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """How many passes a second so many workers would render, and what would limit them.

    By arithmetic, and by a simulation with workers of uneven speed that straggle and die. Costs are
    those of docs/clusters.md, or, with --measure, partly measured on this machine with a local
    cluster of two workers, which takes some minutes.
    """
    from dataclasses import asdict, replace

    from aniso_pm.distributed.model import Conditions, Costs, table
    from aniso_pm.pictures import output

    width, by, height = size.partition("x")
    if not (by and width.isdigit() and height.isdigit() and int(width) * int(height) > 0):
        raise InputError(f"--size takes WxH, such as 640x480, not '{size}'")
    costs = Costs(pixels=int(width) * int(height), bandwidth=bandwidth * 1e6)
    measured = None
    if measure:
        from aniso_pm.distributed.measure import measured as measure_here

        measured = measure_here(lambda text: None if as_json else print(text, flush=True))
        costs = replace(costs, **measured["costs"])
    if pass_seconds:
        costs = replace(costs, pass_seconds=pass_seconds)
    conditions = Conditions(
        task_seconds=task_seconds, home_every=save_every, stragglers=stragglers, deaths=deaths
    )
    rows = table(costs, workers or [64, 1000], conditions, seconds)
    if as_json:
        found = {"costs": asdict(costs), "measured": measured, "rows": rows}
        print(json.dumps(output.plain(found), indent=2, ensure_ascii=False))
        return 0
    print(
        f"passes of {costs.pass_seconds:g} s, tasks of {rows[0]['model']['passes a task']} passes, "
        f"sums of {costs.sum_bytes / 1e6:.1f} MB, {bandwidth:g} MB/s between machines"
    )
    for row in rows:
        model, played = row["model"], row["simulation"]
        print(
            f"{row['workers']:>6} workers: {model['passes a second']:.1f} passes/s by the model, "
            f"{played['passes a second']:.1f} in the simulation "
            f"({played['efficiency']:.0%} of the workers' own speed; client busy "
            f"{played['client busy']:.0%}; {played['deaths']} deaths, "
            f"{played['passes lost']:.2%} of passes rendered twice)\n"
            f"               first limit: {model['bottleneck']}; one scheduler serves "
            f"{model['workers that one scheduler serves']} workers; sums take "
            f"{model['seconds to come home']:.1f} s to come home; {model['advice']}"
        )
    return 0
