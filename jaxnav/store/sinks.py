"""Where a run's log can be shown: TensorBoard, Weights & Biases.

A sink takes the rows of one series, an agent of the run, in order. The log itself stays in the run directory.
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
    """Take numbers by name, step by step."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Take the numbers of a step; steps rise."""
        ...

    def close(self) -> None:
        """Finish what was taken."""
        ...


class TensorBoard:
    """Write event files into `RUN/tensorboard/SERIES`; earlier ones there are replaced."""

    def __init__(self, run_dir: Path, series: str, project: str, settings: Mapping[str, Any]) -> None:
        folder = run_dir / "tensorboard" / series
        writer = _installed("tensorboardX", "tensorboard").SummaryWriter
        for old in folder.glob("events.out.tfevents.*"):
            old.unlink()
        self._writer = writer(logdir=str(folder))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write the numbers of a step."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class WandB:
    """Send to a run of Weights & Biases, one per series, in a group per training run.

    Its id depends on settings and series, so that a log that is sent again goes to the same run. WANDB_MODE=offline
    keeps it on disk.
    """

    def __init__(self, run_dir: Path, series: str, project: str, settings: Mapping[str, Any]) -> None:
        identity = json.dumps([settings, series], sort_keys=True).encode()
        self._run = _installed("wandb", "wandb").init(
            project=project,
            group=run_dir.resolve().name,
            name=series,
            id=hashlib.sha256(identity).hexdigest()[:16],
            config=dict(settings),
            dir=str(run_dir),
            resume="allow",
            reinit="create_new",
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Send the numbers of a step."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Wait until all is sent."""
        self._run.finish()


SINKS = {"tensorboard": TensorBoard, "wandb": WandB}


def _installed(module: str, extra: str) -> ModuleType:
    """Import a sink's library.

    Raises:
      InputError: it is not installed; says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"--to {extra}: needs {module}; install it by: pip install 'jaxnav[{extra}]'") from error
