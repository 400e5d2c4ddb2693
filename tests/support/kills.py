"""Kill a command at random moments, and start it again until it ends as one that is left alone.

`python -m support.kills KIND COUNT SEED` in `tests` kills a command of a kind so often, with SIGKILL, and ends with
code 1 if the files of one that came to its end differ from those of a command that was left alone.
"""

import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from support.commands import contents, study_command, write_config
from support.processes import free_address, run, start

LATE_S = 300  # after which a process hangs
LONG = ("--total-steps", 60 * 128)


def _training(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    return [run(["train.py", "--config", write_config(folder), "--run-dir", folder / "run", *LONG], **cache)]


def _processes(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    address, config = free_address(), write_config(folder)
    return [start(address, index, config, folder / "run", *LONG, **cache) for index in range(2)]


def _study(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    return [run(["-m", "jaxnav", "study", *study_command(folder)], **cache)]


_STARTED: dict[str, Callable[[Path, dict[str, object]], list[subprocess.Popen]]] = {
    "training": _training,
    "processes": _processes,
    "study": _study,
}


def kept(folder: Path) -> dict[str, bytes]:
    """Return the files of a command that do not tell the time or where they are."""
    ends = ("metrics.jsonl", "reach.json", "params.safetensors", "study.md")
    files = contents(folder)
    return {name: files[name] for name in files if name.endswith(ends) or name.startswith("results")}


def codes(processes: list[subprocess.Popen]) -> list[int]:
    """Wait for processes and return their exit codes."""
    messages = [process.communicate(timeout=LATE_S)[1] for process in processes]
    found = [process.returncode for process in processes]
    if not set(found) <= {0, 2, -9}:
        raise SystemExit(f"ended with {found}: {messages}")
    return found


def killed(processes: list[subprocess.Popen], moment: float, draw: random.Random) -> bool:
    """Kill one of the processes, or all, at a moment; return whether one was still there to be killed."""
    while time.monotonic() < moment and any(process.poll() is None for process in processes):
        time.sleep(0.001)
    for victim in draw.choice([processes, processes[:1], processes[-1:]]):
        victim.kill()
    return -9 in codes(processes)


def main(kind: str, count: int, seed: int) -> bool:
    """Kill so often, print what becomes of it, and return whether all that ended are equal."""
    draw, start_all = random.Random(seed), _STARTED[kind]
    with tempfile.TemporaryDirectory() as name:
        folder, kills, runs, same = Path(name), 0, 0, True
        cache = {"JAX_COMPILATION_CACHE_DIR": folder / "cache", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0}

        def place(name: str) -> Path:
            (folder / name).mkdir(exist_ok=True)
            return folder / name

        seconds = 0.0
        for alone in ("compiled", "whole"):
            began = time.monotonic()
            assert not any(codes(start_all(place(alone), cache)))
            seconds = time.monotonic() - began
        whole = kept(folder / "whole")
        assert whole
        assert kept(folder / "compiled") == whole
        while kills < count:
            runs += 1
            here = place(str(runs))
            while kills < count and killed(start_all(here, cache), time.monotonic() + draw.uniform(0, seconds), draw):
                kills += 1
                print(f"{kind}: kill {kills}, run {runs}", flush=True)
            assert not any(codes(start_all(here, cache)))  # what is finished ends at once
            equal = kept(here) == whole
            same &= equal
            print(f"{kind}: run {runs} ended {'equal' if equal else 'OTHERWISE'}", flush=True)
    print(f"{kind}: {kills} kills with seed {seed} in {runs} runs of {seconds:.0f} s; all ended equal: {same}")
    return same


if __name__ == "__main__":
    sys.exit(not main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
