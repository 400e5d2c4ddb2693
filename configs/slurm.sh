#!/bin/bash
# One training run on several hosts of a Slurm cluster, one process per host:
#     sbatch --nodes 4 configs/slurm.sh --world houses --seeds 4 --run-dir runs/houses
# The options are those of `jaxnav train`. Give as many seeds as hosts, or a multiple: seeds divide without loss.
# Preempted jobs restart by themselves; after the time limit, submit the same command again. Both resume the run.
#SBATCH --job-name=jaxnav
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=TERM@120
# On hosts with GPUs, one process per GPU: --ntasks-per-node=4 --gpus-per-task=1
set -euo pipefail
exec srun "${JAXNAV:-.venv/bin/jaxnav}" train --devices cluster "$@"
