#!/bin/sh
# Makes a dataset as a SLURM array. Every task makes its part of the shards in one shared folder; the last one to finish
# assembles the dataset. A task that was killed or ran out of time can be submitted again: finished shards are kept.
#
#     sbatch --array=1-32 scripts/tools/slurm_generate.sh SPEC DIR [OPTIONS OF eyerender generate]
#
# The folder must be on a file system that all nodes share. Set EYERENDER to the command if it is not on PATH, for
# example EYERENDER="apptainer exec image.sif eyerender". On GPU nodes add --gres=gpu:1 and --backend cuda. To submit
# only some tasks again, give the total number: EYERENDER_PARTS=32 sbatch --array=7,9 (tasks are counted from 1).
#
#SBATCH --job-name=eyerender
#SBATCH --cpus-per-task=8
#SBATCH --mem=8G
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --signal=TERM@60
set -eu
if [ $# -lt 2 ]; then
    echo "usage: sbatch --array=1-N $0 SPEC DIR [OPTIONS]" >&2
    exit 2
fi
: "${SLURM_ARRAY_TASK_ID:?is not set: submit this script with sbatch --array=1-N}"
spec=$1 folder=$2
shift 2
if [ -n "${EYERENDER_PARTS:-}" ]; then
    part=$SLURM_ARRAY_TASK_ID/$EYERENDER_PARTS
else
    first=${SLURM_ARRAY_TASK_MIN:-1} step=${SLURM_ARRAY_TASK_STEP:-1}
    part=$(((SLURM_ARRAY_TASK_ID - first) / step + 1))/${SLURM_ARRAY_TASK_COUNT:-1}
fi
# exec: the signal before the time limit must reach the run itself, which then leaves only whole shards behind.
# shellcheck disable=SC2086  (EYERENDER may be a command with arguments)
exec ${EYERENDER:-eyerender} generate "$spec" "$folder" --shard "$part" --threads "${SLURM_CPUS_PER_TASK:-1}" "$@"
