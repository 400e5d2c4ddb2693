"""One run in several processes is the run of one, and ends when one of them is lost."""

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
from support.processes import REPOSITORY, ends, free_address, start
from support.tiny_run import write_config

from jaxnav.store.export import load_params
from jaxnav.store.files import read_log_rows

TOLERANCE = 1e-5


def two_processes(config_file, run_dir, *options):
    """Exit codes and messages of two processes that train one run, each given its own options."""
    address = free_address()
    own = options or ((), ())
    return ends(*(start(address, index, config_file, run_dir, *own[index]) for index in range(2)))


def assert_told(code, message):
    assert code == 2, message
    assert message.count("\n") < 10, message
    assert message.splitlines()[-1].startswith("error: config: devices: another process of this run ended, cannot be")


@pytest.mark.slow
def test_two_processes_train_the_run_of_one(tmp_path, capsys):
    config_file, one, two = write_config(tmp_path), tmp_path / "one", tmp_path / "two"
    assert train(config_file, one, "--seeds", 1) == 0
    codes, messages = two_processes(config_file, two)
    assert codes == [0, 0], messages
    assert "done in" in messages[0]
    assert "done in" not in messages[1]
    assert_same_run(one, two)

    # One process goes on where two stopped, and the run can be evaluated.
    shutil.rmtree(two / "checkpoints" / "4")
    shutil.rmtree(two / "policies")
    assert train(config_file, two, "--seeds", 1) == 0
    assert "resumed after update 2 of 4" in capsys.readouterr().err
    assert_same_run(one, two)
    assert evaluate(two, "--episodes", 10) == 0


#: Stands for Slurm's `srun`: starts two tasks on this machine, with the variables that Slurm gives to each.
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
    """Only `srun` is replaced: the script, and how JAX finds the processes of a job, are those of a cluster."""
    srun = tmp_path / "srun"
    srun.write_text(SRUN.format(job=os.getpid()))
    srun.chmod(0o755)
    config_file, one, two = write_config(tmp_path), tmp_path / "one", tmp_path / "two"
    assert train(config_file, one) == 0

    environment = os.environ | {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "JAXNAV": str(Path(sys.executable).with_name("jaxnav")),
        "XLA_FLAGS": "",
    }
    script = [REPOSITORY / "configs" / "slurm.sh", "--config", config_file, "--run-dir", two]
    completed = subprocess.run(script, env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)
    assert completed.returncode == 0, completed.stderr
    assert completed.stderr.count("done in") == 1
    assert_same_run(one, two)


@pytest.mark.exhaustive
def test_two_processes_go_on_before_a_damaged_checkpoint(tmp_path):
    """In a part that one of them alone reads, where the other would wait for it."""
    config_file, run_dir = write_config(tmp_path), tmp_path / "run"
    codes, messages = two_processes(config_file, run_dir)
    assert codes == [0, 0], messages
    parts = [path for path in (run_dir / "checkpoints/4").rglob("ocdbt.process_1/d/*") if path.is_file()]
    assert parts
    for path in parts:
        path.write_bytes(bytes(path.stat().st_size))
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
@pytest.mark.parametrize(("victim", "written"), [(0, "4"), (1, "4.*")])  # the last while it is written
def test_a_killed_process_ends_the_other_one(victim, written, tmp_path, capsys):
    config_file, run_dir, address = write_config(tmp_path), tmp_path / "run", free_address()
    sixty = "--total-steps", 60 * 16 * 8  # updates
    both = [start(address, index, config_file, run_dir, *sixty) for index in range(2)]
    while not list((run_dir / "checkpoints").glob(written)) and both[0].poll() is None:
        time.sleep(0.01)
    both[victim].kill()
    both[victim].communicate()
    (code,), (message,) = ends(both[1 - victim], timeout=300)
    assert_told(code, message)
    assert train(config_file, run_dir, "--seeds", 1, *sixty) == 0
    assert re.search(r"resumed after update \d+ of 60", capsys.readouterr().err)


@pytest.mark.exhaustive
def test_a_process_that_stays_alone_ends(tmp_path):
    config_file = write_config(tmp_path)
    alone = [start(free_address(), index, config_file, tmp_path / "run") for index in range(2)]  # each waits elsewhere
    for code, message in zip(*ends(*alone, timeout=300), strict=True):
        assert_told(code, message)
    assert not (tmp_path / "run").exists()


def assert_same_run(one, two):
    for name in ("baseline-0", "layout-0"):
        ours, theirs = (load_params(folder / "policies" / name)[0] for folder in (one, two))
        chex.assert_trees_all_close(ours, theirs, rtol=0, atol=TOLERANCE)
    ours, theirs = (read_log_rows(folder / "metrics.jsonl") for folder in (one, two))
    for row, other in zip(ours, theirs, strict=True):
        assert row.pop("arm") == other.pop("arm")
        assert row == pytest.approx(other, rel=1e-3, abs=TOLERANCE)
