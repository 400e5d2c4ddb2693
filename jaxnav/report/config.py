"""Settings of a report; without imports of plotting packages, so that the command can refuse where they are missing."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True)
class ReportConfig:
    """Configure the report of a training run.

    Attributes:
      run: the run directory.
      beside: that of agents which cannot know any layout, for the accounting of experience; trained in the same world,
        with as many seeds, by `--method anonymous`.
      split: scenes to evaluate on.
      shift: layout shifts, from 0 to 1.
      episodes: in the fixed list, at each shift, as of `eval`.
      epsilon: thresholds of sTDE in the curves.
      threshold: of sTDE in the tables and the replays.
      replays: episodes that can be replayed, in all; those in which the agents differ first.
      seed: of the episode list and the sampled actions.
      out: where to write the page; default: report.html in the run directory.
    """

    run: Path
    beside: Path | None = None
    split: Literal["train", "val", "test"] = "val"
    shift: tuple[float, ...] = (0.0, 1.0)
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    threshold: float = 0.5
    replays: int = 60
    seed: int = 0
    out: Path | None = None
