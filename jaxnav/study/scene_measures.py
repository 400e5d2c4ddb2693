"""Measures of difficulty, layout and baseline, scene by scene."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import frontier_outcome
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.evaluation.episodes import EpisodeList, episode_list, together
from jaxnav.evaluation.grid import evaluate_grid
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, scene_counts
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.runs.directory import Policies
from jaxnav.runs.worlds import CompiledWorld, read_ahead
from jaxnav.scenes.categories import ROOM_TYPES
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


def measure_scenes(world: CompiledWorld, policies: Policies, seeds: int, num_episodes: int, seed: int) -> Totals:
    """Measure the scenes of a world at one shift.

    L* and Random are means over all episodes that could be drawn in a scene, not over the drawn ones: without noise.

    Args:
      world: the scenes.
      policies: of both arms.
      seeds: number of training seeds, S.
      num_episodes: in all scenes together.
      seed: of the episode lists and the sampled actions.
    """
    each = -(-num_episodes // len(world.banks))
    lists = [episode_list(bank, each, seed, part) for part, bank in enumerate(world.banks)]
    episodes = together(lists)
    num_scenes = len(episodes.scenes)

    def by_scene(values: np.ndarray) -> np.ndarray:
        """Return values [S, E] summed by scene, [S, N]."""
        return np.stack([np.bincount(episodes.scene, row, num_scenes) for row in values])

    argmax, sample = _baseline_success(world, policies, seeds, lists, seed)
    priors = np.asarray(policies.priors, np.float64)
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


def _baseline_success(
    world: CompiledWorld, policies: Policies, seeds: int, lists: Sequence[EpisodeList], seed: int
) -> np.ndarray:
    """Return the baseline's success with best and with sampled actions.

    It is in percent, float64 [2, S, E].
    """
    outcome, _ = evaluate_grid(
        inference_grid([table_row("baseline", None, None, decoding) for decoding in ("argmax", "sample")], seeds),
        policies.params,
        zip(lists, read_ahead(world, range(len(world.banks))), strict=True),
        Acting(world.env, policies.setting),
        policies.spec,
        policies.priors,
        jax.random.key(seed),
    )
    return 100.0 * np.asarray(outcome.success, np.float64).reshape(2, seeds, -1)


def _measure_bank(bank: Bank, episodes: EpisodeList, world: CompiledWorld, priors: np.ndarray) -> BankMeasures:
    limits = np.array([world.step_limits.get(room, world.step_limit) for room in bank.room_types])
    searched, counts = frontier_outcome(bank, episodes, limits), scene_counts(bank)
    prior = priors[[ROOM_TYPES.index(room) if room in ROOM_TYPES else OTHER_ROOM for room in bank.room_types]]
    return BankMeasures(
        best_length=expected_length(bank),
        random_success=random_success(bank, limits),
        success=np.asarray(searched.success),
        actions=np.asarray(searched.length),
        gap=layout_gap(counts, prior),
        similarity=layout_similarity(counts, prior),
    )
