"""Job arrays: the documented scripts, run by stand-ins for the programs that submit them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from aniso_pm.rendering.state import State, missing
from command_line import OURS, SCENE, assert_same_picture, channels

SCRIPTS = Path(__file__).resolve().parent.parent / "docs" / "clusters"

# Runs the jobs of an array one after the other, as the real one would; the jobs that FAIL names do
# not start, as on a machine that is broken.
SBATCH = """#!/bin/bash
set -eu
for option in "$@"; do
    case "$option" in --array=*) range=${option#--array=}; shift ;; esac
done
script=$1; shift
grep -q '^#SBATCH --requeue' "$script"
for ((job = ${range%-*}; job <= ${range#*-}; job++)); do
    case " ${FAIL:-} " in *" $job "*) continue ;; esac
    SLURM_ARRAY_TASK_ID=$job bash "$script" "$@"
done
"""
QSUB = """#!/bin/bash
set -eu
while [ $# -gt 1 ]; do
    case "$1" in
        -J) range=$2; shift 2 ;;
        -v) IFS=, read -ra given <<< "$2"; shift 2 ;;
    esac
done
for ((job = ${range%-*}; job <= ${range#*-}; job++)); do
    env "${given[@]}" PBS_O_WORKDIR="$PWD" PBS_ARRAY_INDEX=$job bash "$1"
done
"""
SSH = """#!/bin/bash
host=$1; shift
cd / && HOST=$host bash -c "$*"
"""
# In place of the program: what it was called with.
RECORDS = """#!/bin/bash
line=$(printf '<%s>' "$@"); echo "$line $HOST" >> "$RECORD"  # at once: hosts write together
"""


@pytest.fixture
def shell(tmp_path):
    """Run a command where the programs given stand before the real ones."""

    def run(command, programs, **environment):
        folder = tmp_path / "bin"
        folder.mkdir(exist_ok=True)
        for name, text in programs.items():
            (folder / name).write_text(text)
            (folder / name).chmod(0o755)
        path = f"{folder}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        return subprocess.run(
            command,
            shell=True,
            cwd=tmp_path,
            env=os.environ | {"PATH": path} | environment,
            capture_output=True,
            text=True,
        )

    return run


def calls(shell, tmp_path, command, programs):
    record = tmp_path / "record"
    done = shell(command, programs | {"aniso-pm": RECORDS}, RECORD=str(record), HOST="")
    assert done.returncode == 0, done.stderr
    return sorted(record.read_text().splitlines())


def expected(scene, name, job, passes, samples, host=""):
    words = ["render", scene, "-o", f"{name}-{job}.exr", "--resume", "--quiet"]
    words += ["--passes", passes, "--first-pass", job * passes, "--spp", passes * samples]
    return "".join(f"<{word}>" for word in words) + f" {host}"


def test_each_job_of_each_kind_of_array_renders_passes_of_its_own(shell, tmp_path):
    command = f"sbatch --array=0-2 {SCRIPTS}/slurm.sh 'my scene.xml' out/a 8 4"
    found = calls(shell, tmp_path, command, {"sbatch": SBATCH})
    assert found == [expected("my scene.xml", "out/a", job, 8, 4) for job in range(3)]
    (tmp_path / "record").unlink()
    command = f"qsub -J 0-2 -v scene=s.xml,name=a,passes=8,samples=4 {SCRIPTS}/pbs.sh"
    found = calls(shell, tmp_path, command, {"qsub": QSUB})
    assert found == [expected("s.xml", "a", job, 8, 4) for job in range(3)]
    (tmp_path / "record").unlink()
    command = f"{SCRIPTS}/ssh.sh 'my scene.xml' a 8 4 red green"
    found = calls(shell, tmp_path, command, {"ssh": SSH})
    hosts = ["red", "green"]
    assert found == [expected("my scene.xml", "a", k, 8, 4, hosts[k]) for k in range(2)]


def test_the_slurm_pattern_merges_what_is_there_and_names_what_is_missing(shell, tmp_path):
    """Two jobs of three; the picture of those; the array again; the picture of all."""
    scene = SCENE.replace("{integrator}", OURS.replace("20000", "3000")).replace("{extra}", "")
    (tmp_path / "scene.xml").write_text(scene)
    array = f"sbatch --array=0-2 {SCRIPTS}/slurm.sh scene.xml a 2 1"
    merge = f"{SCRIPTS}/merge.sh a 6"
    programs = {"sbatch": SBATCH}
    assert shell(array, programs, FAIL="1").returncode == 0
    done = shell(merge, programs)
    assert done.returncode == 0
    assert done.stderr == "aniso-pm: 2 of 6 passes are missing: 2-3\n"
    assert State.load(tmp_path / "a.state").passes == [[0, 2], [4, 6]]
    assert np.isfinite(channels(tmp_path / "a.exr")["R"]).all()
    before = (tmp_path / "a-0.state").stat().st_mtime_ns
    assert shell(array, programs).returncode == 0
    (tmp_path / "a.state").rename(tmp_path / "first.state")
    done = shell(merge, programs)
    assert (done.returncode, done.stderr) == (0, "")
    assert State.load(tmp_path / "a-0.state").passes == [[0, 2]] and before
    whole = "aniso-pm render scene.xml -o all.exr --passes 6 --spp 6 --quiet --json"
    done = shell(whole, programs)
    assert json.loads(done.stdout)["statistics"]["passes"] == 6
    assert_same_picture(tmp_path / "a.exr", tmp_path / "all.exr")


@pytest.mark.parametrize(
    "passes, first, count, found",
    [
        ([[0, 8]], 0, 8, []),
        ([], 4, 3, [[4, 7]]),
        ([[0, 2], [4, 6]], 0, 8, [[2, 4], [6, 8]]),
        ([[0, 2], [4, 20]], 1, 8, [[2, 4]]),
        ([[10, 20]], 0, 4, [[0, 4]]),
        ([[0, 3]], 8, 2, [[8, 10]]),
    ],
)
def test_missing_passes(passes, first, count, found):
    assert missing(passes, first, count) == found
