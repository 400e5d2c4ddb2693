"""A run's log, sent to where it can be watched."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.directory import Run, settings
from jaxnav.store.sinks import SINKS, Sink

#: Seconds between two looks at the log of a run that goes on.
POLL_S = 5.0
#: What says where a row belongs, and is no number to show.
_PLACE = ("step", "arm", "seed", "env_steps")


def send_log(
    run: Run,
    to: Sequence[str],
    follow: bool = False,
    project: str = "jaxnav",
    wait: Callable[[float], object] = time.sleep,
) -> int:
    """Send the training log of a run to sinks, a series per arm and seed.

    Steps are environment steps. Every row goes once: where a run that was interrupted writes rows anew, they hold the
    same numbers. The training is another process, which no sink can hold up.

    Args:
      run: finished or not.
      to: names of sinks: `tensorboard`, `wandb`.
      follow: go on until the run is finished.
      project: of Weights & Biases.
      wait: called with the seconds between two looks at the log.

    Returns:
      The number of rows.

    Raises:
      InputError: no sink, one whose library is not installed, or a damaged log.
    """
    if not to:
        raise InputError(f"--to: names no sink; give {' or '.join(SINKS)}")
    sinks: dict[str, list[Sink]] = {}
    about, count = settings(run.config), 0
    try:
        for row in _rows(run, follow, wait):
            series = f"{row['arm']}-{row['seed']}"
            if series not in sinks:
                sinks[series] = [SINKS[name](run.config.run_dir, series, project, about) for name in sorted(set(to))]
            values = {name: value for name, value in row.items() if name not in _PLACE and value is not None}
            for sink in sinks[series]:
                sink.write(row["env_steps"], values)
            count += 1
    finally:
        for sink in (sink for each in sinks.values() for sink in each):
            sink.close()
    return count


def _rows(run: Run, follow: bool, wait: Callable[[float], object]) -> Iterator[dict[str, Any]]:
    """Yield each row of the log once."""
    seen: dict[tuple[str, int], int] = {}
    while True:
        for row in run.log():
            series = row["arm"], row["seed"]
            if row["step"] > seen.get(series, 0):
                seen[series] = row["step"]
                yield row
        finished = len(seen) == len(run.config.arms) * run.config.seeds
        if not follow or (finished and min(seen.values()) >= run.config.total_updates):
            return
        wait(POLL_S)
