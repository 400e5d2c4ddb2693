"""Validation: success of the policies in fixed episodes while they are trained.

`Validator.measure` scores the policies between chunks of training, and the best policy of each seed is exported.
`Validator.success_by_budget` measures the exported policies once, in val scenes and in training scenes.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jaxnav.choices import DECODINGS
from jaxnav.env.objectnav import EnvParams
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, episode_metrics
from jaxnav.evaluation.variants import EvaluationRow, inference_grid
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world

#: Seed of the episodes. `evaluate` takes only smaller seeds, so its episodes differ.
_EPISODE_SEED = 2**32
#: Metric by which the best policy of a seed is selected.
SCORE_METRIC = "val_success"
#: Columns of the training log, and the episode metrics behind them.
_LOGGED_METRICS = {"val_success": "sr", "val_spl": "spl", "val_timeout": "timeout", "val_wrong_done": "wrong_done"}
#: Numbers of actions within which success is counted.
_ACTION_BUDGETS = (5, 10, 15, 20, 30, 40, 50, 75, 100, 150, 200, 300, 400, 500)

ValidationSplit = Literal["val", "train"]
VALIDATION_SPLITS: tuple[ValidationSplit, ...] = ("val", "train")
#: Parameters of every seed, by arm.
ParamsByArm = Mapping[str, Sequence[Params]]
#: Scores of every seed, by arm.
ScoresByArm = dict[str, list[dict[str, float]]]


class _EpisodeSet(NamedTuple):
    episodes: EpisodeList
    params: EnvParams


class Validator:
    """Measures policies in fixed episodes.

    The episodes are as long as those of `evaluate`, but they are not the same episodes. Success that is lost from
    training scenes to val scenes is overfitting; success that is missing in both was never learned.
    """

    def __init__(
        self,
        config: RunConfig,
        agent_loop: AgentLoop,
        knowledge: Knowledge,
        training: CompiledWorld,
        console: PlainConsole,
    ) -> None:
        """Prepare the episodes; compilation happens at the first measurement.

        Args:
          config: configuration of the run, whose val scenes are used (their first bank).
          agent_loop: agent loop of the policies.
          knowledge: knowledge from before training.
          training: compiled training scenes (their first bank is used).
          console: console for progress.

        Raises:
          MissingSplitError: the scene file has no val scenes.
          InputError: the method cannot act in the val scenes.
        """
        val_world = compile_evaluation_world(config, "val", None, None, console)
        val_world.check_method(config.policy_method, knowledge)

        # Tables of equal sizes, so that one compilation serves both splits.
        shared_fields = {
            "num_cells": max(val_world.num_cells, training.num_cells),
            "num_scenes": max(val_world.num_scenes, training.num_scenes),
            "step_limits": val_world.step_limits,
            "step_limit": val_world.step_limit,
            "has_expert": False,
        }
        worlds: dict[ValidationSplit, CompiledWorld] = {"val": val_world, "train": training}
        self._episode_sets: dict[ValidationSplit, _EpisodeSet] = {}
        for split, world in worlds.items():
            episodes = draw_episodes(world.banks[0], config.val_episodes, _EPISODE_SEED)
            env_params = dataclasses.replace(world, **shared_fields).make_env_params(0)
            self._episode_sets[split] = _EpisodeSet(episodes, env_params)

        # Evaluators with the method's adaptation, and without it. They need no counterfactual decisions.
        self._evaluators = {}
        for adapts_online, inner_steps in ((True, None), (False, 0)):
            val_loop = dataclasses.replace(agent_loop, env=val_world.env, inner_steps=inner_steps)
            self._evaluators[adapts_online] = Evaluator(val_loop, can_remove=False)

        # Each arm is evaluated with best and with sampled actions.
        self._grids = {}
        for arm in config.arms:
            grid_rows = [EvaluationRow(arm, None, None, decoding) for decoding in DECODINGS]
            self._grids[arm] = inference_grid(grid_rows, (arm,), 1)
        self._knowledge = jax.device_get(knowledge)

    def measure(self, policies: ParamsByArm, adapts_online: bool = True) -> ScoresByArm:
        """Score policies in val scenes.

        Args:
          policies: parameters of every arm and seed.
          adapts_online: False switches the method's adaptation off.

        Returns:
          `val_success`, `val_spl`, `val_timeout` and `val_wrong_done` with best actions, and with sampled actions under
          names that end in `_sampled`; all are fractions.
        """
        # Row 0 of each outcome holds best actions, row 1 sampled ones; see `DECODINGS`.
        best_length = self._episode_sets["val"].episodes.best_length
        scores: ScoresByArm = {arm: [] for arm in policies}
        for (arm, _), outcome in self._run(policies, "val", adapts_online).items():
            outcome_metrics = episode_metrics(outcome, best_length)
            seed_scores = {}
            for decoding_index, suffix in enumerate(("", "_sampled")):
                for name, metric in _LOGGED_METRICS.items():
                    seed_scores[f"{name}{suffix}"] = float(outcome_metrics[metric][decoding_index].mean())
            scores[arm].append(seed_scores)
        return scores

    def success_by_budget(self, policies: ParamsByArm) -> dict[str, Any]:
        """Success within budgets of actions, as JSON.

        Args:
          policies: parameters of every arm and seed.

        Returns:
          `budgets`, and by split, arm and decoding the share of successful episodes within each budget, averaged over
          seeds. The last budget is the longest step limit.
        """
        # Budgets beyond the longest step limit would repeat it.
        longest_limit = max(int(episode_set.params.step_limit.max()) for episode_set in self._episode_sets.values())
        budgets = []
        for budget in _ACTION_BUDGETS:
            if budget < longest_limit:
                budgets.append(budget)
        budgets.append(longest_limit)

        success: dict[str, Any] = {"budgets": budgets}
        for split in VALIDATION_SPLITS:
            outcomes = self._run(policies, split, adapts_online=True)
            success[split] = {}
            for arm in policies:
                # Average the curves of the seeds.
                arm_outcomes = [outcomes[arm, seed] for seed in range(len(policies[arm]))]
                success[split][arm] = {}
                for row, decoding in enumerate(DECODINGS):
                    seed_curves = [_success_within(outcome, row, budgets) for outcome in arm_outcomes]
                    mean_curve = np.mean(seed_curves, axis=0)
                    success[split][arm][decoding] = [round(success_share, 4) for success_share in mean_curve.tolist()]
        return success

    def _run(
        self, policies: ParamsByArm, split: ValidationSplit, adapts_online: bool
    ) -> dict[tuple[str, int], EpisodeOutcome]:
        """Outcomes of every arm and seed, leaves [2, E] for best and sampled actions."""
        episode_set = self._episode_sets[split]
        evaluator = self._evaluators[adapts_online]

        def run_policy(task: tuple[str, int]) -> EpisodeOutcome:
            arm, seed = task
            # A single seed, [1, ...].
            params = jax.tree.map(lambda leaf: np.asarray(leaf)[None], policies[arm][seed])
            return evaluator(self._grids[arm], params, [episode_set], self._knowledge, jax.random.key(0))

        # The first policy compiles for all; then policies run side by side on the cores.
        arm_seeds = []
        for arm, seed_params in policies.items():
            for seed in range(len(seed_params)):
                arm_seeds.append((arm, seed))
        if not evaluator.compilations:
            run_policy(arm_seeds[0])
        with ThreadPoolExecutor(os.cpu_count()) as thread_pool:
            return dict(zip(arm_seeds, thread_pool.map(run_policy, arm_seeds), strict=True))


def _success_within(outcome: EpisodeOutcome, row: int, budgets: Sequence[int]) -> list[float]:
    """Share of episodes of one row that succeed within each budget of actions."""
    # Success and number of actions of each episode, [E].
    success = np.asarray(outcome.success)[row]
    length = np.asarray(outcome.length)[row]
    return [float((success & (length <= budget)).mean()) for budget in budgets]
