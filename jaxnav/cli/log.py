"""The log command: forward a run's training log to TensorBoard or Weights & Biases."""

import dataclasses
from pathlib import Path
from typing import Literal

from rich.console import Console

from jaxnav.cli.console import parse_arguments, run_command

DESCRIPTION = "Show a training log in TensorBoard or Weights & Biases, also while training is running."


@dataclasses.dataclass(frozen=True)
class LogConfig:
    """Options of the log command.

    Attributes:
      run: run directory of a finished or a running training.
      to: where to show the log: `tensorboard` writes RUN/tensorboard, `wandb` sends to Weights & Biases, or writes
        RUN/wandb if the environment variable WANDB_MODE is `offline`.
      follow: continue until the training is finished.
      project: project in Weights & Biases.
    """

    run: Path
    to: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    follow: bool = False
    project: str = "jaxnav"


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(_send, lambda: parse_arguments(LogConfig, arguments, "jaxnav log", DESCRIPTION), compiles=False)


def _send(config: LogConfig, console: Console) -> None:
    """Send the rows logged so far; with `--follow`, until the run is finished or Ctrl-C."""
    from jaxnav.runs.run import Run
    from jaxnav.runs.tracking import send_log

    try:
        num_rows = send_log(Run.open(config.run), config.to, config.follow, config.project)
    except KeyboardInterrupt:
        console.print("stopped; every row logged so far has been sent")
        return
    console.print(f"{num_rows} rows of {config.run} sent to {' and '.join(config.to)}")
