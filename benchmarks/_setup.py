"""Everything that a training run needs before its first update, and its programs compiled."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from _flops import matmul_flops
from jax.sharding import Mesh

from jaxnav.env.objectnav import NUM_PRIORS, EnvParams
from jaxnav.layout import ESTIMATORS, EstimatorConfig
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.method import Knowledge
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import explore_world, learn_knowledge, make_trainer
from jaxnav.runs.worlds import CompiledWorld, compile_training_world
from jaxnav.training.calibration import Exploration
from jaxnav.training.devices import Devices
from jaxnav.training.ppo import LearnerState, PPOScalars
from jaxnav.training.trainer import Trainer


class TrainingSetup(NamedTuple):
    """A run that is ready to train.

    Attributes:
      config: settings of the run.
      compiled_world: training scenes.
      params: of the environment, with the first bank of scenes.
      exploration: random walks that the layout priors are counted from.
      estimator_config: settings of the layout estimator.
      knowledge: learned before training.
      trainer: of the run's arms and seeds.
    """

    config: RunConfig
    compiled_world: CompiledWorld
    params: EnvParams
    exploration: Exploration
    estimator_config: EstimatorConfig
    knowledge: Knowledge
    trainer: Trainer

    def update_arguments(self, arm: str) -> tuple[LearnerState, PPOScalars, EnvParams, Knowledge]:
        """Arguments of a learner's update for a fresh seed."""
        learner = self.trainer.learners[arm]
        key = jax.random.key(self.config.seed)
        state = jax.jit(learner.init)(key, self.params, self.knowledge)
        return state, self.config.ppo.scalars(self.config.total_updates), self.params, self.knowledge


def accelerator_mesh(config: RunConfig) -> Mesh | None:
    """Return the mesh of `--devices 1` on an accelerator, where seeds train as one batch; None on a CPU."""
    if jax.default_backend() == "cpu":
        return None
    return Devices(count=1).mesh(config.seeds, config.ppo.num_envs, config.ppo.minibatches)


def set_up_training(config: RunConfig, mesh: Mesh | None = None, explore: bool = True) -> TrainingSetup:
    """Set up a run as `train.py` does, without calibration.

    Args:
      config: settings of the run.
      mesh: of devices; None for one device.
      explore: walk through the scenes for the layout priors; otherwise all pairs of categories are equally likely.
    """
    compiled_world = compile_training_world(config, PlainConsole(quiet=True))
    estimator_config = ESTIMATORS[config.layout.setting]

    # Without exploration all counts are zero.
    if explore:
        exploration = explore_world(config, compiled_world)
    else:
        num_categories = len(compiled_world.env.categories)
        counts = jnp.zeros((NUM_PRIORS, num_categories, num_categories))
        exploration = Exploration(counts, counts, jnp.int32(0), jnp.int32(0))

    # The trainer compiles each arm on its first update.
    knowledge = learn_knowledge(config, compiled_world, exploration, estimator_config)
    trainer = make_trainer(config, compiled_world.env, estimator_config, knowledge, mesh)
    env_params = compiled_world.make_env_params(0)
    return TrainingSetup(config, compiled_world, env_params, exploration, estimator_config, knowledge, trainer)


def make_training_call(trainer: Trainer, states: Any, params: EnvParams) -> Callable[[], None]:
    """Return a call that trains these states one more chunk."""

    def train() -> None:
        nonlocal states
        states, _ = trainer.train(states, params)

    return train


class Program(NamedTuple):
    """A compiled program with its arguments.

    Attributes:
      call: runs it once.
      flops: floating-point operations of its matrix products.
      compile_s: seconds to trace and to compile it.
      temp_gb: temporary memory besides arguments and results; None if the device does not report it.
    """

    call: Callable[[], Any]
    flops: int
    compile_s: float
    temp_gb: float | None


def compile_program(function: Callable[..., Any], *arguments: Any) -> Program:
    """Compile a function for these arguments."""
    start_time = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    compiled = traced.lower().compile()
    compile_s = round(time.perf_counter() - start_time, 2)

    memory = compiled.memory_analysis()
    temp_gb = round(memory.temp_size_in_bytes / 2**30, 3) if memory else None
    return Program(lambda: compiled(*arguments), matmul_flops(traced.jaxpr.jaxpr), compile_s, temp_gb)


def compile_update(setup: TrainingSetup, arm: str) -> Program:
    """Compile one update of a fresh seed: rollout and learning."""
    return compile_program(setup.trainer.learners[arm].update, *setup.update_arguments(arm))
