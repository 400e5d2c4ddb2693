"""What every benchmark reports with its figures: the machine, the versions, and timings of one function."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import jax


def machine() -> dict[str, str | int | None]:
    """Returns the processor, the devices and the versions that figures depend on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


def timings(function: Callable, *args, repeats: int = 50) -> dict[str, float]:
    """Runs a compiled function `repeats` times after one warm-up; wall and processor time per call in milliseconds.

    Processor time sums all threads and is averaged, because its clock is coarse; the least wall time is the one
    other work on the machine disturbed least.
    """
    jax.block_until_ready(function(*args))
    wall, start = [], time.process_time()
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(function(*args))
        wall.append(1e3 * (time.perf_counter() - begin))
    cpu = 1e3 * (time.process_time() - start) / repeats
    median = statistics.median(wall)
    return {"wall_min_ms": min(wall), "wall_median_ms": median, "wall_max_ms": max(wall), "cpu_mean_ms": cpu}


def rates(timing: dict[str, float], steps: int) -> dict[str, float]:
    """Steps per second of calls that take `steps` steps each, from their `timings`."""
    slowest, fastest = timing["wall_max_ms"], timing["wall_min_ms"]
    rate = {"median": timing["wall_median_ms"], "min": slowest, "max": fastest}
    return {name: round(1e3 * steps / wall) for name, wall in rate.items()}


def report(results: dict) -> None:
    """Prints the machine and the results as one JSON object."""
    print(json.dumps({"machine": machine(), **results}, indent=2))
