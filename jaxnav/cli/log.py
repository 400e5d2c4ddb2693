"""The log command: forward a run's training log to TensorBoard or Weights & Biases."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.runs.run import Run
from jaxnav.runs.tracking import send_log


@dataclasses.dataclass(frozen=True)
class LogConfig:
    """Show the training log of a run elsewhere.

    Attributes:
      run: the run directory; training may still go on.
      to: `tensorboard` writes RUN/tensorboard, `wandb` sends to Weights & Biases (WANDB_MODE=offline: to RUN/wandb).
      follow: go on until the run is finished.
      project: of Weights & Biases.
    """

    run: Annotated[Path, tyro.conf.Positional]
    to: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    follow: bool = False
    project: str = "jaxnav"


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    config = parse_arguments(LogConfig, arguments, "jaxnav log", "Show a training log elsewhere.")
    return run_command(lambda console: _send(config, console))


def _send(config: LogConfig, console: Console) -> None:
    """Send the rows logged so far; with `--follow`, until the run is finished or Ctrl-C."""
    try:
        num_rows = send_log(Run.open(config.run), config.to, config.follow, config.project)
    except KeyboardInterrupt:
        console.print("stopped; what was logged so far has been sent")
        return
    console.print(f"{num_rows} rows of {config.run} sent to {' and '.join(config.to)}")
