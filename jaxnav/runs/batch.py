"""Training of several runs side by side, which differ in settings of PPO that need no new compilation.

`train_batch` trains a run for each point of a grid. All points share scenes, layout prior and compiled programs, so a
search over learning rates costs one preparation and one compilation.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.run import LOG_FILE, TIMES_FILE, Run, RunLogs
from jaxnav.runs.train import TrainCallback, check_config_and_method, train_points
from jaxnav.store.files import write_log_rows
from jaxnav.training.devices import exit_if_process_lost, is_first_process

#: Settings of `RunConfig.ppo` that may differ between the runs of a batch.
BATCH_SETTINGS = (
    *("learning_rate", "gamma", "gae_lambda", "clip", "entropy", "final_entropy", "value"),
    *("guidance", "final_guidance", "experience"),
)


@exit_if_process_lost()
def train_batch(
    config: RunConfig,
    console: Console | None = None,
    callback: TrainCallback | None = None,
    **settings: Any,
) -> list[Run]:
    """Train runs that differ in settings of PPO, side by side, in one compiled program for each arm.

    Every run gets the policies that `train` would give it. An interrupted batch resumes from its last checkpoint.

    Args:
      config: configuration that all runs share. Run *i* is stored in the folder `i` of `config.run_dir`, and the
        training state of all in `config.run_dir` itself.
      console, callback: see `train`; `seed` in the rows of the log counts through all runs.
      **settings: settings of `config.ppo` by name, each with G numbers (a list or array [G]), one for each run. For a
        grid of two settings, give the flattened arrays of `numpy.meshgrid`.

    Returns:
      The G runs.

    Raises:
      InputError: a setting cannot differ between runs, numbers are impossible or of different length, or the directory
        holds something else.
      Interrupted: see `train`.
    """
    config = check_config_and_method(config)
    if config.policy_method.fit is not None:
        raise InputError(f"method {config.method!r}: is fitted without PPO; train its runs one after the other")
    points = list_points(config, settings)
    batch_config = check_config(dataclasses.replace(config, seeds=config.seeds * len(points)))
    train_points(batch_config, points, console, callback)
    if is_first_process():
        _split_logs(batch_config, points)
    return [Run(point) for point in points]


def list_points(config: RunConfig, settings: dict[str, Any]) -> list[RunConfig]:
    """List the configurations of the runs of a batch; see `train_batch`."""
    if not settings:
        raise InputError(f"no settings; give one or more of {', '.join(BATCH_SETTINGS)}, with a number for each run")
    for name, values in settings.items():
        if name not in BATCH_SETTINGS:
            raise InputError(f"{name}: cannot differ between runs of a batch; choose from {', '.join(BATCH_SETTINGS)}")
        if np.ndim(values) != 1 or not np.size(values):
            raise InputError(f"{name}: has shape {np.shape(values)}; give a list of numbers, one for each run")
    lengths = {name: len(values) for name, values in settings.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"settings have different numbers of values ({lengths}); give one of each for every run")

    points = []
    for index in range(next(iter(lengths.values()))):
        values = {name: float(settings[name][index]) for name in settings}
        point = dataclasses.replace(
            config, run_dir=config.run_dir / str(index), ppo=dataclasses.replace(config.ppo, **values)
        )
        points.append(check_config(point))
    _check_programs(points)
    return points


def _check_programs(points: Sequence[RunConfig]) -> None:
    """Refuse points that need different programs: the terms of the loss are fixed when it is compiled."""
    for name, has_term in (
        ("guidance", [point.ppo.has_guidance for point in points]),
        ("experience", [point.ppo.experience_prob < 1.0 for point in points]),
    ):
        if len(set(has_term)) > 1:
            without = 0 if name == "guidance" else 1
            raise InputError(f"{name}: is {without} in some runs only, which needs another program; train those alone")


def _split_logs(config: RunConfig, points: Sequence[RunConfig]) -> None:
    """Give each run its rows of the training log, and the times of all."""
    logs = RunLogs(config)
    rows = logs.read(LOG_FILE)
    times = logs.read(TIMES_FILE)
    for index, point in enumerate(points):
        first_seed = index * point.seeds
        point_rows = []
        for row in rows:
            if first_seed <= row["seed"] < first_seed + point.seeds:
                point_rows.append(row | {"seed": row["seed"] - first_seed})
        write_log_rows(point.run_dir / LOG_FILE, point_rows)
        write_log_rows(point.run_dir / TIMES_FILE, times)
