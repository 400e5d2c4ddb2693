"""Compare this checkout with an earlier commit: does anything take longer, or more memory?

`python benchmarks/gate.py [COMMIT]` checks the commit out beside this checkout, runs the same commands in both in turns
(A B A B ...), and prints the ratio of every measure, this checkout over the commit: median, least and greatest. The
command ends with code 1 if the median of a ratio exceeds its limit. Without an argument, COMMIT is the one that
`results/performance/gate_commit.txt` names.

* `train` and `eval` are the commands of a smoke run, *cold* with an empty cache of compiled programs and *warm* with
  that of the cold call: wall seconds and peak memory.
* `update` and `environment` are the seconds per step of `training.py` (all arms and seeds) and `environment.py` (every
  kind of output).
"""

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from _common import ROOT, ratio_by_turn

#: Greatest ratio of a time, and of a peak of memory, which depends less on the load of the machine.
MAX_TIME_RATIO = 1.2
MAX_MEMORY_RATIO = 1.1
TURNS = 3
COMMIT_FILE = ROOT / "results" / "performance" / "gate_commit.txt"


def main(commit: str) -> bool:
    """Print every ratio, and return whether all are low enough."""
    measures: dict[str, dict[str, list[float]]] = {"here": {}, "there": {}}
    with checked_out(commit) as base_dir:
        for turn in range(TURNS):
            for side, checkout in (("there", base_dir), ("here", ROOT)):
                print(f"turn {turn + 1} of {TURNS}: {checkout}", file=sys.stderr, flush=True)
                for name, value in measure(checkout).items():
                    measures[side].setdefault(name, []).append(value)

    all_passed = True
    print(f"| measure | {commit} | this checkout | ratio |\n| --- | ---: | ---: | ---: |")
    for name, values in measures["here"].items():
        base_values = measures["there"][name]
        ratio = ratio_by_turn(values, base_values)
        limit = MAX_MEMORY_RATIO if name.endswith("GB") else MAX_TIME_RATIO
        passed = ratio["median"] <= limit
        all_passed = all_passed and passed
        ratio_text = f"{ratio['median']:.2f} ({ratio['min']:.2f} to {ratio['max']:.2f})"
        verdict = "" if passed else f" over the limit of {limit}"
        base_median = statistics.median(base_values)
        new_median = statistics.median(values)
        print(f"| {name} | {base_median:.3g} | {new_median:.3g} | {ratio_text}{verdict} |")
    return all_passed


@contextlib.contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check a commit out in a temporary worktree."""
    with tempfile.TemporaryDirectory() as folder:
        worktree = Path(folder) / "base"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", worktree, commit], check=True)
        try:
            yield worktree
        finally:
            subprocess.run([*git, "remove", "--force", worktree], check=True)


def measure(checkout: Path) -> dict[str, float]:
    """Run everything once in a checkout; values by measure, of which smaller ones are better."""
    values = {}
    with tempfile.TemporaryDirectory() as folder:
        for state in ("cold", "warm"):
            run_dir = Path(folder) / state
            commands = {
                "train": ["train", "--config", "smoke", "--run-dir", str(run_dir)],
                "eval": ["eval", str(run_dir)],
            }
            for name, arguments in commands.items():
                seconds, peak_gb = run_measured(checkout, Path(folder), ["-m", "jaxnav", *arguments])
                values[f"{name}, {state}, s"] = seconds
                values[f"{name}, {state}, GB"] = peak_gb

    training = run_benchmark(checkout, "training.py")
    values["update, us a step"] = 1e6 / training["steps_per_s"]["all arms and seeds"]["median"]
    environment = run_benchmark(checkout, "environment.py")
    for name, rate in environment["steps_per_s"].items():
        if name.startswith("steps_"):
            values[f"environment, {name.removeprefix('steps_')}, ns a step"] = 1e9 / rate["median"]
    return values


def run_measured(checkout: Path, folder: Path, arguments: list[str]) -> tuple[float, float]:
    """Run Python on the package of a checkout; wall seconds and peak memory in GB."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "JAX_COMPILATION_CACHE_DIR": str(folder / "programs")}
    start_time = time.perf_counter()
    with tempfile.TemporaryFile("w+") as messages:
        process = subprocess.Popen(
            [sys.executable, *arguments], cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=messages
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start_time
        if status:
            messages.seek(0)
            raise RuntimeError(f"{checkout}: python {' '.join(arguments)} failed:\n{messages.read()}")
    return seconds, usage.ru_maxrss / 2**20


def run_benchmark(checkout: Path, file_name: str) -> dict:
    """Run a benchmark of a checkout, and return its report."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    command = [sys.executable, checkout / "benchmarks" / file_name]
    output = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    return json.loads(output)


if __name__ == "__main__":
    arguments = sys.argv[1:] or [COMMIT_FILE.read_text().strip()]
    sys.exit(not main(*arguments))
