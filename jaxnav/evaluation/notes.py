"""What a reader of an evaluation must be told beside its table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import LEAST_SCENES, paired_difference
from jaxnav.evaluation.variants import Row


def notes(
    rows: Sequence[Row], success: np.ndarray, episodes: EpisodeList, *, room_prior: bool, random: str = "Random"
) -> list[str]:
    """Return what limits the table, a sentence each.

    Args:
      rows: R rows.
      success: float64 [R, S, E].
      episodes: the E episodes.
      room_prior: whether the layout's prior is that of the room's own type, not one for all.
      random: what to call the agent that chooses at random.
    """
    found = _missing_intervals(success.shape[1], episodes)
    if room_prior and any(row.arm == "layout" for row in rows):
        found.append("Rows with w are told the type of the room by their prior, others are not.")
    return found + _no_better(rows, success, episodes, random)


def spent(budget: Mapping[str, int]) -> str:
    """Say what environment steps stand behind a policy.

    Args:
      budget: steps of `exploration`, `imitation` and `learning`.
    """
    exploration, imitation, learning = (f"{budget[name]:,}" for name in ("exploration", "imitation", "learning"))
    return (
        f"Environment steps behind each policy: {exploration} of exploration for the layout priors, {imitation} of "
        f"imitation, {learning} of learning."
    )


def trained_out(log: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say how far val success still rose at the end of training.

    Args:
      log: the rows of a run; see `last_quarter`.
    """
    if (course := last_quarter(log)) is None:
        return []
    return ["In the last quarter of training val success (best actions) went from {:.1f} to {:.1f} %.".format(*course)]


def last_quarter(log: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """Return val success before the last quarter and at the end.

    Both are in percent, with best actions, the mean over arms and seeds; None with too few measurements.

    Args:
      log: the rows of a run; those with a measurement on val count.
    """
    course: dict[int, list[float]] = {}
    for row in log:
        if "val_success" in row:
            course.setdefault(row["env_steps"], []).append(100.0 * row["val_success"])
    before = [steps for steps in course if steps <= 0.75 * max(course)]
    if not before:
        return None
    then, now = (float(np.mean(course[max(steps)])) for steps in (before, course))
    return then, now


def _missing_intervals(seeds: int, episodes: EpisodeList) -> list[str]:
    found = []
    if episodes.clusters().degrees < LEAST_SCENES:
        plans = len(set(episodes.plan))
        found.append(f"No intervals: {plans} floor plan{'s' * (plans > 1)}; an interval needs at least 3.")
    if seeds == 1:
        found.append("No interval for a single training seed: it says nothing of another training; train more seeds.")
    return found


def _no_better(rows: Sequence[Row], success: np.ndarray, episodes: EpisodeList, name: str) -> list[str]:
    """Name the policies that no interval over scenes tells from Random."""
    random = next((success[i] for i, row in enumerate(rows) if row.variant == "random"), None)
    if random is None:
        return []
    clusters, found = episodes.clusters(), []
    for row, values in zip(rows, success, strict=True):
        if row.variant not in ("baseline", "layout"):
            continue
        gain = paired_difference(random, values, clusters, trained=False)
        if not (gain.low if gain.bounded else gain.mean) > 0:
            found.append(f"{row.variant} ({row.decoding}) is no better than {name}.")
    return found
