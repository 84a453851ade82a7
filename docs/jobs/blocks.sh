#!/usr/bin/env bash
# SLURM: one block of a plan for each task of the array, with one GPU. `splatax blocks plan` prints the numbers:
#   CITY=runs/city sbatch --array=0-15 docs/jobs/blocks.sh
# A task that is stopped continues its run when it is started again.
#SBATCH --job-name=blocks
#SBATCH --gpus-per-task=1
#SBATCH --cpus-per-task=8
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail
exec splatax blocks train "${CITY:?}" "${SLURM_ARRAY_TASK_ID:?}" --checkpoint-steps 1000
