"""Settings of the study."""

import dataclasses
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, WorldConfig


@dataclasses.dataclass(frozen=True)
class StudyConfig:
    """Describe a study; finished runs and results are kept.

    Attributes:
      results: folder of the results, one JSON file for each part.
      document: Markdown file written from the results; figures go into a folder beside it.
      runs: folder of the training runs.
      trainings: names of the training runs; `main` is always there.
      real: scene file with `train` and `val`; one more run is trained on it and its layout shifted.
      split: scenes to evaluate on. `test` takes the epsilon chosen on `val`; use it once.
      shifts: layout shifts; the first is the training layout.
      epsilon: thresholds of sTDE.
      episodes: number at each shift.
      steps: length of the gap curves.
      seed: of episode lists and sampled actions.
      base: settings that all runs share.
    """

    results: Path = Path("results")
    document: Path = Path("docs/study.md")
    runs: Path = Path("runs/study")
    trainings: tuple[str, ...] = (
        "main",
        "anonymous",
        "streams",
        "none",
        "coin",
        "goal",
        "released",
        "paper",
        "gate",
        "direct",
        "shaping",
    )
    real: Path | None = None
    split: Literal["val", "test"] = "val"
    shifts: tuple[float, ...] = (0.0, 0.5, 1.0)
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    episodes: int = 1000
    steps: int = 40
    seed: int = 0
    base: RunConfig = RunConfig(seeds=5, total_steps=2_000_000, worlds=WorldConfig(num_val=80, num_test=80))


#: Settings that each run changes. Runs of the layout arm alone are compared with their plain layout weights; agents of
#: `anonymous` cannot know any layout, and all others are compared with them.
CHANGES: Mapping[str, Mapping[str, Any]] = {
    "main": {},
    "anonymous": {"method": "anonymous", "arms": ("baseline",)},
    "streams": {"decision": "streams", "arms": ("layout",)},
    "none": {"counterfactual": "none", "arms": ("layout",)},
    "coin": {"counterfactual": "coin", "arms": ("layout",)},
    "released": {"layout": {"setting": "released"}, "arms": ("layout",)},
    "paper": {"layout": {"setting": "paper"}, "arms": ("layout",)},
    "goal": {"direct": "goal"},
    "direct": {"direct": "none"},
    "gate": {"done_gate": True},
    "shaping": {"worlds": {"shaping": 1.0}},
}

#: The run of agents that cannot know any layout; whatever is measured beside them depends on whether it is there.
WITHOUT = "anonymous"


def check_study(config: StudyConfig) -> StudyConfig:
    """Return the same config if every setting is possible.

    Raises:
      InputError: names the first impossible setting.
    """
    if unknown := set(config.trainings) - set(CHANGES):
        raise InputError(f"trainings: {sorted(unknown)[0]!r} is unknown; choose from {', '.join(CHANGES)}")
    shifts = config.shifts
    rising = all(a < b for a, b in itertools.pairwise(shifts))
    if not (len(shifts) >= 2 and rising and shifts[0] >= 0.0 and shifts[-1] <= 1.0):
        raise InputError(f"shifts: {shifts}: give two or more from 0 to 1, rising")
    if not (config.epsilon and all(0.0 <= epsilon < float("inf") for epsilon in config.epsilon)):
        raise InputError(f"epsilon: {config.epsilon}: give numbers from 0 to below infinity")
    if config.steps < 1:
        raise InputError(f"steps: {config.steps}: give at least 1")
    check_shared(config.episodes, config.seed, config.base)
    if config.real is not None and not config.real.is_file():
        raise InputError(f"real: {config.real}: there is no such file")
    return config


def check_shared(episodes: int, seed: int, base: RunConfig) -> None:
    """Check what everything that trains many runs is given.

    Raises:
      InputError: names the first impossible setting.
    """
    if episodes < 1:
        raise InputError(f"episodes: {episodes}: give at least 1")
    if not 0 <= seed < 2**32:
        raise InputError(f"seed: {seed}: give a whole number from 0 to 2**32 - 1")
    if not isinstance(base.devices, int | None):
        raise InputError(f"base.devices: {base.devices}: all runs are trained in one process; give a number of devices")


def study_identity(config: StudyConfig) -> dict[str, Any]:
    """Return as JSON the settings that decide a part's numbers.

    File places, the split and the list of other runs are left out.
    """
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    settings["without"] = WITHOUT in config.trainings
    for name in ("results", "document", "runs", "split", "trainings", "real"):
        settings.pop(name)
    for name in ("run_dir", "save_every", "cache", "devices"):
        settings["base"].pop(name)
    return settings
