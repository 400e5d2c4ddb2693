"""Validation: how policies do on fixed episodes while they are trained."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.env.types import EnvParams
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import Evaluator, Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.variants import Row, inference_grid
from jaxnav.policies.acting import Acting
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.policy import Params
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import CompiledWorld, evaluation_world

#: Of the episodes; no seed that `evaluate` takes, so these are others.
_SEED = 2**32
#: The measure by which policies are chosen.
SCORE = "val_success"
#: Numbers of actions at which success is counted.
_BUDGETS = (5, 10, 15, 20, 30, 40, 50, 75, 100, 150, 200, 300, 400, 500)

DECODINGS: tuple[Decoding, ...] = ("argmax", "sample")
Split = Literal["val", "train"]
SPLITS: tuple[Split, ...] = ("val", "train")
#: Parameters of every seed, by arm.
Policies = Mapping[str, Sequence[Params]]
#: What is logged of every seed, by arm.
Scores = dict[str, list[dict[str, float]]]


class _Part(NamedTuple):
    episodes: EpisodeList
    params: EnvParams


class Validator:
    """Measure policies on fixed episodes.

    The episodes are as long as those of `evaluate`, but others. They take place in val scenes, and once, at the end, in
    training scenes too: what is lost from these to those is overfitting, what is lost in both is not learned.
    """

    def __init__(
        self, config: RunConfig, acting: Acting, knowledge: Knowledge, training: CompiledWorld, console: Console
    ) -> None:
        """Prepare; nothing is compiled yet.

        Args:
          config: of the run; its val scenes are used (their first bank).
          acting: how the episodes are acted.
          knowledge: what was learned before training.
          training: the training scenes (their first bank is used).
          console: to tell of progress on.

        Raises:
          MissingSplitError: the file of scenes has none of val.
          InputError: the method cannot act in them.
        """
        new = evaluation_world(config, "val", None, None, console)
        new.check(config.method, knowledge)
        # Of equal sizes, so that one compilation serves both.
        sizes = {name: max(getattr(new, name), getattr(training, name)) for name in ("num_cells", "num_scenes")}
        limits = {"step_limits": new.step_limits, "step_limit": new.step_limit}
        worlds: dict[Split, CompiledWorld] = {"val": new, "train": training}
        self._parts: dict[Split, _Part] = {
            split: _Part(
                episode_list(world.banks[0], config.val_episodes, _SEED),
                dataclasses.replace(world, **sizes, **limits, expert=False).params(0),
            )
            for split, world in worlds.items()
        }
        self._evaluators = {
            adapts: Evaluator(dataclasses.replace(acting, env=new.env, inner_steps=inner_steps), removes=False)
            for adapts, inner_steps in ((True, None), (False, 0))
        }
        self._knowledge = jax.device_get(knowledge)
        self._grids = {
            arm: inference_grid([Row(arm, None, None, decoding) for decoding in DECODINGS], (arm,), 1)
            for arm in config.arms
        }

    def measure(self, policies: Policies, adapts: bool = True) -> Scores:
        """Measure policies in val scenes.

        Args:
          policies: of every arm and seed.
          adapts: whether the method's adaptation changes them.

        Returns:
          `val_success`, `val_spl`, `val_timeout` and `val_wrong_done` with the best actions, the same with
          `_sampled` ones; fractions.
        """
        best_length = self._parts["val"].episodes.best_length
        scores: Scores = {arm: [] for arm in policies}
        for (arm, _), outcome in self._run(policies, "val", adapts).items():
            metrics = episode_metrics(outcome, best_length)
            named = {"val_success": "sr", "val_spl": "spl", "val_timeout": "timeout", "val_wrong_done": "wrong_done"}
            best, sampled = ({name: float(metrics[of][i].mean()) for name, of in named.items()} for i in range(2))
            scores[arm].append(best | {f"{name}_sampled": value for name, value in sampled.items()})
        return scores

    def reach(self, policies: Policies) -> dict[str, Any]:
        """Return success within budgets of actions, as JSON.

        By split, arm and decoding: a fraction for each budget, the mean over seeds.
        """
        longest = max(int(part.params.step_limit.max()) for part in self._parts.values())
        budgets = [budget for budget in _BUDGETS if budget < longest] + [longest]
        found: dict[str, Any] = {"budgets": budgets}
        for split in SPLITS:
            runs = self._run(policies, split, adapts=True)
            for arm in policies:
                outcomes = [outcome for (name, _), outcome in runs.items() if name == arm]
                for i, decoding in enumerate(DECODINGS):
                    curve = np.mean([_within(outcome, i, budgets) for outcome in outcomes], axis=0)
                    found.setdefault(split, {}).setdefault(arm, {})[decoding] = [round(x, 4) for x in curve.tolist()]
        return found

    def _run(self, policies: Policies, split: Split, adapts: bool) -> dict[tuple[str, int], Outcome]:
        """Run every policy, side by side, with best and sampled actions; leaves [2, E]."""
        part, evaluator = self._parts[split], self._evaluators[adapts]

        def run(task: tuple[str, int]) -> Outcome:
            arm, seed = task
            weights = jax.tree.map(lambda leaf: np.asarray(leaf)[None], policies[arm][seed])
            return evaluator(self._grids[arm], weights, [part], self._knowledge, jax.random.key(0))

        tasks = [(arm, seed) for arm, seeds in policies.items() for seed in range(len(seeds))]
        if not evaluator.compilations:
            run(tasks[0])  # compiles, once for all
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return dict(zip(tasks, pool.map(run, tasks), strict=True))


def _within(outcome: Outcome, decoding: int, budgets: Sequence[int]) -> list[float]:
    """Return the share of episodes that succeed within each budget."""
    success, length = np.asarray(outcome.success)[decoding], np.asarray(outcome.length)[decoding]
    return [float((success & (length <= budget)).mean()) for budget in budgets]
