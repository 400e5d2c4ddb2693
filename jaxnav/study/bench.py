"""Evaluation of trials with the policies of a run."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import Evaluator, Outcome
from jaxnav.layout import Setting
from jaxnav.policies.acting import Acting
from jaxnav.runs.config import ARMS, RunConfig
from jaxnav.runs.policies import Gap, Policies, gap_settings, load_policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_world
from jaxnav.study.config import StudyConfig
from jaxnav.study.trials import Trial, trial_grid


class Subject(NamedTuple):
    """Hold the policies of a run and their episodes.

    Attributes:
      policies: of the run.
      world: its scenes at one shift.
      episodes: in these scenes.
    """

    policies: Policies
    world: CompiledWorld
    episodes: EpisodeList

    @property
    def parameters(self) -> int:
        """Return the number of parameters of each policy."""
        return sum(leaf[0].size for leaf in jax.tree.leaves(self.policies.params))


class Bench:
    """Evaluate trials in blocks, so that equal shapes compile once."""

    BLOCK = 2

    def __init__(self, config: StudyConfig) -> None:
        self.config = config
        self._evaluators: dict[Acting, Evaluator] = {}

    def subject(self, run: RunConfig, shift: float, console: Console) -> Subject:
        """Load a run and draw its episodes at a shift.

        Where a run has the layout arm alone, its policies stand in for the baseline's as well.

        Raises:
          InputError: the run is not finished, or its scenes fill more than one shard.
        """
        world = evaluation_world(run, self.config.split, None, shift, console)
        policies = load_policies(run, run.arms)
        if "baseline" not in run.arms:
            twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), policies.params)
            policies = policies._replace(params=twice, arms=ARMS)
        return Subject(policies, world, study_episodes(world, self.config))

    def outcomes(self, subject: Subject, gap: Gap, trials: Iterable[Trial]) -> dict[Trial, Outcome]:
        """Return the outcomes of each trial, leaves [S, E]."""
        trials = list(dict.fromkeys(trials))
        setting = gap_settings(layout_setting(subject.policies))[gap]
        return dict(zip(trials, self.run(subject, setting, trials), strict=True))

    def run(self, subject: Subject, setting: Setting | None, trials: Sequence[Trial]) -> list[Outcome]:
        """Run trials with a layout setting; outcomes are [S, E].

        Raises:
          InputError: the method cannot act in the scenes.
        """
        policies, world, episodes = subject
        acting, seeds = policies._replace(setting=setting).acting(world), policies.seeds
        evaluator = self._evaluators.setdefault(acting, Evaluator(acting))
        outcomes: list[Outcome] = []
        params = world.params(0)
        for first in range(0, len(trials), self.BLOCK):
            block = list(trials[first : first + self.BLOCK])
            filled = block + block[-1:] * (self.BLOCK - len(block))
            outcome = evaluator(
                trial_grid(filled, policies.arms, seeds),
                policies.params,
                [(episodes, params)],
                policies.knowledge,
                jax.random.key(self.config.seed),
            )
            outcomes += [
                jax.tree.map(lambda leaf, i=i: leaf[i * seeds : (i + 1) * seeds], outcome) for i in range(len(block))
            ]
        return outcomes


def study_episodes(world: CompiledWorld, config: StudyConfig) -> EpisodeList:
    """Draw the episodes of a study in one world.

    Raises:
      InputError: the scenes fill more than one shard.
    """
    if len(world.banks) > 1:
        raise InputError("study: takes as many scenes of a split as fit into one shard; give more --shard-scenes")
    return episode_list(world.banks[0], config.episodes, config.seed)


def layout_setting(policies: Policies) -> Setting:
    """Return the layout setting of policies.

    Raises:
      InputError: none of them uses the layout.
    """
    if policies.setting is None:
        raise InputError("study: needs policies with the layout; train a run with the arm `layout`")
    return policies.setting
