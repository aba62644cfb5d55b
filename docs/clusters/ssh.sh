#!/bin/bash
# The same by ssh, on machines that share the working directory:
#
#     ssh.sh SCENE.xml NAME PASSES_PER_JOB SAMPLES_PER_PASS HOST...
set -u
scene=$1 name=$2 passes=$3 samples=$4
shift 4

job=0
for host in "$@"; do
    ssh "$host" "cd $(printf %q "$PWD") && aniso-pm render $(printf %q "$scene") \
        -o $(printf %q "$name-$job.exr") --resume --quiet \
        --passes $passes --first-pass $((job * passes)) --spp $((passes * samples))" &
    job=$((job + 1))
done
wait
