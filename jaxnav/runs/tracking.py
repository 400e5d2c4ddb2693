"""Forwarding of a run's training log to TensorBoard and Weights & Biases."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.run import Run, run_settings
from jaxnav.store.sinks import SINKS, Sink

#: Seconds between two reads of the log of a run that is still training.
POLL_S = 5.0
#: Columns that place a row in the log, and are not logged as values.
_PLACE_COLUMNS = ("step", "arm", "seed", "env_steps")


def send_log(run: Run, to: Sequence[str], follow: bool = False, project: str = "jaxnav") -> int:
    """Send the training log of a run to sinks, as one series per arm and seed.

    Steps of a series are environment steps. Every row is sent once: rows that an interrupted run writes again hold the
    same numbers. Training runs in another process, so a slow sink does not delay it.

    Args:
      run: a run, finished or not.
      to: names of sinks: `tensorboard`, `wandb`.
      follow: continue until the run is finished.
      project: project in Weights & Biases.

    Returns:
      The number of rows.

    Raises:
      InputError: no sink is named, the library of a sink is not installed, or the log is damaged.
    """
    if not to:
        raise InputError(f"--to: no service is named; give {' or '.join(SINKS)}")

    settings = run_settings(run.config)
    sinks_by_series: dict[str, list[Sink]] = {}
    num_rows = 0
    try:
        for row in _new_rows(run, follow):
            # Sinks of a series open with its first row.
            series_name = f"{row['arm']}-{row['seed']}"
            if series_name not in sinks_by_series:
                run_dir = run.config.run_dir
                sinks_by_series[series_name] = [
                    SINKS[name](run_dir, series_name, project, settings) for name in sorted(set(to))
                ]

            # Missing values, such as scores between two validations, are not sent.
            metric_values = {}
            for name, metric_value in row.items():
                if name not in _PLACE_COLUMNS and metric_value is not None:
                    metric_values[name] = metric_value
            for sink in sinks_by_series[series_name]:
                sink.write(row["env_steps"], metric_values)
            num_rows += 1
    finally:
        for series_sinks in sinks_by_series.values():
            for sink in series_sinks:
                sink.close()
    return num_rows


def _new_rows(run: Run, follow: bool) -> Iterator[dict[str, Any]]:
    """Yield each row of the log once, and wait for new ones with `follow`."""
    num_series = len(run.config.arms) * run.config.seeds
    last_step: dict[tuple[str, int], int] = {}
    while True:
        # The whole log is read again; rows up to the last step of their series were sent before.
        for row in run.log():
            series_key = (row["arm"], row["seed"])
            if row["step"] > last_step.get(series_key, 0):
                last_step[series_key] = row["step"]
                yield row

        # A run is finished when every series has its last row.
        has_all_series = len(last_step) == num_series
        is_finished = has_all_series and min(last_step.values()) >= run.config.total_updates
        if is_finished or not follow:
            return
        time.sleep(POLL_S)
