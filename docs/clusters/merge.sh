#!/bin/bash
# What is there of a job array, as one picture, and which passes are missing:
#
#     merge.sh NAME PASSES_IN_ALL
set -eu
name=$1 passes=$2
aniso-pm merge "$name"-*.state -o "$name.exr" --passes "$passes"
