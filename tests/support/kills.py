"""Kill a command at random moments, start it again until it ends, and compare its files with undisturbed ones.

`python -m support.kills KIND COUNT SEED` in `tests` kills commands of a kind COUNT times with SIGKILL. The exit code is
1 if the files of a command that ended differ from those of an undisturbed command.
"""

import random
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

from support.commands import contents
from support.processes import free_address, start_python, start_training_process, wait_for_processes
from support.tiny_run import CONFIG_YAML, write_config

HANG_TIMEOUT_S = 300
#: Options of the train command for 60 updates.
LONG_RUN = ("--total-steps", 60 * 128)

#: An experiment of two agents at two layout shifts; all of its runs have the settings of the tiny run.
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


def _start_training(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    return [
        start_python(["train.py", "--config", write_config(folder), "--run-dir", folder / "run", *LONG_RUN], **cache)
    ]


def _start_two_processes(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    address = free_address()
    config_file = write_config(folder)
    return [
        start_training_process(address, index, config_file, folder / "run", *LONG_RUN, **cache) for index in range(2)
    ]


def _start_study(folder: Path, cache: dict[str, object]) -> list[subprocess.Popen]:
    config_file = folder / "experiment.yaml"
    config_file.write_text(EXPERIMENT_YAML)
    pages = f"{{{folder / 'docs/study.md'}: instrument}}"
    options = ("--results", folder / "results", "--runs", folder / "runs", "--pages", pages)
    return [start_python(["-m", "jaxnav", "study", config_file, *options], **cache)]


#: Functions that start a command of a kind, given its folder and the variables of the compilation cache.
_START_BY_KIND: dict[str, Callable[[Path, dict[str, object]], list[subprocess.Popen]]] = {
    "training": _start_training,
    "processes": _start_two_processes,
    "study": _start_study,
}


def reproducible_files(folder: Path) -> dict[str, bytes]:
    """Return the files of a command that contain neither times nor paths."""
    endings = ("metrics.jsonl", "reach.json", "params.safetensors", "study.md")
    files = contents(folder)
    return {name: files[name] for name in files if name.endswith(endings) or name.startswith("results")}


def kill_at(processes: list[subprocess.Popen], kill_time: float, rng: random.Random) -> bool:
    """Kill one of the processes, or all, at a time of `time.monotonic`, and return whether any still ran.

    All exit codes but 0 and that of SIGKILL are errors, except for a process that lost the other one of its run: this
    process may refuse to go on with code 2.
    """
    # Wait for the time, or until all processes have ended.
    while time.monotonic() < kill_time and any(process.poll() is None for process in processes):
        time.sleep(0.001)
    for victim in rng.choice([processes, processes[:1], processes[-1:]]):
        victim.kill()

    exit_codes, messages = wait_for_processes(*processes, timeout=HANG_TIMEOUT_S)
    was_killed = -signal.SIGKILL in exit_codes
    allowed_codes = {0, -signal.SIGKILL}
    if was_killed and len(exit_codes) > 1:
        allowed_codes.add(2)
    if not set(exit_codes) <= allowed_codes:
        raise SystemExit(f"ended with {exit_codes}: {messages}")
    return was_killed


def wait_for_success(processes: list[subprocess.Popen]) -> None:
    """Wait for processes that have to end with code 0."""
    exit_codes, messages = wait_for_processes(*processes, timeout=HANG_TIMEOUT_S)
    if any(exit_codes):
        raise SystemExit(f"ended with {exit_codes}: {messages}")


class KillTest:
    """Kills of one kind of command, and comparisons of its files with those of an undisturbed command.

    Attributes:
      num_kills: kills so far.
      num_kills_after_checkpoint: kills so far that came after a checkpoint.
      num_runs: number of run folders so far; in each the command was started until it ended.
      all_equal: True if all of these folders have the files of the undisturbed command.
    """

    def __init__(self, kind: str, seed: int, folder: Path) -> None:
        """Run the command twice without kills: the second run, which needs no compilation, is timed."""
        self.num_kills = 0
        self.num_kills_after_checkpoint = 0
        self.num_runs = 0
        self.all_equal = True
        self._kind = kind
        self._rng = random.Random(seed)
        self._folder = folder
        self._cache = {"JAX_COMPILATION_CACHE_DIR": folder / "cache", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0}

        wait_for_success(self._start(self._make_folder("compiled")))
        start_time = time.monotonic()
        wait_for_success(self._start(self._make_folder("whole")))
        self._duration_s = time.monotonic() - start_time

        # The files are reproducible.
        self._expected_files = reproducible_files(folder / "whole")
        assert self._expected_files
        assert reproducible_files(folder / "compiled") == self._expected_files

    def _make_folder(self, name: str) -> Path:
        (self._folder / name).mkdir()
        return self._folder / name

    def _start(self, folder: Path) -> list[subprocess.Popen]:
        return _START_BY_KIND[self._kind](folder, self._cache)

    def kill_until_end(self, max_kills: int) -> None:
        """Kill a new command and start it again, until it ends or `max_kills` is reached; compare its files."""
        self.num_runs += 1
        run_folder = self._make_folder(str(self.num_runs))
        while self.num_kills < max_kills:
            processes = self._start(run_folder)
            kill_time = time.monotonic() + self._rng.uniform(0, self._duration_s)
            if not kill_at(processes, kill_time, self._rng):
                break
            self.num_kills += 1
            steps = [path.name for path in run_folder.rglob("checkpoints/*") if path.name.isdigit()]
            self.num_kills_after_checkpoint += bool(steps)
            print(f"{self._kind}: kill {self.num_kills} in run {self.num_runs}, with checkpoints {steps}", flush=True)
        wait_for_success(self._start(run_folder))  # a finished run ends at once

        is_equal = reproducible_files(run_folder) == self._expected_files
        self.all_equal &= is_equal
        print(f"{self._kind}: run {self.num_runs} ended {'equal' if is_equal else 'OTHERWISE'}", flush=True)


def main(kind: str, count: int, seed: int) -> bool:
    """Kill a command `count` times, print the results, and return whether all commands that ended are equal."""
    with tempfile.TemporaryDirectory() as folder_name:
        kill_test = KillTest(kind, seed, Path(folder_name))
        while kill_test.num_kills < count:
            kill_test.kill_until_end(count)
    print(
        f"{kind}: {kill_test.num_kills} kills with seed {seed} in {kill_test.num_runs} runs, "
        f"{kill_test.num_kills_after_checkpoint} after a checkpoint; all equal: {kill_test.all_equal}"
    )
    return kill_test.all_equal


if __name__ == "__main__":
    sys.exit(not main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
