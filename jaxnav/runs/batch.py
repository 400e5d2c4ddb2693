"""Training of several runs side by side, which differ in settings of PPO that need no new compilation.

`train_batch` trains a run for each value of some settings. All runs share scenes, layout prior and compiled programs,
so a search over learning rates costs one preparation and one compilation.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.runs.config import MAX_SEEDS, RunConfig, check_config
from jaxnav.runs.run import Run
from jaxnav.runs.train import TrainCallback, check_config_and_method, train_runs
from jaxnav.training.devices import exit_if_process_lost

#: Settings of `RunConfig.ppo` that may differ between the runs of a batch.
BATCH_SETTINGS = (
    "learning_rate",
    "gamma",
    "gae_lambda",
    "clip",
    "entropy",
    "final_entropy",
    "value",
    "distil",
    "guidance",
    "final_guidance",
    "experience",
)


@exit_if_process_lost()
def train_batch(
    config: RunConfig,
    console: Console | None = None,
    callback: TrainCallback | None = None,
    **settings: Any,
) -> list[Run]:
    """Train runs that differ in settings of PPO, side by side, in one compiled program for each arm and stage.

    Every run gets the policies that `train` would give it. An interrupted batch resumes from its last checkpoint.

    Args:
      config: configuration that all runs share. Run *i* is stored in the folder `i` of `config.run_dir`, which itself
        holds the training state of all, and no run.
      console, callback: see `train`; `seed` in the rows of the log counts through all runs.
      **settings: settings of `config.ppo` by name (`BATCH_SETTINGS`), each with G numbers (a list or array [G]), one
        for each run. For a grid of two settings, give the flattened arrays of `numpy.meshgrid`.

    Returns:
      The G runs. `Run.times` of each is the time of the whole batch.

    Raises:
      InputError: a setting cannot differ between runs, numbers are impossible or of different length, or the directory
        holds something else.
      Interrupted: see `train`.
    """
    config = check_config_and_method(config)
    if config.policy_method.fit is not None:
        raise InputError(f"method {config.method!r}: is fitted without PPO; train its runs one after the other")
    run_configs = list_run_configs(config, settings)
    num_policies = config.seeds * len(run_configs)
    if num_policies > MAX_SEEDS:
        raise InputError(f"{len(run_configs)} runs x {config.seeds} seeds: give at most {MAX_SEEDS:,} policies in all")

    # The program is compiled for the terms of the loss that the runs have, which the shared settings may lack.
    shared_config = dataclasses.replace(run_configs[0], run_dir=config.run_dir, seeds=num_policies)
    train_runs(shared_config, run_configs, console, callback)
    return [Run(run_config) for run_config in run_configs]


def list_run_configs(config: RunConfig, settings: Mapping[str, Any]) -> list[RunConfig]:
    """List the configurations of the runs of a batch; see `train_batch`."""
    if not settings:
        raise InputError(f"no settings; give one or more of {', '.join(BATCH_SETTINGS)}, with a number for each run")
    columns: dict[str, np.ndarray] = {}
    for name, values in settings.items():
        if name not in BATCH_SETTINGS:
            raise InputError(f"{name}: cannot differ between runs of a batch; choose from {', '.join(BATCH_SETTINGS)}")
        try:
            columns[name] = np.asarray(values, float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: {values!r}; give a list of numbers, one for each run") from error
        if columns[name].ndim != 1 or not columns[name].size:
            raise InputError(f"{name}: has shape {columns[name].shape}; give a list of numbers, one for each run")
    num_values = {name: len(column) for name, column in columns.items()}
    if len(set(num_values.values())) > 1:
        raise InputError(f"settings have different numbers of values ({num_values}); give one of each for every run")

    run_configs = []
    for index, point_values in enumerate(zip(*columns.values(), strict=True)):
        changes = {name: float(value) for name, value in zip(columns, point_values, strict=True)}
        ppo = dataclasses.replace(config.ppo, **changes)
        run_configs.append(check_config(dataclasses.replace(config, run_dir=config.run_dir / str(index), ppo=ppo)))
    _check_programs(run_configs)
    return run_configs


def _check_programs(run_configs: Sequence[RunConfig]) -> None:
    """Refuse runs that need different programs: the terms of the loss are fixed when it is compiled."""
    if len({run_config.ppo.has_guidance for run_config in run_configs}) > 1:
        raise InputError(
            "guidance: some runs have guidance (guidance or final_guidance above 0) and some have none, which needs "
            "two programs; train them in two batches"
        )
    if len({run_config.ppo.experience_prob < 1.0 for run_config in run_configs}) > 1:
        raise InputError(
            "experience: some runs have experience in all episodes (1) and some do not, which needs two programs; "
            "train them in two batches"
        )
