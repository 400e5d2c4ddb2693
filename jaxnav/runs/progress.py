"""How far a training run is, as a bar or in lines."""

import time

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.runs.config import RunConfig
from jaxnav.training.trainer import Metrics

_LINES_EVERY = 4  # chunks, where there is no bar


class Shown:
    """Show chunks of updates on a console: a bar on a terminal, else lines."""

    def __init__(self, config: RunConfig, done: int, console: Console) -> None:
        """Prepare to show a run that has done so many updates."""
        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        self._config, self._console = config, console
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("compiling", total=config.total_updates, completed=done)

    def __enter__(self) -> "Shown":
        self._bar.start()
        self._began, self._took = time.monotonic(), 0.0
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def trained(self) -> None:
        """Note the end of a chunk, before anything else takes time."""
        self._took = time.monotonic() - self._began

    def tell(self, metrics: Metrics, done: int) -> None:
        """Show the metrics of a chunk, and that the next one begins."""
        config = self._config
        rate = config.chunk * config.update_steps * config.seeds * len(metrics) / self._took
        success = {name: np.mean([values["success"] for values in seeds]) for name, seeds in metrics.items()}
        shares = ", ".join(f"{name} SR {100 * share:.0f} %" for name, share in success.items())
        skipped = sum(values["skipped_steps"] for seeds in metrics.values() for values in seeds)
        warning = f", {skipped:.0f} gradient steps skipped as not finite" if skipped else ""
        line = f"update {done}/{config.total_updates}, {rate / 1000:.0f} k steps/s, {shares}{warning}"
        self._bar.update(self._task, completed=done, description=line)
        if not self._console.is_terminal and (done // config.chunk) % _LINES_EVERY == 0:
            self._console.print(line)
        self._began = time.monotonic()
