"""Decision shares of an evaluation: what is measured, on which episodes, and the entries of the report.

`list_cost_replacements` lists the replacements whose cost the evaluation measures, `count_shares` counts changed
decisions on a few episodes of the evaluation, and `build_decision_shares` makes the report's entries from both.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxnav.choices import Costs
from jaxnav.evaluation.decision_share import ShareCounts, ShareProbe, share_interval
from jaxnav.evaluation.episodes import MAX_EPISODES, EpisodeList, join_episode_lists, select_first_episodes
from jaxnav.evaluation.grid import EpisodeOutcome, episode_metrics, start_states
from jaxnav.evaluation.replacements import PARTNER_PARTS, WEIGHT_PARTS, ReplacedPart
from jaxnav.evaluation.statistics import Interval, paired_difference
from jaxnav.evaluation.variants import EvaluationRow, Replacement, inference_grid
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld

#: Number of episodes on which shares are counted; about 2,000 decisions of each row and seed.
PROBED_EPISODES = 64
#: Number of probes in an episode of maximal length if the stride between probes did not grow.
_PROBED_STEPS = 100
#: Fraction of the evaluation's episodes on which the cost of other categories is measured, unless all costs are.
_COST_EPISODE_FRACTION = 0.25


def replaced_parts(row: EvaluationRow) -> list[ReplacedPart]:
    """Parts of the decisions of a row; rows without layout weights have no w to replace."""
    parts = []
    for part in ReplacedPart:
        if part != ReplacedPart.NONE and (row.arm == "layout" or part not in WEIGHT_PARTS):
            parts.append(part)
    return parts


def rows_with_shares(rows: Sequence[EvaluationRow]) -> list[EvaluationRow]:
    """Rows that have decision shares: those of policies from which nothing is removed, with best actions."""
    return [row for row in rows if row.variant in ("baseline", "layout") and row.decoding == "argmax"]


def list_cost_replacements(rows: Sequence[EvaluationRow], costs: Costs) -> list[Replacement]:
    """List the replacements whose cost is measured."""
    replacements = []
    for row in rows_with_shares(rows):
        for part in replaced_parts(row):
            if costs == "all" or (costs == "categories" and part == ReplacedPart.OTHER_CATEGORIES):
                replacements.append(Replacement(row, part))
    return replacements


def limit_room_episodes(episode_lists: Sequence[EpisodeList], costs: Costs) -> int:
    """Largest number of episodes of each room type, in each bank, on which costs are measured."""
    if costs == "all":
        return MAX_EPISODES
    most_episodes = max(int(episodes.room_rank.max()) + 1 for episodes in episode_lists)
    return int(np.ceil(_COST_EPISODE_FRACTION * most_episodes))


def count_shares(
    rows: Sequence[EvaluationRow],
    policies: Policies,
    compiled_world: CompiledWorld,
    episode_lists: Sequence[EpisodeList],
    seed: int,
) -> tuple[ShareCounts, EpisodeList]:
    """Count changed decisions of R rows and S seeds on a few episodes of the evaluation.

    Args:
      rows: rows with decision shares, see `rows_with_shares`.
      policies: policies with S seeds of each arm.
      compiled_world: compiled scenes.
      episode_lists: the evaluation's episodes, for each bank.
      seed: seed of the sampled actions.

    Returns:
      Counts, leaves [R, S, E] and [R, S, E, P], with the P parts in the order of `ReplacedPart`; and the E episodes.
    """
    probe_stride = max(1, -(-compiled_world.step_limit // _PROBED_STEPS))  # rounded up
    parts = [part for part in ReplacedPart if part != ReplacedPart.NONE]
    probe = ShareProbe(policies.make_agent_loop(compiled_world), parts, probe_stride)
    grid = inference_grid(rows, policies.arms, policies.num_seeds)

    # Evenly spaced episodes of every bank.
    bank_counts = []
    probed_lists = []
    episodes_per_bank = -(-PROBED_EPISODES // len(episode_lists))
    for bank_index, episodes in enumerate(episode_lists):
        positions = np.linspace(0, len(episodes.goal) - 1, min(episodes_per_bank, len(episodes.goal)))
        probed_episodes = episodes.take(positions.astype(int))
        bank_key = jax.random.fold_in(jax.random.key(seed), bank_index)
        counts = probe(
            grid,
            policies.params,
            start_states(probed_episodes),
            compiled_world.make_env_params(bank_index),
            policies.knowledge,
            bank_key,
        )
        bank_counts.append(counts)
        probed_lists.append(probed_episodes)

    # The grid is flat: [R S, E, ...] becomes [R, S, E, ...].
    joined_counts = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *bank_counts)
    shape = (len(rows), policies.num_seeds)
    counts = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), joined_counts)
    return counts, join_episode_lists(probed_lists)


def build_decision_shares(
    rows: Sequence[EvaluationRow],
    counts: ShareCounts,
    probed_episodes: EpisodeList,
    replacement_costs: dict[Replacement, dict[str, Any]],
    *,
    trained: bool = True,
) -> list[dict[str, Any]]:
    """Build the entries of the report, one for each row and part.

    Args:
      rows: the R rows of the counts.
      counts, probed_episodes: result of `count_shares`.
      replacement_costs: costs as from `measure_costs`.
      trained: False for intervals over scenes alone, see `share_interval`.
    """
    scenes = probed_episodes.clusters()

    def share_of(counted: jax.Array, weighted_decisions: jax.Array) -> dict[str, Any]:
        """Share of a row's decisions, from numbers [S, E]."""
        return share_interval(np.asarray(counted), np.asarray(weighted_decisions), scenes, trained=trained).to_json()

    entries = []
    for row_index, row in enumerate(rows):
        weighted_decisions = counts.weighted_decisions[row_index]
        for part in replaced_parts(row):
            part_index = part - 1  # `NONE` is no part
            entry = {
                "variant": row.variant,
                "decoding": row.decoding,
                "part": part.name.lower(),
                "weighted_decisions": weighted_decisions.sum(axis=1).tolist(),
                "share": share_of(counts.changed[row_index, ..., part_index], weighted_decisions),
                "partner_difference": None,
                "cost": replacement_costs.get(Replacement(row, part)),
            }
            if part in PARTNER_PARTS:
                partner_differences = counts.partner_differences[row_index, ..., part_index]
                entry["partner_difference"] = share_of(partner_differences, weighted_decisions)
            if part == ReplacedPart.EXPERIENCE:
                entry["deleted"] = share_of(counts.deleted[row_index], weighted_decisions)
            entries.append(entry)
    return entries


def measure_costs(
    rows: Sequence[EvaluationRow],
    outcome: EpisodeOutcome,
    replacements: Sequence[Replacement],
    replaced_outcome: EpisodeOutcome,
    episode_lists: Sequence[EpisodeList],
    max_room_episodes: int,
    *,
    trained: bool = True,
) -> dict[Replacement, dict[str, Any]]:
    """Measure what each replacement costs: factual less replaced, in percentage points, on the same episodes.

    Args:
      rows: the R rows of `outcome`.
      outcome: outcomes without replacement, leaves [R, S, E].
      replacements: the P replacements; their rows are among `rows`.
      replaced_outcome: outcomes with replacement, leaves [P, S, E].
      episode_lists: the episodes of each bank, E in total.
      max_room_episodes: number of episodes of each room type that the replacements ran, see `limit_room_episodes`.
      trained: False for intervals over scenes alone, see `paired_difference`.

    Returns:
      By replacement, the number of `episodes`, and the intervals of `sr` and `spl`.
    """
    # Both sides on the episodes that the replacements ran.
    selections = [select_first_episodes(episodes.room_rank, max_room_episodes) for episodes in episode_lists]
    selection = np.concatenate(selections)
    episodes = join_episode_lists(episode_lists).take(selection)
    metrics = _metrics_of(outcome, selection, episodes)
    replaced_metrics = _metrics_of(replaced_outcome, selection, episodes)

    costs: dict[Replacement, dict[str, Any]] = {}
    for index, replacement in enumerate(replacements):
        row_index = list(rows).index(replacement.row)
        costs[replacement] = {"episodes": len(episodes.goal)}
        for metric in ("spl", "sr"):
            difference: Interval = paired_difference(
                100.0 * replaced_metrics[metric][index],
                100.0 * metrics[metric][row_index],
                episodes.clusters(),
                same_runs=True,
                trained=trained,
            )
            costs[replacement][metric] = difference.to_json()
    return costs


def _metrics_of(outcome: EpisodeOutcome, selection: np.ndarray, episodes: EpisodeList) -> dict[str, np.ndarray]:
    """Metrics of selected episodes; `selection` is bool [E], `episodes` the selected ones."""
    selected_outcome = jax.tree.map(lambda leaf: leaf[:, :, selection], outcome)
    return episode_metrics(selected_outcome, episodes.best_length)
