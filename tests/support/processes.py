"""Python processes of this repository's code."""

import os
import socket
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def run(command, **environment):
    """Start Python, its messages piped."""
    environment = os.environ | {name: str(value) for name, value in environment.items()}
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        cwd=REPOSITORY,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def free_address():
    """A port of this machine that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def start(address, index, config_file, run_dir, *options, **environment):
    """One of two processes on this machine that train one run."""
    command = ["train.py", "--config", config_file, "--run-dir", run_dir, "--seeds", 1]
    devices = f"--devices={address},{index},2"
    flags = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if "device_count" not in flag]
    environment |= {"JAX_COORDINATOR_BIND_ADDRESS": address, "XLA_FLAGS": " ".join(flags)}
    return run([*command, devices, *options], **environment)


def ends(*processes, timeout=600):
    """Exit codes and messages of processes."""
    try:
        messages = [process.communicate(timeout=timeout)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], messages
