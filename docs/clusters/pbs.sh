#!/bin/bash
# The same for PBS:
#
#     qsub -J 0-15 -v scene=SCENE.xml,name=NAME,passes=8,samples=4 pbs.sh
#
#PBS -N aniso_pm
#PBS -l select=1:ncpus=16
#PBS -l walltime=01:00:00
#PBS -r y
set -eu
cd "$PBS_O_WORKDIR"
job=$PBS_ARRAY_INDEX

aniso-pm render "$scene" -o "$name-$job.exr" --resume --quiet \
    --passes "$passes" --first-pass "$((job * passes))" --spp "$((passes * samples))"
