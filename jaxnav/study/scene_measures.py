"""Measures of difficulty, layout and baseline, scene by scene."""

from typing import NamedTuple

import numpy as np

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import frontier_outcome
from jaxnav.env.objectnav import prior_index
from jaxnav.evaluation.episodes import EpisodeList, together
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, scene_counts
from jaxnav.evaluation.variants import table_row
from jaxnav.runs.evaluate import run_rows
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.compile import Bank
from jaxnav.study.dial import Totals
from jaxnav.study.instrument_report import Measure


class BankMeasures(NamedTuple):
    """Hold what is measured in one bank without policies.

    Attributes:
      best_length, random_success: float64 [N], means over all episodes that could be drawn in a scene.
      success, actions: bool and int [E], of the frontier search.
      gap, similarity: float64 [N], of layout and prior; NaN where a scene shows no two categories together.
    """

    best_length: np.ndarray
    random_success: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    gap: np.ndarray
    similarity: np.ndarray


def measure_scenes(world: CompiledWorld, policies: Policies, num_episodes: int, seed: int) -> Totals:
    """Measure the scenes of a world at one shift.

    L* and Random are means over all episodes that could be drawn in a scene, not over the drawn ones: without noise.

    Args:
      world: the scenes.
      policies: with the baseline among their arms.
      num_episodes: in all scenes together.
      seed: of the episode lists and the sampled actions.
    """
    rows = [table_row("baseline", None, None, decoding) for decoding in ("argmax", "sample")]
    lists, outcome, _ = run_rows(rows, policies, world, num_episodes, seed)
    episodes = together(lists)
    num_scenes = len(episodes.scenes)

    def by_scene(values: np.ndarray) -> np.ndarray:
        """Return values [S, E] summed by scene, [S, N]."""
        return np.stack([np.bincount(episodes.scene, row, num_scenes) for row in values])

    argmax, sample = 100.0 * np.asarray(outcome.success, np.float64)
    priors = np.asarray(policies.knowledge.layout, np.float64)
    banks = [_measure_bank(bank, part, world, priors) for bank, part in zip(world.banks, lists, strict=True)]
    scenes = BankMeasures(*map(np.concatenate, zip(*banks, strict=True)))
    count = np.bincount(episodes.scene, minlength=num_scenes).astype(np.float64)
    shown = (~np.isnan(scenes.gap)).astype(np.float64)  # scenes that show two categories together
    values: dict[Measure, np.ndarray] = {
        "best_length": count * scenes.best_length[None],
        "random_sr": count * 100.0 * scenes.random_success[None],
        "frontier_sr": by_scene(100.0 * scenes.success[None]),
        "frontier_steps": by_scene(scenes.actions[None].astype(np.float64)),
        "layout_gap": np.nan_to_num(scenes.gap)[None],
        "layout_similarity": np.nan_to_num(scenes.similarity)[None],
        "baseline_argmax_sr": by_scene(argmax),
        "baseline_sample_sr": by_scene(sample),
    }
    weights: dict[Measure, np.ndarray] = {name: shown if name.startswith("layout") else count for name in values}
    return Totals(values, weights, tuple(room for bank in world.banks for room in bank.room_types), episodes.scenes)


def _measure_bank(bank: Bank, episodes: EpisodeList, world: CompiledWorld, priors: np.ndarray) -> BankMeasures:
    limits = np.array([world.step_limits.get(room, world.step_limit) for room in bank.room_types])
    searched, counts = frontier_outcome(bank, episodes, limits), scene_counts(bank)
    prior = priors[[prior_index(room) for room in bank.room_types]]
    return BankMeasures(
        best_length=expected_length(bank),
        random_success=random_success(bank, limits),
        success=np.asarray(searched.success),
        actions=np.asarray(searched.length),
        gap=layout_gap(counts, prior),
        similarity=layout_similarity(counts, prior),
    )
