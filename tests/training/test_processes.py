"""A run in two processes equals the run in a single process, and ends when a process is lost."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import chex
import pytest
from support.commands import evaluate, train
from support.processes import REPOSITORY, free_address, start_training_process, wait_for_processes
from support.tiny_run import write_config

from jaxnav.store.export import load_params
from jaxnav.store.files import read_log_rows

TOLERANCE = 1e-5


def two_processes(config_file, run_dir, *options):
    """Exit codes and messages of two processes that train one run; `options` are the options of each process."""
    address = free_address()
    options_by_process = options or ((), ())
    processes = []
    for index in range(2):
        processes.append(start_training_process(address, index, config_file, run_dir, *options_by_process[index]))
    return wait_for_processes(*processes)


def assert_loss_is_reported(code, message):
    """Check that a process ended with a short message about the loss of another process."""
    assert code == 2, message
    assert message.count("\n") < 10, message
    assert message.splitlines()[-1].startswith("error: config: devices: another process of this run ended, cannot be")


@pytest.mark.slow
def test_two_processes_train_the_run_of_a_single_process(tmp_path, capsys):
    config_file = write_config(tmp_path)
    single_run = tmp_path / "single"
    shared_run = tmp_path / "shared"
    assert train(config_file, single_run, "--seeds", 1) == 0

    # Two processes train an equal run, and only the first of them reports the end.
    codes, messages = two_processes(config_file, shared_run)
    assert codes == [0, 0], messages
    assert "done in" in messages[0]
    assert "done in" not in messages[1]
    assert_equal_runs(single_run, shared_run)

    # A single process resumes the run of two processes, and the run can be evaluated.
    shutil.rmtree(shared_run / "checkpoints" / "4")
    shutil.rmtree(shared_run / "policies")
    assert train(config_file, shared_run, "--seeds", 1) == 0
    assert "resumed after update 2 of 4" in capsys.readouterr().err
    assert_equal_runs(single_run, shared_run)
    assert evaluate(shared_run, "--episodes", 10) == 0


#: A stand-in for Slurm's `srun`, which starts two tasks on this machine with the variables that Slurm gives to each.
SRUN = """#!/bin/bash
trap 'kill "${{tasks[@]}}" 2> /dev/null' EXIT
for task in 0 1; do
  SLURM_JOB_ID={job} SLURM_STEP_NODELIST=localhost SLURM_NTASKS=2 SLURM_PROCID=$task SLURM_LOCALID=$task "$@" &
  tasks+=($!)
done
wait "${{tasks[0]}}" && wait "${{tasks[1]}}"
"""


@pytest.mark.exhaustive
def test_slurm_script_trains_one_run_on_two_hosts(tmp_path):
    """Only `srun` is replaced; the script, and the way JAX finds the processes of a job, are those of a cluster."""
    srun = tmp_path / "srun"
    srun.write_text(SRUN.format(job=os.getpid()))
    srun.chmod(0o755)
    config_file = write_config(tmp_path)
    single_run = tmp_path / "single"
    shared_run = tmp_path / "shared"
    assert train(config_file, single_run) == 0

    # The script starts two processes through the replaced `srun`.
    environment = os.environ | {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "JAXNAV": str(Path(sys.executable).with_name("jaxnav")),
        "XLA_FLAGS": "",
    }
    script = [REPOSITORY / "configs" / "slurm.sh", "--config", config_file, "--run-dir", shared_run]
    completed = subprocess.run(script, env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)
    assert completed.returncode == 0, completed.stderr
    assert completed.stderr.count("done in") == 1
    assert_equal_runs(single_run, shared_run)


@pytest.mark.exhaustive
def test_two_processes_resume_before_a_damaged_checkpoint(tmp_path):
    """The damaged files are read by one process only, and the other process would wait for it."""
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    codes, messages = two_processes(config_file, run_dir)
    assert codes == [0, 0], messages

    # Overwrite all files of the second process in the last checkpoint with zeros.
    damaged_files = [path for path in (run_dir / "checkpoints/4").rglob("ocdbt.process_1/d/*") if path.is_file()]
    assert damaged_files
    for path in damaged_files:
        path.write_bytes(bytes(path.stat().st_size))

    # The run reports the damage, and resumes from the checkpoint before.
    codes, messages = two_processes(config_file, run_dir)
    assert codes == [0, 0], messages
    assert "is damaged (ValueError: missing or changed since saving: " in messages[0]
    assert "resumed after update 2 of 4" in messages[0]


@pytest.mark.slow
def test_processes_that_disagree_are_refused(tmp_path):
    codes, messages = two_processes(write_config(tmp_path), tmp_path / "run", (), ("--seed", 1))
    assert codes == [2, 2], messages
    assert "processes [1] have other settings, scenes or versions than process 0" in messages[0]
    assert not (tmp_path / "run").exists()


@pytest.mark.exhaustive
@pytest.mark.parametrize(("victim", "checkpoint_pattern"), [(0, "4"), (1, "4.*")])  # "4.*" is still being written
def test_a_killed_process_ends_the_other_process(victim, checkpoint_pattern, tmp_path, capsys):
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    address = free_address()
    step_options = "--total-steps", 60 * 16 * 8  # 60 updates of 16 environments and 8 steps

    # Kill one process as soon as the checkpoint of update 4 exists or is being written.
    processes = [start_training_process(address, index, config_file, run_dir, *step_options) for index in range(2)]
    while not list((run_dir / "checkpoints").glob(checkpoint_pattern)) and processes[0].poll() is None:
        time.sleep(0.01)
    processes[victim].kill()
    processes[victim].communicate()

    # The other process ends with a message, and the run can be resumed.
    (code,), (message,) = wait_for_processes(processes[1 - victim], timeout=300)
    assert_loss_is_reported(code, message)
    assert train(config_file, run_dir, "--seeds", 1, *step_options) == 0
    assert re.search(r"resumed after update \d+ of 60", capsys.readouterr().err)


@pytest.mark.exhaustive
def test_a_process_ends_if_the_other_process_never_joins(tmp_path):
    config_file = write_config(tmp_path)
    # Each process waits at an address of its own.
    processes = [start_training_process(free_address(), index, config_file, tmp_path / "run") for index in range(2)]
    for code, message in zip(*wait_for_processes(*processes, timeout=300), strict=True):
        assert_loss_is_reported(code, message)
    assert not (tmp_path / "run").exists()


def assert_equal_runs(run_dir, other_dir):
    """Check that two runs have equal policies and logs within the tolerance."""
    for policy_name in ("baseline-0", "layout-0"):
        params = load_params(run_dir / "policies" / policy_name)[0]
        other_params = load_params(other_dir / "policies" / policy_name)[0]
        chex.assert_trees_all_close(params, other_params, rtol=0, atol=TOLERANCE)

    log_rows = read_log_rows(run_dir / "metrics.jsonl")
    other_rows = read_log_rows(other_dir / "metrics.jsonl")
    for row, other_row in zip(log_rows, other_rows, strict=True):
        assert row.pop("arm") == other_row.pop("arm")
        assert row == pytest.approx(other_row, rel=1e-3, abs=TOLERANCE)
