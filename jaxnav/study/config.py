"""Configuration of the study, and its training runs.

A study trains several runs that differ from a shared base in few settings (`RUN_CHANGES`). `study_run_configs` lists
their configurations, `ensure_trained` trains those that are missing, and `study_identity` decides whether stored
results are still valid.
"""

import dataclasses
import itertools
import json
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, WorldConfig, check_config
from jaxnav.runs.policies import load_policies
from jaxnav.runs.run import load_run_config, run_settings
from jaxnav.runs.train import train


@dataclasses.dataclass(frozen=True)
class StudyConfig:
    """Configuration of a study; finished runs and results are reused.

    Attributes:
      results: folder of the results, one JSON file for each part.
      document: Markdown file written from the results; figures go into a folder beside it.
      runs: folder of the training runs.
      trainings: names of the training runs; `main` is always included.
      real: scene file with `train` and `val`; one more run is trained on it, and its layout is shifted.
      split: scenes to evaluate on. `test` uses the epsilon chosen on `val`; use it once.
      shifts: layout shifts; the first is the training layout.
      epsilon: thresholds of sTDE.
      episodes: number of episodes at each shift.
      steps: length of the gap curves.
      seed: seed of episode lists and sampled actions.
      base: settings shared by all runs.
    """

    results: Path = Path("results")
    document: Path = Path("docs/study.md")
    runs: Path = Path("runs/study")
    trainings: tuple[str, ...] = (
        "main",
        "anonymous",
        "streams",
        "none",
        "coin",
        "goal",
        "released",
        "paper",
        "gate",
        "direct",
        "shaping",
    )
    real: Path | None = None
    split: Literal["val", "test"] = "val"
    shifts: tuple[float, ...] = (0.0, 0.5, 1.0)
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    episodes: int = 1000
    steps: int = 40
    seed: int = 0
    base: RunConfig = RunConfig(seeds=5, total_steps=2_000_000, worlds=WorldConfig(num_val=80, num_test=80))


#: Settings of each run that differ from the base. A run of the layout arm alone is compared with its own layout variant
#: without removal. Agents of `anonymous` cannot know any layout; all other runs are compared with them.
RUN_CHANGES: Mapping[str, Mapping[str, Any]] = {
    "main": {},
    "anonymous": {"method": "anonymous", "arms": ("baseline",)},
    "streams": {"decision": "streams", "arms": ("layout",)},
    "none": {"counterfactual": "none", "arms": ("layout",)},
    "coin": {"counterfactual": "coin", "arms": ("layout",)},
    "released": {"layout": {"setting": "released"}, "arms": ("layout",)},
    "paper": {"layout": {"setting": "paper"}, "arms": ("layout",)},
    "goal": {"direct": "goal"},
    "direct": {"direct": "none"},
    "gate": {"done_gate": True},
    "shaping": {"worlds": {"shaping": 1.0}},
}

#: Run of agents that cannot know any layout. Results that compare with it depend on its presence in the study.
UNAWARE_RUN = "anonymous"


def check_study(config: StudyConfig) -> StudyConfig:
    """Return the config unchanged if every setting is valid.

    Raises:
      InputError: names the first invalid setting.
    """
    # Names of runs first, then the numbers of the study.
    unknown_names = sorted(set(config.trainings) - set(RUN_CHANGES))
    if unknown_names:
        raise InputError(f"trainings: {unknown_names[0]!r} is unknown; choose from {', '.join(RUN_CHANGES)}")

    # The first shift is the reference of every comparison, so it must be the smallest.
    shifts = config.shifts
    is_rising = all(itertools.starmap(operator.lt, itertools.pairwise(shifts)))
    if not (len(shifts) >= 2 and is_rising and shifts[0] >= 0.0 and shifts[-1] <= 1.0):
        raise InputError(f"shifts: {shifts}: give two or more from 0 to 1, rising")

    # An infinite epsilon would never remove anything; NaN fails the comparison.
    if not (config.epsilon and all(0.0 <= epsilon < float("inf") for epsilon in config.epsilon)):
        raise InputError(f"epsilon: {config.epsilon}: give numbers from 0 to below infinity")
    if config.steps < 1:
        raise InputError(f"steps: {config.steps}: give at least 1")
    check_shared_settings(config.episodes, config.seed, config.base)
    if config.real is not None and not config.real.is_file():
        raise InputError(f"real: {config.real}: there is no such file")
    return config


def check_shared_settings(episodes: int, seed: int, base: RunConfig) -> None:
    """Check the settings shared by all commands that train several runs.

    Raises:
      InputError: names the first invalid setting.
    """
    if episodes < 1:
        raise InputError(f"episodes: {episodes}: give at least 1")
    if not 0 <= seed < 2**32:
        raise InputError(f"seed: {seed}: give a whole number from 0 to 2**32 - 1")
    if not isinstance(base.devices, int | None):
        raise InputError(f"base.devices: {base.devices}: all runs are trained in one process; give a number of devices")


def study_identity(config: StudyConfig) -> dict[str, Any]:
    """Return the settings that influence the numbers of a part, as JSON.

    File paths, the split and the list of other runs are left out.
    """
    # The way through JSON makes tuples and paths comparable with a stored record.
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    settings["without"] = UNAWARE_RUN in config.trainings

    # These settings may change without a change of any number.
    for name in ("results", "document", "runs", "split", "trainings", "real"):
        settings.pop(name)
    for name in ("run_dir", "save_every", "cache", "devices"):
        settings["base"].pop(name)
    return settings


def study_run_configs(config: StudyConfig) -> dict[str, RunConfig]:
    """Return the configurations of all runs by name, `main` first."""
    # `main` is always included, and only once.
    run_names = dict.fromkeys(("main", *config.trainings))
    if config.real:
        run_names["real"] = None
    return {name: study_run_config(config, name) for name in run_names}


def study_run_config(config: StudyConfig, name: str) -> RunConfig:
    """Return the configuration of one run.

    Raises:
      InputError: the run's settings are invalid.
    """
    # The run on real scenes differs from the base in its scenes alone.
    setting_changes = {"scenes": config.real} if name == "real" else RUN_CHANGES[name]
    run = dataclasses.replace(config.base, run_dir=config.runs / name)
    for field_name, changed_value in setting_changes.items():
        # A dictionary changes single fields of a nested configuration.
        if isinstance(changed_value, dict):
            new_value = dataclasses.replace(getattr(run, field_name), **changed_value)
        else:
            new_value = changed_value
        run = dataclasses.replace(run, **{field_name: new_value})
    return check_config(run)


def ensure_trained(run: RunConfig, console: Console) -> None:
    """Train a run unless it is finished with the same settings."""
    # Loading the policies proves that they exist; equal settings prove that they are those of this study.
    try:
        load_policies(run, run.arms)
        is_finished = run_settings(load_run_config(run.run_dir)) == run_settings(run)
    except InputError:
        is_finished = False
    if not is_finished:
        console.print(f"training {run.run_dir}")
        train(run, console)
