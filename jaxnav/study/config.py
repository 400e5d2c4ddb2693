"""The training runs of the study."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from jaxnav.cli.options import parse
from jaxnav.cli.train import train
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, WorldConfig, check
from jaxnav.runs.directory import load_run, settings
from jaxnav.runs.policies import load_policies


@dataclasses.dataclass(frozen=True)
class StudyConfig:
    """The study; what is finished is kept, so it goes on where it was interrupted.

    Attributes:
      results: folder of the results, one JSON file for each part.
      document: what they say, made from them alone; figures go into a folder beside it.
      runs: folder of the training runs.
      trainings: which runs; `main` is always there.
      real: scene file with `train` and `val`; one more run is trained on it and relabelled.
      split: scenes to evaluate on. `test` takes the epsilon that `val` chose; use it once.
      shifts: of the layout; the first is the training layout.
      epsilon: thresholds of sTDE.
      episodes: at each shift.
      steps: of the gap's course.
      seed: of episode lists, sampled actions and bootstraps.
      base: the runs' common settings.
    """

    results: Path = Path("results")
    document: Path = Path("docs/study.md")
    runs: Path = Path("runs/study")
    trainings: tuple[str, ...] = ("main", "none", "coin", "goal", "released", "paper", "gate", "direct", "shaping")
    real: Path | None = None
    split: Literal["val", "test"] = "val"
    shifts: tuple[float, ...] = (0.0, 0.5, 1.0)
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    episodes: int = 1000
    steps: int = 40
    seed: int = 0
    base: RunConfig = RunConfig(seeds=5, worlds=WorldConfig(num_val=80, num_test=80))


#: What each run changes. Runs with the layout arm alone are compared with their own layout's weights.
CHANGES: dict[str, dict[str, Any]] = {
    "main": {},
    "none": {"counterfactual": "none", "arms": ("layout",)},
    "coin": {"counterfactual": "coin", "arms": ("layout",)},
    "released": {"layout": {"setting": "released"}, "arms": ("layout",)},
    "paper": {"layout": {"setting": "paper"}, "arms": ("layout",)},
    "goal": {"direct": "goal"},
    "direct": {"direct": "none"},
    "gate": {"done_gate": True},
    "shaping": {"worlds": {"shaping": 1.0}},
}


def parse_study(arguments: list[str] | None) -> StudyConfig:
    """Settings of a study: defaults, then the file of `--config`, then the other options.

    Raises:
      InputError: bad config file or setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    config = parse(StudyConfig(), arguments, "eval.py study", "Put the paper's claims to the test.")
    if unknown := set(config.trainings) - set(CHANGES):
        raise InputError(f"trainings: {sorted(unknown)[0]!r} is unknown; choose from {', '.join(CHANGES)}")
    shifts = config.shifts
    rising = all(a < b for a, b in itertools.pairwise(shifts))
    if not (len(shifts) >= 2 and rising and shifts[0] >= 0.0 and shifts[-1] <= 1.0):
        raise InputError(f"shifts: {shifts}: give two or more from 0 to 1, rising")
    if not (config.epsilon and all(0.0 <= epsilon < float("inf") for epsilon in config.epsilon)):
        raise InputError(f"epsilon: {config.epsilon}: give numbers from 0 to below infinity")
    for name in ("episodes", "steps"):
        if getattr(config, name) < 1:
            raise InputError(f"{name}: {getattr(config, name)}: give at least 1")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"seed: {config.seed}: give a whole number from 0 to 2**32 - 1")
    if not isinstance(config.base.devices, int | None):
        raise InputError(f"base.devices: {config.base.devices}: a study is one process; give a number of devices")
    if config.real is not None and not config.real.is_file():
        raise InputError(f"real: {config.real}: there is no such file")
    return config


def training(config: StudyConfig, name: str) -> RunConfig:
    """The settings of one of the study's runs."""
    changes = {"scenes": config.real} if name == "real" else CHANGES[name]
    nested = {
        key: dataclasses.replace(getattr(config.base, key), **value) if isinstance(value, dict) else value
        for key, value in changes.items()
    }
    return check(dataclasses.replace(config.base, run_dir=config.runs / name, **nested))


def ensure(run: RunConfig, console: Console) -> None:
    """Train a run unless it is finished."""
    try:
        load_policies(run, run.arms)
        finished = settings(load_run(run.run_dir)) == settings(run)
    except InputError:
        finished = False
    if not finished:
        console.print(f"training {run.run_dir}")
        train(run, console)
