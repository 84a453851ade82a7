#!/usr/bin/env bash
# SLURM: 8 nodes with 8 GPUs each. Submit it with `sbatch docs/jobs/slurm.sh`, from a folder that all nodes share.
#SBATCH --job-name=city
#SBATCH --nodes=8
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=64
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail
export CAPTURE=city RUN=runs/city HOSTS=auto OPTIONS="--steps 30000 --views 64"
srun --kill-on-bad-exit=1 docs/jobs/train.sh
