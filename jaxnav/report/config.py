"""Settings of a report; a module of its own, so that the help of the command needs no plotting packages."""

import dataclasses
from pathlib import Path

from jaxnav.choices import ShiftKind, Split


@dataclasses.dataclass(frozen=True)
class ReportConfig:
    """Settings of the report of a training run.

    Attributes:
      run: run directory of a finished training.
      reference: run directory of layout-blind agents, with which the value and the cost of experience are measured.
        Train it with `--method anonymous` in the same world and with as many seeds.
      split: scenes to evaluate on.
      shift: layout shifts of the scenes, each from 0 (as in training) to 1.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      episodes: number of fixed episodes at each layout shift, at least 1.
      epsilon: thresholds of sTDE in the curves, each at least 0; `threshold` is that of the tables.
      threshold: threshold of sTDE in the tables and replays, at least 0.
      replays: number of episodes that can be replayed, at least one for each layout shift. Episodes in which the agents
        differ come first.
      seed: random seed of the episode list and of sampled actions, from 0 to 4,294,967,295.
      out: HTML file to write. The default is `report.html` in the run directory.
    """

    run: Path
    reference: Path | None = None
    split: Split = "val"
    shift: tuple[float, ...] = (0.0, 1.0)
    shift_by: ShiftKind = "size"
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    threshold: float = 0.5
    replays: int = 60
    seed: int = 0
    out: Path | None = None
