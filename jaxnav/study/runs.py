"""Training runs of the study."""

import dataclasses

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import load_run, settings
from jaxnav.runs.policies import load_policies
from jaxnav.runs.train import train
from jaxnav.study.config import CHANGES, StudyConfig


def study_runs(config: StudyConfig) -> dict[str, RunConfig]:
    """Return the settings of all runs by name, `main` first."""
    names = dict.fromkeys(("main", *config.trainings, *(("real",) if config.real else ())))
    return {name: run_config(config, name) for name in names}


def run_config(config: StudyConfig, name: str) -> RunConfig:
    """Return the settings of one run.

    Raises:
      InputError: the run's settings are impossible.
    """
    changes = {"scenes": config.real} if name == "real" else CHANGES[name]
    nested = {
        key: dataclasses.replace(getattr(config.base, key), **value) if isinstance(value, dict) else value
        for key, value in changes.items()
    }
    return check(dataclasses.replace(config.base, run_dir=config.runs / name, **nested))


def ensure_trained(run: RunConfig, console: Console) -> None:
    """Train a run unless it is finished."""
    try:
        load_policies(run, run.arms)
        finished = settings(load_run(run.run_dir)) == settings(run)
    except InputError:
        finished = False
    if not finished:
        console.print(f"training {run.run_dir}")
        train(run, console)
