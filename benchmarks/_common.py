"""Timing calls in turns, summarizing the times, printing the report of a benchmark, and processes of workers."""

import contextlib
import importlib.metadata
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import venv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from jaxnav.training.config import PPOConfig

#: Median, minimum and maximum.
Spread = dict[str, float]

ROOT = Path(__file__).parents[1]
#: Virtual environments of other packages.
PEERS_DIR = ROOT / ".cache" / "peers"
#: Seconds to wait for an answer of a worker.
TIMEOUT_S = 600
#: Makes glibc reuse large buffers instead of returning them to the system; read when a process starts.
TUNED_ALLOCATOR = {
    "MALLOC_MMAP_THRESHOLD_": "8589934592",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
    "MALLOC_TOP_PAD_": "268435456",
}

#: Rollouts of SemExp hold two of its macro-steps, with as many steps an update as usual.
SEMEXP_PPO = PPOConfig(num_envs=64, rollout=60)

# Timing


def time_call(call: Callable[[], Any]) -> float:
    """Return the wall seconds until the arrays of a call are ready."""
    start_time = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start_time


def time_in_turns(calls: Mapping[str, Callable[[], Any]], turns: int = 9) -> dict[str, list[float]]:
    """Return the wall seconds of calls timed in turns (A B A B ...), after a warm-up of each.

    Taking turns exposes all calls to the same load of the machine.
    """
    for call in calls.values():
        time_call(call)

    times = {name: [] for name in calls}
    for _ in range(turns):
        for name, call in calls.items():
            times[name].append(time_call(call))
    return times


def summarize(values: Sequence[float], digits: int = 4) -> Spread:
    """Return median, minimum and maximum, rounded to some significant digits."""
    summary = {"median": statistics.median(values), "min": min(values), "max": max(values)}
    return {name: float(f"{value:.{digits}g}") for name, value in summary.items()}


def steps_per_second(call_times: Sequence[float], num_steps: int) -> Spread:
    """Return the rates of calls of `num_steps` steps."""
    return summarize([num_steps / call_time for call_time in call_times])


def ratio_by_turn(numerators: Sequence[float], denominators: Sequence[float]) -> Spread:
    """Return ratios of two series that were timed in the same turns."""
    ratios = [above / below for above, below in zip(numerators, denominators, strict=True)]
    return summarize(ratios)


def peak_resident_gb() -> float:
    """Return the peak of this process's resident memory."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3)


def peak_device_gb() -> float | None:
    """Return the peak of the first device's own memory; None for a CPU, which uses that of the process."""
    memory_stats = jax.local_devices()[0].memory_stats()
    return round(memory_stats["peak_bytes_in_use"] / 2**30, 3) if memory_stats else None


# Reports


def describe_machine() -> dict[str, Any]:
    """Return processor, devices, settings and versions."""
    cpu_model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model_lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        if model_lines:
            cpu_model = model_lines[0].split(":", 1)[1].strip()
    return {
        "cpu": cpu_model,
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "allocator": "tuned" if "MALLOC_TOP_PAD_" in os.environ else "default",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("jax", "flax", "numpy")},
    }


def print_report(results: dict[str, Any]) -> None:
    """Print the machine and the results as one JSON object."""
    print(json.dumps({"machine": describe_machine(), **results}, indent=2))


def run_in_folder(main: Callable[[Path, Path], None]) -> None:
    """Call `main` with the file and the folder of the command line; without a folder, with a temporary one."""
    file, *folders = map(Path, sys.argv[1:])
    context = contextlib.nullcontext(folders[0]) if folders else tempfile.TemporaryDirectory()
    with context as folder:
        main(file, Path(folder))


# Workers


def install(name: str, *packages: str) -> Path:
    """Install packages into the virtual environment `.cache/peers/NAME`, and return its Python."""
    python = PEERS_DIR / name / "bin" / "python"
    if not python.exists():
        venv.create(PEERS_DIR / name, with_pip=True)
    command = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", *packages]
    subprocess.run(command, check=True, stdout=sys.stderr)
    return python


class WorkerProcess:
    """A Python script in a process of its own that answers each line of its input with a line of JSON.

    The process sleeps between its answers, so that others can be timed in turns with it.

    Attributes:
      description: the first answer, which comes before any request.

    Raises:
      RuntimeError: if the process ends or is silent for `TIMEOUT_S` seconds.
    """

    def __init__(self, command: Sequence[Any], settings: Mapping[str, str] | None = None) -> None:
        # Settings of this process must not reach the worker.
        environment = {}
        for name, value in os.environ.items():
            if not name.startswith(("MALLOC_", "XLA_", "JAX_")):
                environment[name] = value
        environment |= {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), **(settings or {})}

        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (open as long as the process)
        self._process = subprocess.Popen(
            [str(argument) for argument in command],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        self.description = self._read_answer()

    def request(self, line: str = "") -> Any:
        """Send one line and return the answer to it."""
        print(line, file=self._process.stdin, flush=True)
        return self._read_answer()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()

    def _read_answer(self) -> Any:
        assert self._process.stdout
        timer = threading.Timer(TIMEOUT_S, self._process.kill)
        timer.start()
        line = self._process.stdout.readline()
        timer.cancel()
        if line:
            return json.loads(line)

        # The process has ended: by itself, or killed by the timer.
        was_killed = self._process.wait() < 0
        self._errors.seek(0)
        last_line = (self._errors.read().strip().splitlines() or ["no output"])[-1]
        raise RuntimeError(f"no answer in {TIMEOUT_S} s" if was_killed else last_line)
