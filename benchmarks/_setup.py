"""What a training run needs before its first update."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from rich.console import Console

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.env.types import EnvParams
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.methods import Knowledge
from jaxnav.runs.config import RunConfig
from jaxnav.runs.prepare import explore_world, learn_knowledge, make_trainer
from jaxnav.runs.worlds import CompiledWorld, training_world
from jaxnav.training.config import PPOScalars
from jaxnav.training.exploration import Exploration
from jaxnav.training.learner import LearnerState
from jaxnav.training.trainer import Trainer


class Setup(NamedTuple):
    """Hold a run that is ready to train.

    Attributes:
      config: its settings.
      world: the training scenes.
      params: of the environment, with the first bank of scenes.
      explored: what the layout priors are made of.
      setting: of the layout estimator.
      knowledge: what was learned before training.
      trainer: of its arms and seeds.
    """

    config: RunConfig
    world: CompiledWorld
    params: EnvParams
    explored: Exploration
    setting: Setting
    knowledge: Knowledge
    trainer: Trainer

    def arguments(self, arm: str) -> tuple[LearnerState, PPOScalars, EnvParams, Knowledge]:
        """Return what a learner updates with, for a fresh seed."""
        learner, key = self.trainer.learners[arm], jax.random.key(self.config.seed)
        state = jax.jit(learner.init)(key, self.params, self.knowledge)
        return state, self.config.ppo.scalars(self.config.total_updates), self.params, self.knowledge


def set_up(config: RunConfig, mesh: Mesh | None = None, explore: bool = True) -> Setup:
    """Set a run up as `train.py` does, without calibration.

    Args:
      config: the run's settings.
      mesh: of devices; None for one device.
      explore: walk the scenes for the layout priors; otherwise all pairs of categories are equally likely.
    """
    world = training_world(config, Console(quiet=True))
    setting, size = SETTINGS[config.layout.setting], len(world.env.categories)
    if explore:
        explored = explore_world(config, world)
    else:
        explored = Exploration(jnp.zeros((NUM_PRIORS, size, size)), jnp.int32(0), jnp.int32(0))
    knowledge = learn_knowledge(config, world, explored, setting)
    trainer = make_trainer(config, world.env, setting, knowledge, mesh)
    return Setup(config, world, world.params(0), explored, setting, knowledge, trainer)
