"""A finished run repeats its own command on another number of cores, without a complaint and without a change."""

import os
import shutil

import pytest
from support.commands import contents
from support.processes import start_python
from support.tiny_run import POLICY_NAMES, write_config

from jaxnav.store.export import TOLERANCE, load_params

#: Train on the cores that the first argument lists.
TRAIN_ON_CORES = """
import os
import sys

os.sched_setaffinity(0, [int(core) for core in sys.argv[1].split(",")])
from jaxnav.cli import train

sys.exit(train.main(sys.argv[2:]))
"""


def train_on_cores(cores, config_file, run_dir):
    """Run the train command on some cores, and return what it prints on stderr."""
    core_list = ",".join(map(str, cores))
    command = ["-c", TRAIN_ON_CORES, core_list, "--config", config_file, "--run-dir", run_dir]
    process = start_python(command, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0)
    _, messages = process.communicate()
    assert process.returncode == 0, messages
    return messages


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_run_of_one_core_is_repeated_on_two(tmp_path):
    if not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2:
        pytest.skip("needs two cores and a system that pins processes to cores")
    cores = sorted(os.sched_getaffinity(0))[:2]
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    train_on_cores(cores[:1], config_file, run_dir)

    # A run of an earlier version has learned the same, but stored it in its exports alone.
    earlier_dir = shutil.copytree(run_dir, tmp_path / "earlier")
    shutil.rmtree(earlier_dir / "knowledge")

    # No file changes but that of the lock, which names the process.
    files_before = contents(run_dir)
    assert "resumed after update 4 of 4" in train_on_cores(cores, config_file, run_dir)
    files_after = contents(run_dir)
    assert files_after | {".lock": b""} == files_before | {".lock": b""}

    # What is learned anew agrees with the exports within the tolerance, and the exports stay.
    train_on_cores(cores, config_file, earlier_dir)
    for name in POLICY_NAMES:
        export_file = f"policies/{name}/params.safetensors"
        assert (earlier_dir / export_file).read_bytes() == files_before[export_file]
    learned_odds = load_params(earlier_dir / "knowledge")[0]["signs"]["near_odds"]
    exported_odds = load_params(run_dir / "policies" / "layout-0")[0]["signs"]["near_odds"]
    assert learned_odds == pytest.approx(exported_odds, rel=TOLERANCE, abs=TOLERANCE)
