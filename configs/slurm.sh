#!/bin/bash
# One training run on several hosts of a Slurm cluster, one process per host. Submit it from the repository, or set
# JAXNAV to the path of the command:
#     sbatch --nodes 4 configs/slurm.sh --world houses --seeds 4 --run-dir runs/houses
# The options are those of `jaxnav train`. Give as many seeds as hosts, or a multiple: seeds divide without loss.
# Submit the same command again after the time limit; the run resumes, also where Slurm requeues a preempted job.
#SBATCH --job-name=jaxnav
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=TERM@120
# JAX uses one GPU per process. For four GPUs per host, not tried: --ntasks-per-node=4 --gpus-per-node=4 --gpu-bind=none
set -euo pipefail
# srun does not take over this option of sbatch.
export SRUN_CPUS_PER_TASK="${SLURM_CPUS_PER_TASK:-1}"
exec srun "${JAXNAV:-.venv/bin/jaxnav}" train --devices cluster "$@"
