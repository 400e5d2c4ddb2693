"""Kill a command at random moments, and start it again until it ends as one that is left alone.

`python -m support.kills KIND COUNT SEED` in `tests` kills a command of a kind so often, with SIGKILL, and ends with
code 1 if the files of one that came to its end differ from those of a command that was left alone.
"""

import random
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

from support.commands import contents
from support.processes import ends, free_address, run, start
from support.tiny_run import CONFIG_YAML, write_config

LATE_S = 300  # after which a process counts as hanging
LONG = ("--total-steps", 60 * 128)

#: An experiment of two agents at two layout shifts, whose every run is the tiny run.
EXPERIMENT_YAML = f"""
agents:
  main: {{}}
  anonymous: {{method: anonymous, arms: [baseline]}}
measure: {{variants: [main], instrument: [main]}}
shifts: [0.0, 1.0]
episodes: 24
base:
  direct: goal
  done_gate: true
{textwrap.indent(CONFIG_YAML.strip(), "  ")}
"""


def _training(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    return [run(["train.py", "--config", write_config(folder), "--run-dir", folder / "run", *LONG], **cache)]


def _processes(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    address = free_address()
    config_file = write_config(folder)
    return [start(address, index, config_file, folder / "run", *LONG, **cache) for index in range(2)]


def _study(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    config_file = folder / "experiment.yaml"
    config_file.write_text(EXPERIMENT_YAML)
    pages = f"{{{folder / 'docs/study.md'}: instrument}}"
    options = ("--results", folder / "results", "--runs", folder / "runs", "--pages", pages)
    return [run(["-m", "jaxnav", "study", config_file, *options], **cache)]


_STARTED: dict[str, Callable[[Path, dict[str, object]], list[subprocess.Popen]]] = {
    "training": _training,
    "processes": _processes,
    "study": _study,
}


def reproducible_files(folder: Path) -> dict[str, bytes]:
    """Return the files of a command that hold neither times nor paths."""
    endings = ("metrics.jsonl", "reach.json", "params.safetensors", "study.md")
    files = contents(folder)
    return {name: files[name] for name in files if name.endswith(endings) or name.startswith("results")}


def killed(processes: list[subprocess.Popen], moment: float, draw: random.Random) -> bool:
    """Kill one of the processes, or all, at a moment, and return whether any still ran.

    One of two that lost the other may refuse to go on; nothing else may be refused.
    """
    while time.monotonic() < moment and any(process.poll() is None for process in processes):
        time.sleep(0.001)
    for victim in draw.choice([processes, processes[:1], processes[-1:]]):
        victim.kill()
    codes, messages = ends(*processes, timeout=LATE_S)
    if not set(codes) <= ({0, 2, -9} if -9 in codes and len(codes) > 1 else {0, -9}):
        raise SystemExit(f"ended with {codes}: {messages}")
    return -9 in codes


def finish(processes: list[subprocess.Popen]) -> None:
    """Wait for processes that end well."""
    codes, messages = ends(*processes, timeout=LATE_S)
    if any(codes):
        raise SystemExit(f"ended with {codes}: {messages}")


def main(kind: str, count: int, seed: int) -> bool:
    """Kill so often, print what becomes of it, and return whether all that ended are equal."""
    draw = random.Random(seed)
    start_all = _STARTED[kind]
    num_kills = 0
    num_after_checkpoint = 0
    num_runs = 0
    all_equal = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        cache = {"JAX_COMPILATION_CACHE_DIR": folder / "cache", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0}

        def make_folder(name: str) -> Path:
            (folder / name).mkdir()
            return folder / name

        # Twice without kills: the second run, with compiled programs, is timed.
        seconds = 0.0
        for name in ("compiled", "whole"):
            began = time.monotonic()
            finish(start_all(make_folder(name), cache))
            seconds = time.monotonic() - began
        expected = reproducible_files(folder / "whole")
        assert expected
        assert reproducible_files(folder / "compiled") == expected

        while num_kills < count:
            # Kill and start again, until a start comes to its end.
            num_runs += 1
            run_folder = make_folder(str(num_runs))
            while num_kills < count:
                processes = start_all(run_folder, cache)
                if not killed(processes, time.monotonic() + draw.uniform(0, seconds), draw):
                    break
                num_kills += 1
                saved = [path.name for path in run_folder.rglob("checkpoints/*") if path.name.isdigit()]
                num_after_checkpoint += bool(saved)
                print(f"{kind}: kill {num_kills} in run {num_runs}, with checkpoints {saved}", flush=True)
            finish(start_all(run_folder, cache))  # a finished run ends at once

            is_equal = reproducible_files(run_folder) == expected
            all_equal &= is_equal
            print(f"{kind}: run {num_runs} ended {'equal' if is_equal else 'OTHERWISE'}", flush=True)
    print(
        f"{kind}: {num_kills} kills with seed {seed} in {num_runs} runs, {num_after_checkpoint} after a checkpoint; "
        f"all equal: {all_equal}"
    )
    return all_equal


if __name__ == "__main__":
    sys.exit(not main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
