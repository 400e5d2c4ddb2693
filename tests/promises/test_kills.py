"""A run that is killed at any moment and started again ends as one that is left alone, bit for bit.

The control is in the test: policies of other seeds differ. `python -m support.kills` in `tests` kills more often.
"""

import random
import signal
import time

import pytest
from support.processes import start_python
from support.tiny_run import NUM_SEEDS, POLICY_NAMES, write_config

from jaxnav.store.files import read_log_rows


def start(config_file, run_dir, *options):
    """Start the train command in a process of its own, with the compiled programs of the whole suite."""
    command = ["train.py", "--config", config_file, "--run-dir", run_dir, *options]
    return start_python(command, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0)


def finish(process):
    _, error = process.communicate()
    assert process.returncode == 0, error
    return error


def latest_checkpoint(run_dir):
    """The update of the newest checkpoint; 0 before the first one."""
    updates = [int(path.name) for path in run_dir.glob("checkpoints/*") if path.name.isdigit()]
    return max(updates, default=0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_killed_run_resumes_bit_for_bit(tmp_path):
    config_file = write_config(tmp_path)
    options = ("--total-steps", "2560", "--validations", "2")  # 20 updates, 10 chunks
    whole_dir = tmp_path / "whole"
    killed_dir = tmp_path / "killed"
    finish(start(config_file, whole_dir, *options))

    # Kill at a random moment: while the process starts, and after the checkpoints of two updates.
    generator = random.Random(0)
    for update in (0, 2, 8):
        process = start(config_file, killed_dir, *options)
        while update and process.poll() is None and latest_checkpoint(killed_dir) < update:
            time.sleep(0.001)
        time.sleep(generator.uniform(0, 0.3) if update else generator.uniform(1, 4))
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert "resumed after update" in finish(start(config_file, killed_dir, *options))

    file_names = ["metrics.jsonl", "reach.json", *(f"policies/{name}/params.safetensors" for name in POLICY_NAMES)]
    for file_name in file_names:
        assert (killed_dir / file_name).read_bytes() == (whole_dir / file_name).read_bytes(), file_name
    assert len(read_log_rows(killed_dir / "metrics.jsonl")) == 10 * 2 * NUM_SEEDS

    # Control: policies of other seeds differ.
    policies = {(whole_dir / file_name).read_bytes() for file_name in file_names[2:]}
    assert len(policies) == len(POLICY_NAMES)
