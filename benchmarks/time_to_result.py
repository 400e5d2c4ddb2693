"""Seconds of each part of `make run`.

`python benchmarks/time_to_result.py [OVERLAY]` trains the default run, or that of a YAML file laid over it, as
`train.py` does, and evaluates it as `eval.py` does, each in a process of its own, in a temporary run directory.
Functions are timed from outside, compilation by JAX's own events; where spans overlap a second belongs to the first
label in `LABELS`. Training is one compiled program, so its time is divided by the rollout's share of an update, which
is measured afterwards.
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
from _common import print_report, time_in_turns
from _phases import compile_phases
from _setup import set_up_training
from rich.console import Console

import jaxnav.runs.evaluate
import jaxnav.runs.train
from jaxnav.evaluation.grid import Evaluator
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.evaluate import Results
from jaxnav.runs.run import Run
from jaxnav.training.trainer import Trainer

#: Owner and name of the functions that are timed under each label.
TIMED: dict[str, tuple[tuple[Any, str], ...]] = {
    "scenes": ((jaxnav.runs.train, "compile_training_world"), (jaxnav.runs.evaluate, "compile_evaluation_world")),
    "prior": ((jaxnav.runs.train, "explore_world"),),
    "calibration": ((jaxnav.runs.train, "calibrate_estimator"),),
    "training": ((Trainer, "init"), (Trainer, "train")),
    "checkpoints": tuple(
        (jaxnav.runs.train, name) for name in ("restore_checkpoint", "save_checkpoint", "export_policy")
    ),
    "evaluation": ((Evaluator, "__call__"),),
    "report": (
        *((jaxnav.runs.evaluate, name) for name in ("run_oracle", "build_row", "build_difference", "build_report")),
        (Results, "write"),
    ),
}
LABELS = ("imports", "compile", *TIMED)
TURNS = 5
#: Start and end times of the calls under each label.
Spans = dict[str, list[tuple[float, float]]]


def main(options: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        run_dir = str(Path(folder) / "run")
        seconds = {
            "train.py": time_command("train.py", [run_dir, *options], Path(folder) / "train.json"),
            "eval.py": time_command("eval.py", [run_dir], Path(folder) / "eval.json"),
        }

    # Divide training into rollout and learning.
    rollout_share = measure_rollout_share(make_run_config(*options))
    training_s = seconds["train.py"].pop("training")
    seconds["train.py"]["rollout"] = round(rollout_share * training_s, 2)
    seconds["train.py"]["learning"] = round((1 - rollout_share) * training_s, 2)

    wall_s = {command: round(sum(parts.values()), 2) for command, parts in seconds.items()}
    print_report(
        {
            "options": options,
            "wall_s": wall_s | {"both": round(sum(wall_s.values()), 2)},
            "rollout_share_of_update": round(rollout_share, 3),
            "seconds": seconds,
        }
    )


def make_run_config(overlay: str | None = None) -> RunConfig:
    return check_config(apply_yaml(RunConfig(), overlay) if overlay else RunConfig())


def train(run_dir: str, *overlay: str) -> None:
    config = dataclasses.replace(make_run_config(*overlay), run_dir=Path(run_dir))
    jaxnav.runs.train.train(config, Console(stderr=True))


def evaluate(run_dir: str) -> None:
    results = jaxnav.runs.evaluate.evaluate(Run.open(run_dir), console=Console(stderr=True))
    results.write(Path(run_dir) / "eval-val.json")


def time_command(command: str, arguments: list[str], target: Path) -> dict[str, float]:
    """Run a command in a process of its own, and return the seconds of every label and of the rest."""
    print(command, *arguments, file=sys.stderr, flush=True)
    start_time = time.time()
    process = [sys.executable, __file__, "--timed", command, str(target), str(start_time), *arguments]
    subprocess.run(process, check=True, stdout=subprocess.DEVNULL)
    wall_s = time.time() - start_time

    seconds = {label: label_s for label, label_s in json.loads(target.read_text()).items() if label_s}
    seconds["other"] = wall_s - sum(seconds.values())
    return {label: round(label_s, 2) for label, label_s in seconds.items()}


def run_timed(command: str, target: str, process_start: str, *arguments: str) -> None:
    """Run one command in this process and write the seconds of every label.

    Args:
      command: `train.py` or `eval.py`.
      target: JSON file to write.
      process_start: time at which the parent started this process.
      arguments: of the command.
    """
    spans: Spans = {"imports": [(float(process_start), time.time())]}

    def add_timer(label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            start_time = time.time()
            result = function(*args, **kwargs)
            spans.setdefault(label, []).append((start_time, time.time()))
            return result

        return call

    def on_duration(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            spans.setdefault("compile", []).append((time.time() - duration_secs, time.time()))

    # Add the timers, then run the command.
    jax.monitoring.register_event_duration_secs_listener(on_duration)
    for label, functions in TIMED.items():
        for owner, name in functions:
            setattr(owner, name, add_timer(label, getattr(owner, name)))

    run_command = {"train.py": train, "eval.py": evaluate}[command]
    run_command(*arguments)
    Path(target).write_text(json.dumps(attribute_seconds(spans)))


def attribute_seconds(spans: Spans) -> dict[str, float]:
    """Return the seconds of each label that are not in a span of an earlier label."""
    seconds = {}
    spans_so_far: list[tuple[float, float]] = []
    total_before = 0.0
    for label in LABELS:
        # A label adds to the length of the union of all spans.
        spans_so_far += spans.get(label, [])
        total = 0.0
        covered_until = 0.0
        for start, stop in sorted(spans_so_far):
            total += max(0.0, stop - max(start, covered_until))
            covered_until = max(covered_until, stop)
        seconds[label] = total - total_before
        total_before = total
    return seconds


def measure_rollout_share(config: RunConfig) -> float:
    """Return the rollout's share of the arms' updates."""
    programs = compile_phases(set_up_training(config))
    times = time_in_turns({name: program.call for name, program in programs.items()}, TURNS)
    rollout_s = sum(min(call_times) for name, call_times in times.items() if name.endswith("rollout"))
    update_s = sum(min(call_times) for name, call_times in times.items() if name.endswith("update"))
    return rollout_s / update_s


if __name__ == "__main__":
    if sys.argv[1:2] == ["--timed"]:
        run_timed(*sys.argv[2:])
    else:
        main(sys.argv[1:])
