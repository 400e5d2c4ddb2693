"""Speed of the environment alone, compared with its peers.

`python benchmarks/peers.py` prints for each the steps per second and our ratio. Every peer is installed into a virtual
environment of its own under `.cache/peers` and runs there in a process that waits between its calls (`_peer_worker.py`
defines one call); calls are timed in turns, ours among them. A peer that fails to install or to run is listed with its
error. *Like for like*: one device and the default allocator on all sides. *Tuned*: two host devices and the allocator's
variables on all sides. Both are measured with the outputs of a step consumed, and stored as in a rollout. Peers compute
their view and their new layouts at every step; ours are looked up in tables, whose compilation is not counted.
"""

import json
import os
import subprocess
import sys
import threading
import venv
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from _common import TUNED_ALLOCATOR, print_report, ratio_by_turn, steps_per_second

NUM_EPISODES = 2048
TURNS = 7
#: Seconds to wait for an answer of a peer.
TIMEOUT_S = 150
PEERS_DIR = Path(__file__).parents[1] / ".cache" / "peers"
WORKER = Path(__file__).with_name("_peer_worker.py")
#: Packages to install beside jax: gymnax 1.0.1 imports six without requiring it.
PINS = {
    "gymnax": ("gymnax==1.0.1", "six==1.17.0"),
    "xminigrid": ("xminigrid==0.9.3",),
    "navix": ("navix==0.7.4",),
    "jumanji": ("jumanji==1.1.2",),
    "jaxmarl": ("jaxmarl==0.2.0",),
}
#: Environment variables of each comparison.
COMPARISONS = {
    "like_for_like": {},
    "tuned": {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", **TUNED_ALLOCATOR},
}


class Case(NamedTuple):
    """An environment to measure.

    Attributes:
      package: name of the package.
      name: name of the environment.
      num_steps: of one call, which then lasts about a second.
      num_episodes: run in parallel.
      goal: ratio of our speed to the environment's that we want to reach.
    """

    package: str
    name: str
    num_steps: int
    num_episodes: int = NUM_EPISODES
    goal: float | None = None

    @property
    def title(self) -> str:
        return f"{self.package} {self.name}, {self.num_episodes} episodes"


OURS = Case("jaxnav", "rooms", 8000)
OURS_FEW = Case("jaxnav", "rooms", 50000, 64)
FAST_CASES = [
    Case("gymnax", "FourRooms-misc", 3000, goal=3),
    Case("navix", "Navix-Empty-16x16-v0", 1500, goal=6),
    Case("xminigrid", "MiniGrid-Empty-16x16", 500, goal=25),
]
SLOW_CASES = [
    Case("xminigrid", "MiniGrid-FourRooms", 100, goal=60),
    Case("navix", "Navix-FourRooms-v0", 40, goal=60),
    Case("xminigrid", "XLand-MiniGrid-R1-9x9", 200),
    Case("jumanji", "Maze-v0", 30),
    Case("jaxmarl", "jaxnav", 40, 64),  # two robots with lidar; with 1,024 episodes it gives no result
]


def main() -> None:
    installed = {package: install(package, pins) for package, pins in PINS.items()}

    def select_installed(cases: list[Case]) -> list[Case]:
        return [case for case in cases if "error" not in installed.get(case.package, {})]

    results = {}
    for comparison, cases in (("like_for_like", [OURS_FEW, *FAST_CASES, *SLOW_CASES]), ("tuned", FAST_CASES)):
        for output_mode in ("consumed", "stored"):
            results[f"{comparison}_{output_mode}"] = compare_speeds(
                [OURS, *select_installed(cases)], COMPARISONS[comparison], output_mode
            )
    goals = check_goals(FAST_CASES + SLOW_CASES, results["like_for_like_consumed"])
    print_report({"turns": TURNS, "peers": installed, **results, "goals_like_for_like": goals})


def find_python(package: str) -> Path:
    return Path(sys.executable) if package == "jaxnav" else PEERS_DIR / package / "bin" / "python"


def install(package: str, pins: Iterable[str]) -> dict[str, Any]:
    """Install a package with our version of jax, and return its versions or the error."""
    python = find_python(package)
    if not python.exists():
        venv.create(PEERS_DIR / package, with_pip=True)
    pip = [str(python), "-m", "pip", "--disable-pip-version-check"]
    install_command = [*pip, "install", "-q", *pins, f"jax=={version('jax')}"]
    completed = subprocess.run(install_command, capture_output=True, text=True)
    if completed.returncode:
        return {"error": last_line(completed.stderr)}

    listing = subprocess.run([*pip, "list", "--format=json"], capture_output=True, text=True, check=True)
    versions = {entry["name"].lower(): entry["version"] for entry in json.loads(listing.stdout)}
    return {name: versions[name] for name in (package, "jax", "numpy")}


def last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no output"])[-1]


class Worker:
    """Process of one compiled environment, which sleeps between its calls.

    Attributes:
      process: the process.
      description: of the compiled program, or its error.
    """

    def __init__(self, case: Case, settings: dict[str, str], output_mode: str) -> None:
        # Settings of this process must not reach the worker.
        environment = {}
        for name, value in os.environ.items():
            if not name.startswith(("MALLOC_", "XLA_", "JAX_")):
                environment[name] = value
        environment |= {"JAX_PLATFORMS": "cpu", **settings}

        log_path = PEERS_DIR / f"{case.package}-{case.name}-{case.num_episodes}.log"
        command = [str(find_python(case.package)), str(WORKER), case.package, case.name]
        command += [str(case.num_episodes), str(case.num_steps), output_mode]
        with log_path.open("w") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=environment
            )

        self.description = json.loads(self.read_answer() or "{}")
        if not self.description:
            was_killed = self.process.wait() < 0
            self.description["error"] = f"no result in {TIMEOUT_S} s" if was_killed else last_line(log_path.read_text())

    def read_answer(self) -> str:
        """Return the next line, or an empty one after the timeout."""
        assert self.process.stdout
        timer = threading.Timer(TIMEOUT_S, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        return line

    def time_call(self) -> float:
        """Return the wall seconds of one call."""
        assert self.process.stdin
        print(file=self.process.stdin, flush=True)
        return float(self.read_answer())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


def compare_speeds(cases: Iterable[Case], settings: dict[str, str], output_mode: str) -> dict[str, Any]:
    """Time all cases in turns, and compare ours with each.

    Args:
      cases: to measure.
      settings: environment variables of the processes.
      output_mode: `consumed` or `stored`.
    """
    workers = {}
    for case in cases:
        print("compiling", case.title, output_mode, file=sys.stderr)
        workers[case] = Worker(case, settings, output_mode)

    # Time one call of each running worker per turn, after a warm-up.
    running = {case: worker for case, worker in workers.items() if "error" not in worker.description}
    for worker in running.values():
        worker.time_call()
    step_times = {case: [] for case in running}
    for _ in range(TURNS):
        for case, worker in running.items():
            step_times[case].append(worker.time_call() / worker.description["steps_per_call"])
    for worker in workers.values():
        worker.close()

    # Ours with as many episodes is the one to compare with.
    results = {case.title: worker.description for case, worker in workers.items()}
    for case, times in step_times.items():
        results[case.title]["steps_per_s"] = steps_per_second(times, case.num_episodes)
        if case.package != "jaxnav":
            our_case = OURS if case.num_episodes == NUM_EPISODES else OURS_FEW
            results[case.title]["ours_over_it"] = ratio_by_turn(times, step_times[our_case])
    return results


def check_goals(cases: Iterable[Case], results: dict[str, Any]) -> list[dict[str, Any]]:
    """Compare the median ratios with the goals."""
    rows = []
    for case in cases:
        ratio = results.get(case.title, {}).get("ours_over_it", {}).get("median")
        if case.goal and ratio is not None:
            rows.append({"over": case.title, "asked": case.goal, "found": ratio, "reached": ratio >= case.goal})
    return rows


if __name__ == "__main__":
    main()
