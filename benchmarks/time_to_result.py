"""Where the seconds of `make run` go.

`python benchmarks/time_to_result.py [OVERLAY]` trains the default run, or that of a YAML file laid over it, as
`train.py` does, and evaluates it as `eval.py` does, each in a process of its own, in a temporary run directory.
Functions are timed from outside, compilation by JAX's own events; where spans overlap a second belongs to the label
that stands first in `LABELS`. Training cannot be looked into from outside: it is divided by the rollout's share of an
update, which is measured afterwards.
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from _common import in_turns, report
from _phases import phases
from _setup import set_up
from rich.console import Console

import jaxnav.runs.evaluate
import jaxnav.runs.train
from jaxnav.evaluation.grid import Evaluator
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import Run
from jaxnav.runs.evaluate import Results
from jaxnav.runs.overlay import apply_yaml
from jaxnav.training.trainer import Trainer

#: Owner and name of the functions that each label times.
TIMED: dict[str, tuple[tuple[Any, str], ...]] = {
    "scenes": ((jaxnav.runs.train, "training_world"), (jaxnav.runs.evaluate, "evaluation_world")),
    "prior": ((jaxnav.runs.train, "explore_world"),),
    "calibration": ((jaxnav.runs.train, "calibrate_setting"),),
    "training": ((Trainer, "init"), (Trainer, "train")),
    "checkpoints": tuple((jaxnav.runs.train, name) for name in ("restore", "save", "export_policy")),
    "evaluation": ((Evaluator, "__call__"),),
    "report": (
        *((jaxnav.runs.evaluate, name) for name in ("oracle_outcome", "build_row", "build_difference", "build_report")),
        (Results, "write"),
    ),
}
LABELS = ("imports", "compile", *TIMED)
TURNS = 5
Spans = dict[str, list[tuple[float, float]]]


def main(options: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        seconds = {
            "train.py": timed("train.py", [run, *options], Path(folder) / "train.json"),
            "eval.py": timed("eval.py", [run], Path(folder) / "eval.json"),
        }
    share = rollout_share(run_config(*options))
    training = seconds["train.py"].pop("training")
    seconds["train.py"] |= {"rollout": round(share * training, 2), "learning": round((1 - share) * training, 2)}
    wall = {command: round(sum(parts.values()), 2) for command, parts in seconds.items()}
    report(
        {
            "options": options,
            "wall_s": wall | {"both": round(sum(wall.values()), 2)},
            "rollout_share_of_update": round(share, 3),
            "seconds": seconds,
        }
    )


def run_config(overlay: str | None = None) -> RunConfig:
    return check(apply_yaml(RunConfig(), overlay) if overlay else RunConfig())


def train(run_dir: str, *overlay: str) -> None:
    config = dataclasses.replace(run_config(*overlay), run_dir=Path(run_dir))
    jaxnav.runs.train.train(config, Console(stderr=True))


def evaluate(run_dir: str) -> None:
    results = jaxnav.runs.evaluate.evaluate(Run.open(run_dir), console=Console(stderr=True))
    results.write(Path(run_dir) / "eval-val.json")


def timed(command: str, arguments: list[str], target: Path) -> dict[str, float]:
    """Return the seconds of every label, and of the rest."""
    print(command, *arguments, file=sys.stderr, flush=True)
    began = time.time()
    process = [sys.executable, __file__, "--timed", command, str(target), str(began), *arguments]
    subprocess.run(process, check=True, stdout=subprocess.DEVNULL)
    wall = time.time() - began
    seconds = {label: taken for label, taken in json.loads(target.read_text()).items() if taken}
    return {name: round(taken, 2) for name, taken in (seconds | {"other": wall - sum(seconds.values())}).items()}


def run_timed(command: str, target: str, began: str, *arguments: str) -> None:
    """Run one command here and write where its seconds went.

    The parent started this process at `began`.
    """
    spans: Spans = {"imports": [(float(began), time.time())]}

    def timer(label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.time()
            result = function(*args, **kwargs)
            spans.setdefault(label, []).append((began, time.time()))
            return result

        return call

    def compiled(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            spans.setdefault("compile", []).append((time.time() - duration_secs, time.time()))

    jax.monitoring.register_event_duration_secs_listener(compiled)
    for label, places in TIMED.items():
        for owner, name in places:
            setattr(owner, name, timer(label, getattr(owner, name)))
    {"train.py": train, "eval.py": evaluate}[command](*arguments)
    Path(target).write_text(json.dumps(painted(spans)))


def painted(spans: Spans) -> dict[str, float]:
    """Return the seconds of each label that none before has."""
    seen: list[tuple[float, float]] = []
    seconds, before = {}, 0.0
    for label in LABELS:
        seen += spans.get(label, [])
        total, reached = 0.0, 0.0
        for start, stop in sorted(seen):
            total += max(0.0, stop - max(start, reached))
            reached = max(reached, stop)
        seconds[label], before = total - before, total
    return seconds


def rollout_share(config: RunConfig) -> float:
    """Return the rollout's share of the arms' updates."""
    taken = in_turns({name: program.call for name, program in phases(set_up(config)).items()}, TURNS)
    rolling = sum(min(seconds) for name, seconds in taken.items() if name.endswith("rollout"))
    return rolling / sum(min(seconds) for name, seconds in taken.items() if name.endswith("update"))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--timed"]:
        run_timed(*sys.argv[2:])
    else:
        main(sys.argv[1:])
