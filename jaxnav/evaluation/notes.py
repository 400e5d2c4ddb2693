"""Notes printed below an evaluation table: limits of the results that the numbers do not show.

`evaluation_notes` covers intervals, privileged rows and rows no better than chance; `budget_note` and
`convergence_note` describe the training of the evaluated run.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import MIN_SCENE_DEGREES, Interval, paired_difference
from jaxnav.evaluation.variants import EvaluationRow

#: Share of other categories within Z, in percent, below which a row draws no verdict about w or sTDE.
MIN_OTHER_CATEGORIES_SHARE = 5.0


def evaluation_notes(
    rows: Sequence[EvaluationRow],
    success: np.ndarray,
    episodes: EpisodeList,
    *,
    has_room_prior: bool,
    has_experience: bool = True,
    is_run: bool = True,
    random_name: str = "Random",
) -> list[str]:
    """Describe the limits of a table, one sentence per note.

    Args:
      rows: R rows.
      success: float64 [R, S, E].
      episodes: the E episodes.
      has_room_prior: True if room types have different layout priors.
      has_experience: False if the method's experience Z is empty, so that w has nothing to multiply.
      is_run: False for a single policy, whose intervals are over scenes alone.
      random_name: name of the agent that acts at random.
    """
    # Intervals first, then what a row knows in advance, then comparisons with chance.
    notes = missing_interval_notes(episodes)
    if is_run and success.shape[1] == 1:
        # A single seed gives no spread between training runs.
        notes.append(
            "No intervals for trained policies: a single training seed does not show how training runs differ; train "
            "with `--seeds 2` or more."
        )
    if has_room_prior and any(row.arm == "layout" for row in rows):
        notes.append(
            "Rows with w receive the room type of the scene, because each room type has its own layout prior; "
            "other rows do not receive the room type."
        )
    if not has_experience and any(row.arm == "layout" for row in rows):
        notes.append(
            "A/A row: the method's Z is empty, so w has nothing to act on. The difference between a row with w and one "
            "without w shows the noise between trainings."
        )
    return notes + _chance_notes(rows, success, episodes, random_name)


def decision_share_notes(decision_shares: Sequence[Mapping[str, Any]]) -> list[str]:
    """Name the rows whose decisions hardly depend on other categories within Z.

    Args:
      decision_shares: entries of the report with the shares and costs of parts of the decisions.
    """
    share_notes = []
    for entry in decision_shares:
        share = entry["share"]["mean"]
        if entry["part"] != "other_categories" or share is None:
            continue

        # A share without a cost is noise. Without an interval, the share alone decides.
        cost_text = ""
        has_no_cost = False
        if entry["cost"] is not None and entry["cost"]["spl"]["ci95"] is not None:
            cost = Interval.from_json(entry["cost"]["spl"])
            has_no_cost = cost.low <= 0.0 <= cost.high
            cost_text = f" and replacing them costs {cost:.1f} SPL"

        # Few decisions cannot show an effect of w or sTDE; many may do so in more episodes.
        is_idle = share < MIN_OTHER_CATEGORIES_SHARE
        if is_idle or has_no_cost:
            conclusion = (
                "so this row tests neither w nor sTDE"
                if is_idle
                else "an interval that contains 0: only more episodes can tell whether w or sTDE matter in this row"
            )
            share_notes.append(
                f"{entry['variant']} ({entry['decoding']}): {share:.1f} % of the decisions depend on other categories "
                f"within Z{cost_text}, {conclusion}."
            )
    return share_notes


def budget_note(budget: Mapping[str, int]) -> str:
    """Describe the environment steps behind a policy.

    Args:
      budget: steps of `exploration`, and of `imitation` and `learning` or, where a policy was fitted, of `searches`.
    """
    if "searches" in budget:
        return (
            f"Environment steps of each policy: {budget['exploration']:,} of random exploration for the layout priors, "
            f"{budget['searches']:,} of searches to which it was fitted."
        )
    return (
        f"Environment steps of each policy: {budget['exploration']:,} of random exploration for the layout priors, "
        f"{budget['imitation']:,} of imitation learning, {budget['learning']:,} of reinforcement learning."
    )


def convergence_note(log: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe how much success on `val` still rose at the end of training.

    Args:
      log: rows of a run; see `last_quarter_success`.

    Returns:
      One note, or none with too few measurements.
    """
    quarter_success = last_quarter_success(log)
    if quarter_success is None:
        return []
    start, end = quarter_success
    # Validation uses the val scenes of the run and the layout shift of training, whatever the table is about.
    return [
        "In the last quarter of training, success in val scenes with the layout of training (best actions) went from "
        f"{start:.1f} to {end:.1f} %."
    ]


def last_quarter_success(log: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """Compute success on `val` before the last quarter of training and at its end.

    Args:
      log: rows of a run; rows without a measurement on `val` are ignored.

    Returns:
      Both in percent, with best actions, averaged over arms and seeds; None with too few measurements.
    """
    # A measurement for each arm and seed, in percent, by the environment steps before it.
    success_by_steps: dict[int, list[float]] = {}
    for log_row in log:
        if "val_success" in log_row:
            success_by_steps.setdefault(log_row["env_steps"], []).append(100.0 * log_row["val_success"])

    # The start is the last measurement that lies before the final quarter of the steps.
    last_steps = max(success_by_steps, default=0)
    early_steps = []
    for env_steps in success_by_steps:
        if env_steps <= 0.75 * last_steps:
            early_steps.append(env_steps)
    if not early_steps:
        return None

    start_success = float(np.mean(success_by_steps[max(early_steps)]))
    end_success = float(np.mean(success_by_steps[last_steps]))
    return start_success, end_success


def missing_interval_notes(episodes: EpisodeList) -> list[str]:
    """Explain why a table has no intervals over scenes, if so."""
    # Floor plans are the units of the interval over scenes.
    if episodes.clusters().degrees_of_freedom >= MIN_SCENE_DEGREES:
        return []
    num_plans = len(set(episodes.floor_plans))
    plural_ending = "s" if num_plans > 1 else ""
    return [f"No intervals: the episodes use {num_plans} floor plan{plural_ending}; an interval needs at least 3."]


def _chance_notes(
    rows: Sequence[EvaluationRow], success: np.ndarray, episodes: EpisodeList, random_name: str
) -> list[str]:
    """Name the policies whose interval over scenes does not exclude chance."""
    row_variants = [row.variant for row in rows]
    if "random" not in row_variants:
        return []

    # The row of the random agent is the reference of all comparisons.
    random_success = success[row_variants.index("random")]

    # These policies are compared in other scenes, so the spread between training runs does not count. Without an
    # interval, the mean decides.
    clusters = episodes.clusters()
    chance_notes = []
    for row, row_success in zip(rows, success, strict=True):
        if row.variant in ("baseline", "layout"):
            gain_over_chance = paired_difference(random_success, row_success, clusters, trained=False)
            lower_bound = gain_over_chance.low if gain_over_chance.has_bounds else gain_over_chance.mean
            if not lower_bound > 0:
                chance_notes.append(f"{row.variant} ({row.decoding}) is no better than {random_name}.")
    return chance_notes
