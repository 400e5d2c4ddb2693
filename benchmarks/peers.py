"""The environment alone beside its peers.

`python benchmarks/peers.py` prints for each the steps per second and our ratio. Every peer is installed into a virtual
environment of its own under `.cache/peers` and runs there in a process that waits between its calls (`_peer_worker.py`,
which says what one call is); calls are taken in turns, ours among them. A peer that does not install or does not run is
named with its error. *Like for like*: one device and the default allocator on all sides. *Tuned*: two host devices and
the allocator's variables on all sides. Both are measured with what a step delivers consumed, and with it stored as a
rollout does. Peers work out their view and their new layouts at every step; ours are looked
up in tables, whose compilation is not counted.
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

from _common import TUNED_ALLOCATOR, rates, ratios, report

EPISODES, TURNS, PATIENCE_S = 2048, 7, 150
HOME = Path(__file__).parents[1] / ".cache" / "peers"
WORKER = Path(__file__).with_name("_peer_worker.py")
#: What is installed beside jax: gymnax 1.0.1 imports six without asking for it.
PINS = {
    "gymnax": ("gymnax==1.0.1", "six==1.17.0"),
    "xminigrid": ("xminigrid==0.9.3",),
    "navix": ("navix==0.7.4",),
    "jumanji": ("jumanji==1.1.2",),
    "jaxmarl": ("jaxmarl==0.2.0",),
}
KINDS = {
    "like_for_like": {},
    "tuned": {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", **TUNED_ALLOCATOR},
}


class Case(NamedTuple):
    """Describe an environment and our goal over it.

    The `steps` of one call last about a second.
    """

    package: str
    name: str
    steps: int
    episodes: int = EPISODES
    goal: float | None = None

    @property
    def title(self) -> str:
        return f"{self.package} {self.name}, {self.episodes} episodes"


OURS = Case("jaxnav", "rooms", 8000)
OURS_FEW = Case("jaxnav", "rooms", 50000, 64)
FAST = [
    Case("gymnax", "FourRooms-misc", 3000, goal=3),
    Case("navix", "Navix-Empty-16x16-v0", 1500, goal=6),
    Case("xminigrid", "MiniGrid-Empty-16x16", 500, goal=25),
]
SLOW = [
    Case("xminigrid", "MiniGrid-FourRooms", 100, goal=60),
    Case("navix", "Navix-FourRooms-v0", 40, goal=60),
    Case("xminigrid", "XLand-MiniGrid-R1-9x9", 200),
    Case("jumanji", "Maze-v0", 30),
    Case("jaxmarl", "jaxnav", 40, 64),  # two robots with lidar; with 1,024 episodes it gives no result
]


def python(package: str) -> Path:
    return Path(sys.executable) if package == "jaxnav" else HOME / package / "bin" / "python"


def install(package: str, pins: Iterable[str]) -> dict[str, Any]:
    """Install a package with our jax; return versions or error."""
    if not python(package).exists():
        venv.create(HOME / package, with_pip=True)
    pip = [str(python(package)), "-m", "pip", "--disable-pip-version-check"]
    done = subprocess.run([*pip, "install", "-q", *pins, f"jax=={version('jax')}"], capture_output=True, text=True)
    if done.returncode:
        return {"error": last_line(done.stderr)}
    listed = subprocess.run([*pip, "list", "--format=json"], capture_output=True, text=True, check=True)
    versions = {entry["name"].lower(): entry["version"] for entry in json.loads(listed.stdout)}
    return {name: versions[name] for name in (package, "jax", "numpy")}


def last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no output"])[-1]


class Worker:
    """Run one compiled environment that sleeps between its calls."""

    def __init__(self, case: Case, settings: dict[str, str], what: str) -> None:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "XLA_", "JAX_"))}
        kept["JAX_PLATFORMS"] = "cpu"
        log_path = HOME / f"{case.package}-{case.name}-{case.episodes}.log"
        numbers = str(case.episodes), str(case.steps)
        command = [str(python(case.package)), str(WORKER), case.package, case.name, *numbers, what]
        with log_path.open("w") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=kept | settings
            )
        self.described = json.loads(self.answer() or "{}")
        if not self.described:
            killed = self.process.wait() < 0
            self.described["error"] = f"no result in {PATIENCE_S} s" if killed else last_line(log_path.read_text())

    def answer(self) -> str:
        """Return the next line, empty if none comes in time."""
        assert self.process.stdout
        timer = threading.Timer(PATIENCE_S, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        return line

    def seconds(self) -> float:
        """Return the wall seconds of one call."""
        assert self.process.stdin
        print(file=self.process.stdin, flush=True)
        return float(self.answer())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


def race(cases: Iterable[Case], settings: dict[str, str], what: str) -> dict[str, Any]:
    """Time all cases in turns, and compare ours with each.

    What a step delivers is `consumed` or `stored`.
    """
    workers = {case: started(case, settings, what) for case in cases}
    running = {case: worker for case, worker in workers.items() if "error" not in worker.described}
    for worker in running.values():
        worker.seconds()
    turns = [{case: worker.seconds() for case, worker in running.items()} for _ in range(TURNS)]
    for worker in workers.values():
        worker.close()
    results = {case.title: worker.described for case, worker in workers.items()}
    per_step = {case: [turn[case] / results[case.title]["steps_per_call"] for turn in turns] for case in running}
    for case, taken in per_step.items():
        results[case.title]["steps_per_s"] = rates(taken, case.episodes)
        if case.package != "jaxnav":
            ours = OURS if case.episodes == EPISODES else OURS_FEW
            results[case.title]["ours_over_it"] = ratios(taken, per_step[ours])
    return results


def started(case: Case, settings: dict[str, str], what: str) -> Worker:
    print("compiling", case.title, what, file=sys.stderr)
    return Worker(case, settings, what)


def goals(cases: Iterable[Case], results: dict[str, Any]) -> list[dict[str, Any]]:
    """Compare the median ratios with what was asked of them."""
    rows = []
    for case in cases:
        ratio = results.get(case.title, {}).get("ours_over_it", {}).get("median")
        if case.goal and ratio is not None:
            rows.append({"over": case.title, "asked": case.goal, "found": ratio, "reached": ratio >= case.goal})
    return rows


def main() -> None:
    installed = {package: install(package, pins) for package, pins in PINS.items()}

    def those(cases: list[Case]) -> list[Case]:
        return [case for case in cases if "error" not in installed.get(case.package, {})]

    raced = {
        f"{kind}_{what}": race([OURS, *those(cases)], KINDS[kind], what)
        for kind, cases in (("like_for_like", [OURS_FEW, *FAST, *SLOW]), ("tuned", FAST))
        for what in ("consumed", "stored")
    }
    reached = goals(FAST + SLOW, raced["like_for_like_consumed"])
    report({"turns": TURNS, "peers": installed, **raced, "goals_like_for_like": reached})


if __name__ == "__main__":
    main()
