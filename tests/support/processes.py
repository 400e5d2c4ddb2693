"""Python processes that run the code of this repository."""

import os
import socket
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def start_python(command, **environment):
    """Start Python with the words of a command and additional environment variables; its output is piped."""
    variables = {name: str(value) for name, value in environment.items()}
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        cwd=REPOSITORY,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def free_address():
    """Address of this machine with a port that no process listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def start_training_process(address, index, config_file, run_dir, *options, **environment):
    """Start one of two processes on this machine that train one run.

    Args:
      address: address at which the processes meet.
      index: 0 or 1, the number of the process.
      config_file: settings of the run.
      run_dir: directory of the run.
      *options: further options of the command.
      **environment: further environment variables.
    """
    command = ["train.py", "--config", config_file, "--run-dir", run_dir, "--seeds", 1]
    devices = f"--devices={address},{index},2"

    # The processes have one device each, whatever number of devices the tests have.
    xla_flags = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if "device_count" not in flag]
    environment |= {"JAX_COORDINATOR_BIND_ADDRESS": address, "XLA_FLAGS": " ".join(xla_flags)}
    return start_python([*command, devices, *options], **environment)


def wait_for_processes(*processes, timeout=600):
    """Wait for processes, and return their exit codes and what they wrote to stderr."""
    try:
        messages = [process.communicate(timeout=timeout)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], messages
