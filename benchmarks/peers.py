"""Speed of the environment alone, compared with its peers.

`python benchmarks/peers.py` prints for each the steps per second and our ratio. Every peer is installed into a virtual
environment of its own under `.cache/peers` and runs there in a process that waits between its calls (`_peer_worker.py`
defines one call); calls are timed in turns, ours among them. A peer that fails to install or to run is listed with its
error. *Like for like*: one device and the default allocator on all sides. *Tuned*: two host devices and the allocator's
variables on all sides. The outputs of a step are consumed, or stored as in a rollout. Peers compute their view and
their new layouts at every step; ours are looked up in tables, whose compilation is not counted.
"""

import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from _common import (
    TUNED_ALLOCATOR,
    WorkerProcess,
    install,
    print_report,
    ratio_by_turn,
    steps_per_second,
    time_in_turns,
)

NUM_EPISODES = 2048
TURNS = 7
WORKER = Path(__file__).with_name("_peer_worker.py")
#: Packages to install beside jax: gymnax 1.0.1 imports six without requiring it.
PINS = {
    "gymnax": ("gymnax==1.0.1", "six==1.17.0"),
    "xminigrid": ("xminigrid==0.9.3",),
    "navix": ("navix==0.7.4",),
    "jumanji": ("jumanji==1.1.2",),
    "jaxmarl": ("jaxmarl==0.2.0",),
}
#: Environment variables of the tuned comparison.
TUNED = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", **TUNED_ALLOCATOR}


class Case(NamedTuple):
    """An environment to measure.

    Attributes:
      package: name of the package.
      name: name of the environment.
      num_steps: of one call, which then lasts about a second.
      num_episodes: run in parallel.
    """

    package: str
    name: str
    num_steps: int
    num_episodes: int = NUM_EPISODES

    @property
    def title(self) -> str:
        return f"{self.package} {self.name}, {self.num_episodes} episodes"


OURS = Case("jaxnav", "rooms", 8000)
OURS_FEW = Case("jaxnav", "rooms", 50000, 64)
FAST_CASES = (
    Case("gymnax", "FourRooms-misc", 3000),
    Case("navix", "Navix-Empty-16x16-v0", 1500),
    Case("xminigrid", "MiniGrid-Empty-16x16", 500),
)
SLOW_CASES = (
    Case("xminigrid", "MiniGrid-FourRooms", 100),
    Case("navix", "Navix-FourRooms-v0", 40),
    Case("xminigrid", "XLand-MiniGrid-R1-9x9", 200),
    Case("jumanji", "Maze-v0", 30),
    Case("jaxmarl", "jaxnav", 40, 64),  # two robots with lidar; with 1,024 episodes it gives no result
)


def main() -> None:
    # A peer that cannot be installed is left out.
    pythons = {"jaxnav": Path(sys.executable)}
    for package, pins in PINS.items():
        try:
            pythons[package] = install(package, *pins, f"jax=={version('jax')}")
        except subprocess.CalledProcessError as error:
            print(error, file=sys.stderr)

    all_cases = [case for case in (OURS, OURS_FEW, *FAST_CASES, *SLOW_CASES) if case.package in pythons]
    fast_cases = [case for case in (OURS, *FAST_CASES) if case.package in pythons]
    print_report(
        {
            "like_for_like_consumed": compare_speeds(all_cases, pythons, {}, "consumed"),
            "like_for_like_stored": compare_speeds(all_cases, pythons, {}, "stored"),
            "tuned_consumed": compare_speeds(fast_cases, pythons, TUNED, "consumed"),
        }
    )


def compare_speeds(
    cases: Iterable[Case], pythons: dict[str, Path], settings: dict[str, str], output_mode: str
) -> dict[str, Any]:
    """Time all cases in turns, and compare ours with each.

    Args:
      cases: to measure.
      pythons: Python of each package.
      settings: environment variables of the processes.
      output_mode: `consumed` or `stored`.
    """
    workers: dict[Case, WorkerProcess] = {}
    results: dict[str, Any] = {}
    for case in cases:
        print("compiling", case.title, output_mode, file=sys.stderr)
        command = [pythons[case.package], WORKER, case.package, case.name]
        try:
            workers[case] = WorkerProcess([*command, case.num_episodes, case.num_steps, output_mode], settings)
            results[case.title] = workers[case].description
        except RuntimeError as error:
            results[case.title] = {"error": str(error)}

    call_times = time_in_turns({case.title: worker.request for case, worker in workers.items()}, TURNS)
    step_times = {}
    for case, worker in workers.items():
        worker.close()
        num_steps = worker.description["steps_per_call"]
        step_times[case] = [call_time / num_steps for call_time in call_times[case.title]]

    # Ours with as many episodes is the one to compare with.
    for case, times in step_times.items():
        results[case.title]["steps_per_s"] = steps_per_second(times, case.num_episodes)
        if case.package != "jaxnav":
            our_case = OURS if case.num_episodes == NUM_EPISODES else OURS_FEW
            results[case.title]["ours_over_it"] = ratio_by_turn(times, step_times[our_case])
    return results


if __name__ == "__main__":
    main()
