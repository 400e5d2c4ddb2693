"""A run that is killed at any moment and started again ends as one that is left alone, bit for bit.

The control is in the test: a run with another seed differs. `python -m support.kills` in `tests` kills more often.
"""

import random
import signal
import time

import pytest
from support.processes import run
from support.tiny_run import NUM_SEEDS, POLICY_NAMES, write_config

from jaxnav.store.files import read_log_rows


def start(config_file, run_dir, cache, *options):
    """The command in a process of its own; compiled code is kept, or every start would take its time."""
    command = ["train.py", "--config", config_file, "--run-dir", run_dir, *options]
    return run(command, JAX_COMPILATION_CACHE_DIR=cache, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0)


def finish(process):
    _, error = process.communicate()
    assert process.returncode == 0, error
    return error


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_killed_run_resumes_bit_for_bit(tmp_path):
    config_file = write_config(tmp_path)
    cache, long = tmp_path / "cache", ("--total-steps", "7680", "--validations", "6")  # 60 updates, 30 chunks
    whole = tmp_path / "whole"
    killed = tmp_path / "killed"
    other = tmp_path / "other"
    finish(start(config_file, whole, cache, *long))
    generator = random.Random(0)
    for seen in (0, 2, 24):  # the update after whose checkpoint it is killed, at a random moment
        process = start(config_file, killed, cache, *long)
        while (
            seen
            and process.poll() is None
            and not any(int(path.name) >= seen for path in killed.glob("checkpoints/*") if path.name.isdigit())
        ):
            time.sleep(0.001)
        time.sleep(generator.uniform(0, 0.3) if seen else generator.uniform(1, 4))
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert "resumed after update" in finish(start(config_file, killed, cache, *long))
    names = ["metrics.jsonl", "reach.json", *(f"policies/{name}/params.safetensors" for name in POLICY_NAMES)]
    for name in names:
        assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
    assert len(read_log_rows(killed / "metrics.jsonl")) == 30 * 2 * NUM_SEEDS
    finish(start(config_file, other, cache, *long, "--seed", "1"))
    for name in names:
        assert (other / name).read_bytes() != (whole / name).read_bytes(), name
