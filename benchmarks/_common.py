"""Calls timed in turns, spreads, and a benchmark's report."""

import contextlib
import importlib.metadata
import json
import os
import platform
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

Spread = dict[str, float]

#: Makes glibc keep large buffers instead of giving them back to be faulted in again; read when a process starts.
TUNED_ALLOCATOR = {
    "MALLOC_MMAP_THRESHOLD_": "8589934592",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
    "MALLOC_TOP_PAD_": "268435456",
}


def seconds(call: Callable[[], Any]) -> float:
    """Return the wall seconds until a call's arrays are there."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def in_turns(calls: Mapping[str, Callable[[], Any]], turns: int = 9) -> dict[str, list[float]]:
    """Time calls in turns (A B A B ...).

    Load hits all alike. Returns wall seconds, after a warm-up of each.
    """
    for call in calls.values():
        seconds(call)
    rounds = [{name: seconds(call) for name, call in calls.items()} for _ in range(turns)]
    return {name: [one[name] for one in rounds] for name in calls}


def spread(values: Sequence[float], digits: int = 4) -> Spread:
    """Return median, least and greatest to some significant digits."""
    statistics_of = {"median": statistics.median(values), "min": min(values), "max": max(values)}
    return {name: float(f"{value:.{digits}g}") for name, value in statistics_of.items()}


def rates(taken: Sequence[float], steps: int) -> Spread:
    """Return steps per second of calls of so many steps."""
    return spread([steps / one for one in taken])


def ratios(above: Sequence[float], below: Sequence[float]) -> Spread:
    """Return ratios turn by turn of what was timed together."""
    return spread([a / b for a, b in zip(above, below, strict=True)])


def peak_resident_gb() -> float:
    """Return the most memory that this process has held."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3)


def machine() -> dict[str, Any]:
    """Return the processor, devices, settings and versions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "allocator": "tuned" if "MALLOC_TOP_PAD_" in os.environ else "default",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("jax", "flax", "numpy")},
    }


def report(results: dict[str, Any]) -> None:
    """Print the machine and the results as one JSON object."""
    print(json.dumps({"machine": machine(), **results}, indent=2))


def in_folder(main: Callable[[Path, Path], None]) -> None:
    """Call with the file of the command line, and its folder or a temporary one."""
    file, *folder = map(Path, sys.argv[1:])
    with contextlib.nullcontext(folder[0]) if folder else tempfile.TemporaryDirectory() as chosen:
        main(file, Path(chosen))
