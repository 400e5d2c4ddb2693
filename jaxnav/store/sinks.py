"""Services that display a run's log: TensorBoard and Weights & Biases.

A sink receives the rows of one series, that is of one agent of the run, in order. The log itself stays in the run
directory. `SINKS` has the sinks by name.
"""

import hashlib
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from jaxnav.errors import InputError


class Sink(Protocol):
    """Receiver of named numbers, step by step."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write the numbers of a step; steps increase."""

    def close(self) -> None:
        """Finish writing."""


class TensorBoardSink:
    """Event files in `RUN/tensorboard/SERIES`, which replace earlier ones there."""

    def __init__(self, run_dir: Path, series: str, project: str, settings: Mapping[str, Any]) -> None:
        events_folder = run_dir / "tensorboard" / series
        writer_class = _import_library("tensorboardX", "tensorboard").SummaryWriter
        # Remove the events of an earlier call, which TensorBoard would draw as a second curve.
        for old_events in events_folder.glob("events.out.tfevents.*"):
            old_events.unlink()
        self._writer = writer_class(logdir=str(events_folder))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write the numbers of a step."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class WandBSink:
    """Runs of Weights & Biases, one per series, in a group per training run.

    The id of a run depends on settings and series, so that sending a log again updates the same run. With
    WANDB_MODE=offline the run stays on disk.
    """

    def __init__(self, run_dir: Path, series: str, project: str, settings: Mapping[str, Any]) -> None:
        identity_bytes = json.dumps([settings, series], sort_keys=True).encode()
        self._run = _import_library("wandb", "wandb").init(
            project=project,
            group=run_dir.resolve().name,
            name=series,
            id=hashlib.sha256(identity_bytes).hexdigest()[:16],
            config=dict(settings),
            dir=str(run_dir),
            resume="allow",
            reinit="create_new",
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Send the numbers of a step."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Wait until everything is sent."""
        self._run.finish()


SINKS = {"tensorboard": TensorBoardSink, "wandb": WandBSink}


def _import_library(module: str, extra: str) -> ModuleType:
    """Import a sink's library.

    Raises:
      InputError: the library is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"--to {extra}: needs {module}; install it with: pip install 'jaxnav[{extra}]'") from error
