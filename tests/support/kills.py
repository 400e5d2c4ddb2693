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
from support.processes import ends, free_address, run, start

LATE_S = 300  # after which a process counts as hanging
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
    those = ("metrics.jsonl", "reach.json", "params.safetensors", "study.md")
    files = contents(folder)
    return {name: files[name] for name in files if name.endswith(those) or name.startswith("results")}


def killed(processes: list[subprocess.Popen], moment: float, draw: random.Random) -> bool:
    """Return whether any process was there to be killed.

    One of them is killed, or all, at a moment. One of two that is left alone may refuse to go on; nothing else may be
    refused.
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
    draw, start_all = random.Random(seed), _STARTED[kind]
    with tempfile.TemporaryDirectory() as temporary:
        folder, kills, begun, runs, same = Path(temporary), 0, 0, 0, True
        cache = {"JAX_COMPILATION_CACHE_DIR": folder / "cache", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0}

        def place(name: str) -> Path:
            (folder / name).mkdir()
            return folder / name

        seconds = 0.0
        for alone in ("compiled", "whole"):
            began = time.monotonic()
            finish(start_all(place(alone), cache))
            seconds = time.monotonic() - began
        whole = kept(folder / "whole")
        assert whole
        assert kept(folder / "compiled") == whole
        while kills < count:
            runs += 1
            here = place(str(runs))
            while kills < count and killed(start_all(here, cache), time.monotonic() + draw.uniform(0, seconds), draw):
                kills, saved = kills + 1, [path.name for path in here.rglob("checkpoints/*") if path.name.isdigit()]
                begun += bool(saved)
                print(f"{kind}: kill {kills} in run {runs}, with checkpoints {saved}", flush=True)
            finish(start_all(here, cache))  # what is finished ends at once
            equal = kept(here) == whole
            same &= equal
            print(f"{kind}: run {runs} ended {'equal' if equal else 'OTHERWISE'}", flush=True)
    print(f"{kind}: {kills} kills with seed {seed} in {runs} runs, {begun} after a checkpoint; all equal: {same}")
    return same


if __name__ == "__main__":
    sys.exit(not main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
