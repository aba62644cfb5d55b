"""Kills, hangs, full disks, schedulers that vanish: the same picture, or one clear sentence."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from aniso_pm.distributed import Options, render
from aniso_pm.distributed.cluster import connected, local
from aniso_pm.errors import Failed
from aniso_pm.rendering.state import State
from command_line import OURS, SCENE, assert_same_picture, process
from test_distributed import alone
from test_distributed import assert_same_picture as assert_same
from test_distributed import scene as room

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals"),
]


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.replace("{integrator}", OURS).replace("{extra}", ""))
    return path


def start(folder, *words):
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "dask", *map(str, words)]
    with open(folder / "log", "w") as log:
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)


@contextmanager
def cluster(tmp_path, workers=2, **options):
    """Processes, without nannies: (scheduler file, scheduler, workers)."""
    file = tmp_path / "scheduler.json"
    scheduler = start(
        tmp_path / "s", "scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard",
        "--scheduler-file", file,
    )  # fmt: skip
    while not file.exists():
        time.sleep(0.1)
    words = ["worker", "--scheduler-file", file, "--nthreads", 1, "--no-nanny", "--no-dashboard"]
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", value]
    others = [start(tmp_path / f"w{k}", *words) for k in range(workers)]
    try:
        yield file, scheduler, others
    finally:
        for program in (*others, scheduler):
            program.kill()
            program.wait()


def workers_of(program):
    """Rendering processes of a running `aniso-pm render --workers`."""
    found = []
    for child in psutil.Process(program.pid).children(recursive=True):
        try:
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
        except psutil.Error:
            pass
    return found


def passes_in(path):
    try:
        return State.load(path).count
    except FileNotFoundError:
        return 0


def test_kills_of_workers_and_of_the_client_leave_the_same_picture(scene, tmp_path):
    """Five of workers, two of clients, at random times; then as many passes as it has come to."""
    chance = random.Random(7)

    def render(passes, out, *more):
        arguments = ["render", scene, "-o", out, "--passes", passes, "--spp", passes, "--quiet"]
        return process(*arguments, *more, cwd=tmp_path)

    def begin(passes=10**6):
        options = ["--workers", 2, "--save-every", 1, "--task-seconds", 0.5]
        return render(passes, "a.exr", "--resume", *options)

    state = tmp_path / "a.state"
    kills, log = {"worker": 5, "client": 2}, []
    program = begin()
    while kills["worker"] or kills["client"]:
        begun = passes_in(state)
        while passes_in(state) <= begun:  # something has to be there to be lost
            assert program.poll() is None, program.communicate()
            time.sleep(0.2)
        time.sleep(chance.uniform(0, 1.5))
        whom = chance.choice([name for name, left in kills.items() if left])
        kills[whom] -= 1
        log.append((whom, passes_in(state)))
        if whom == "worker":
            chance.choice(workers_of(program)).kill()
        else:
            orphans = psutil.Process(program.pid).children(recursive=True)
            program.kill()
            program.communicate()
            psutil.wait_procs(orphans, timeout=60)
            program = begin()
    begun = passes_in(state)
    while passes_in(state) <= begun:
        assert program.poll() is None, program.communicate()
        time.sleep(0.2)
    program.send_signal(signal.SIGINT)
    assert program.wait(timeout=600) == 130
    passes = State.load(state).passes[-1][1]
    print("killed, with so many passes saved:", log, "of", passes)
    program = begin(passes)
    _, stderr = program.communicate(timeout=900)
    assert program.returncode == 0, stderr
    assert State.load(state).passes == [[0, passes]]
    assert render(passes, "whole.exr").wait(timeout=900) == 0
    assert_same_picture(tmp_path / "whole.exr", tmp_path / "a.exr")


def test_a_worker_that_hangs_is_replaced_and_its_passes_are_rendered(capfd):
    told = []
    with local(2) as client:
        processes = list(client.run(os.getpid).values())
        stopped = []

        def stop(done, total, text):
            if done >= 6 and not stopped:
                stopped.append(processes[0])
                os.kill(processes[0], signal.SIGSTOP)

        from aniso_pm import distributed

        options = Options(task_seconds=0.3, task_limit=12.0, home_every=0.5, keep=2)
        made = distributed.Elsewhere
        distributed.Elsewhere = lambda *arguments: made(*arguments, warn=told.append)
        try:
            done = render(room(), client, spp=80, passes=80, progress=stop, options=options)
        finally:
            distributed.Elsewhere = made
            for pid in stopped:
                if psutil.pid_exists(pid):
                    os.kill(pid, signal.SIGCONT)
    assert stopped and done.statistics["passes"] == 80
    assert any("a task has not ended in" in text for text in told), told
    assert_same(done.image, alone(room(), 80, passes=80)[0])


def ends(program, *parts, status=1):
    stdout, stderr = program.communicate(timeout=300)
    assert program.returncode == status, stderr
    lines = [line for line in stderr.splitlines() if line.startswith("aniso-pm: error: ")]
    assert len(lines) == 1 and "Traceback" not in stderr, stderr
    for part in parts:
        assert part in lines[0], lines[0]
    return stdout


def endless(scene, tmp_path, *more):
    arguments = ["render", scene, "-o", "a.exr", "--passes", 10**6, "--spp", 10**6]
    return process(*arguments, "--save-every", 1, *more, cwd=tmp_path)


def wait_for(path, program):
    while not path.exists():
        assert program.poll() is None, program.communicate()
        time.sleep(0.1)


def test_a_scheduler_that_vanishes_ends_in_one_sentence_and_the_picture_so_far(scene, tmp_path):
    with cluster(tmp_path) as (file, scheduler, workers):
        program = endless(scene, tmp_path, "--scheduler-file", file)
        wait_for(tmp_path / "a.exr", program)
        (tmp_path / "a.exr").unlink()
        scheduler.kill()
        ends(program, "the scheduler tcp://127.0.0.1:", "is gone", "--resume", "is written")
    assert (tmp_path / "a.exr").exists() and State.load(tmp_path / "a.state").count > 0
    # It goes on with none.
    count = State.load(tmp_path / "a.state").count
    arguments = ["render", scene, "-o", "a.exr", "--passes", 10**6, "--spp", 10**6, "--resume"]
    program = process(*arguments, "--save-every", 0.5, cwd=tmp_path)
    while State.load(tmp_path / "a.state").count <= count:
        assert program.poll() is None, program.communicate()
        time.sleep(0.1)
    program.send_signal(signal.SIGINT)
    program.communicate(timeout=300)
    assert program.returncode == 130


def test_workers_that_are_all_gone_end_in_one_sentence_and_the_picture_so_far(scene, tmp_path):
    with cluster(tmp_path) as (file, scheduler, workers):
        program = endless(scene, tmp_path, "--scheduler-file", file)
        wait_for(tmp_path / "a.exr", program)
        for worker in workers:
            worker.kill()
        ends(program, "no worker is connected to the scheduler", "30 seconds", "is written")
    assert State.load(tmp_path / "a.state").count > 0


def test_ctrl_c_brings_home_what_workers_have():
    pressed = []

    def interrupt(done, total, text):
        if done >= 300 and not pressed:
            pressed.append(done)
            signal.raise_signal(signal.SIGINT)

    options = Options(task_seconds=0.3, home_every=600.0)
    with local(2) as client:
        done = render(room(), client, spp=10**6, passes=10**6, progress=interrupt, options=options)
    assert done.statistics["interrupted"] and pressed[0] <= done.statistics["passes"] < 5000
    # Waiting for workers is no stage.
    assert done.statistics["seconds"]["output"] < done.statistics["seconds"]["eye"]
    assert np.isfinite(done.image).all() and done.image.mean() > 0.01


def test_a_full_disk_on_the_only_worker_is_one_sentence(tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(full)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("cannot mount a small file system")
    try:
        with cluster(tmp_path, 1, local_directory=full) as (file, _, _):
            with connected(scheduler_file=file) as client:
                client.wait_for_workers(1, timeout=60)
                sky = np.zeros((64, 64, 3), np.float32)
                import mitsuba as mi

                mi.Bitmap(sky).write(str(tmp_path / "sky.exr"))
                wanted = room() | {"sky": {"type": "envmap", "filename": str(tmp_path / "sky.exr")}}
                with open(full / "ballast", "wb", buffering=0) as ballast:
                    with contextlib.suppress(OSError):
                        while True:
                            ballast.write(bytes(512))
                with pytest.raises(Failed, match="No space left on device") as error:
                    render(wanted, client, spp=4, passes=4)
                assert str(error.value).startswith("no worker is left that can render: tcp://")
                assert str(Path(full)) in str(error.value)
    finally:
        subprocess.run(["umount", "-l", str(full)], check=True)
