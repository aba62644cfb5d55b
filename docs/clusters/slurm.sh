#!/bin/bash
# One picture by a job array: each job renders passes of its own.
#
#     sbatch --array=0-15 slurm.sh SCENE.xml NAME PASSES_PER_JOB SAMPLES_PER_PASS
#
#SBATCH --job-name=aniso_pm
#SBATCH --cpus-per-task=16
#SBATCH --time=01:00:00
#SBATCH --requeue
set -eu
scene=$1 name=$2 passes=$3 samples=$4
job=$SLURM_ARRAY_TASK_ID

# --resume: a job that was preempted, or is submitted again, goes on from its own state.
aniso-pm render "$scene" -o "$name-$job.exr" --resume --quiet \
    --passes "$passes" --first-pass "$((job * passes))" --spp "$((passes * samples))"
