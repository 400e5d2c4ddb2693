"""Measures of difficulty, layout and baseline, scene by scene."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import frontier_outcome
from jaxnav.env.objectnav import prior_index
from jaxnav.evaluation.episodes import EpisodeList, together
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, scene_counts
from jaxnav.evaluation.variants import table_row
from jaxnav.runs.evaluate import run_rows
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import Bank
from jaxnav.study.detection import measure_detection
from jaxnav.study.dial import Totals
from jaxnav.study.instrument_report import Measure


class BankMeasures(NamedTuple):
    """Hold what is measured in one bank without policies.

    Attributes:
      best_length, random_success: float64 [N], means over all episodes that could be drawn in a scene.
      success, actions: bool and int [E], of the frontier search.
      gap, similarity: float64 [N], of layout and prior; NaN where a scene shows no two categories together.
      detected, succeeds, distance: float64 [N, K], see `Detection`.
    """

    best_length: np.ndarray
    random_success: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    gap: np.ndarray
    similarity: np.ndarray
    detected: np.ndarray
    succeeds: np.ndarray
    distance: np.ndarray


def measure_scenes(
    world: CompiledWorld, policies: Policies, without: Policies | None, num_episodes: int, seed: int
) -> Totals:
    """Measure the scenes of a world at one shift.

    L* and Random are means over all episodes that could be drawn in a scene, not over the drawn ones: without noise.

    Args:
      world: the scenes.
      policies: with the baseline among their arms.
      without: the same of agents that cannot know any layout, with as many seeds.
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
    scenes_in_order = (world.scenes[i] for i in range(len(world.scenes)))
    banks = [
        _measure_bank(bank, part, world, priors, scenes_in_order) for bank, part in zip(world.banks, lists, strict=True)
    ]
    scenes = BankMeasures(*map(np.concatenate, zip(*banks, strict=True)))
    count = np.bincount(episodes.scene, minlength=num_scenes).astype(np.float64)
    shown = (~np.isnan(scenes.gap)).astype(np.float64)  # scenes that show two categories together
    values: dict[Measure, np.ndarray] = {
        "best_length": count * scenes.best_length[None],
        "random_sr": count * 100.0 * scenes.random_success[None],
        "frontier_sr": by_scene(100.0 * scenes.success[None]),
        "frontier_steps": by_scene(scenes.actions[None].astype(np.float64)),
        "start_distance": count * np.nanmean(scenes.distance, axis=1)[None],
        "goal_detected": count * 100.0 * np.nanmean(scenes.detected, axis=1)[None],
        "done_succeeds": count * 100.0 * np.nanmean(scenes.succeeds, axis=1)[None],
        "layout_gap": np.nan_to_num(scenes.gap)[None],
        "layout_similarity": np.nan_to_num(scenes.similarity)[None],
        "baseline_argmax_sr": by_scene(argmax),
        "baseline_sample_sr": by_scene(sample),
    }
    if without is not None:
        outcome = run_rows(rows, without, world, num_episodes, seed)[1]
        metrics = episode_metrics(outcome, episodes.best_length)
        values["without_argmax_sr"], values["without_sample_sr"] = map(by_scene, 100.0 * metrics["sr"])
        values["without_argmax_wrong"], values["without_sample_wrong"] = map(by_scene, 100.0 * metrics["wrong_done"])
    categories: dict[Measure, np.ndarray] = {
        "goal_detected": 100.0 * scenes.detected,
        "done_succeeds": 100.0 * scenes.succeeds,
    }
    weights: dict[Measure, np.ndarray] = {name: shown if name.startswith("layout") else count for name in values}
    room_types = tuple(room for bank in world.banks for room in bank.room_types)
    return Totals(values, weights, categories, room_types, episodes.scenes)


def _measure_bank(
    bank: Bank, episodes: EpisodeList, world: CompiledWorld, priors: np.ndarray, scenes: Iterator[Scene]
) -> BankMeasures:
    limits = world.limits(bank)
    searched, counts = frontier_outcome(bank, episodes, limits), scene_counts(bank)
    prior = priors[[prior_index(room) for room in bank.room_types]]
    return BankMeasures(
        best_length=expected_length(bank),
        random_success=random_success(bank, limits),
        success=np.asarray(searched.success),
        actions=np.asarray(searched.length),
        gap=layout_gap(counts, prior),
        similarity=layout_similarity(counts, prior),
        **measure_detection(bank, scenes)._asdict(),
    )
