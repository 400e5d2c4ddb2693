"""What a run learns and makes before training."""

import dataclasses

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console

from jaxnav.env.objectnav import ObjectNav
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import CompiledWorld, read_ahead
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, calibrate, layout_priors
from jaxnav.training.exchange import learn_signs
from jaxnav.training.exploration import Exploration, explore
from jaxnav.training.learner import Learner
from jaxnav.training.trainer import ShardedTrainer, Trainer

_EXPLORE, _CALIBRATE, _EXCHANGE = 2**31 - 1, 2**31 - 2, 2**31 - 3  # purposes of keys; arms use 0, 1, ...


def explore_world(config: RunConfig, world: CompiledWorld) -> Exploration:
    """Walk the training scenes at random.

    The walks are divided among the banks.
    """
    key = jax.random.fold_in(jax.random.key(config.seed), _EXPLORE)
    walks = -(-config.layout.walks // len(world.banks))
    walk = jax.jit(explore, static_argnums=(0, 3, 4))
    explored = [
        walk(world.env, params, jax.random.fold_in(key, bank), walks, config.layout.steps)
        for bank, params in enumerate(read_ahead(world, range(len(world.banks))))
    ]
    whole = jax.tree.map(lambda *parts: sum(parts), *explored)
    if config.layout.prior == "room":
        return whole
    return whole._replace(counts=jax.numpy.broadcast_to(whole.counts.sum(axis=0), whole.counts.shape))


def calibrate_setting(config: RunConfig, world: CompiledWorld, explored: Exploration, console: Console) -> Setting:
    """Return the estimator's setting, complete.

    What the config leaves open is chosen in the training scenes (of the first bank).
    """
    setting, layout = SETTINGS[config.layout.setting], config.layout
    if setting.strength is None:
        return setting  # rows keep the sums of the counts
    key = jax.random.fold_in(jax.random.key(config.seed), _CALIBRATE)
    strengths = STRENGTHS if layout.strength is None else (layout.strength,)
    reductions = REDUCTIONS if layout.reduction is None else (layout.reduction,)
    chosen = calibrate(world.env, world.params(0), explored.counts, setting, key, strengths, reductions)
    console.print(
        f"layout estimator: prior rows of {chosen.setting.strength:g}, reduction {chosen.setting.reduction}; "
        f"gap {chosen.early:.2f} in the first views, {chosen.late:.2f} after twenty steps"
    )
    return chosen.setting


def learn_knowledge(config: RunConfig, world: CompiledWorld, explored: Exploration, setting: Setting) -> Knowledge:
    """Learn what is known before training.

    That is the layout priors, what the method learns and, where policies use the layout, what sightings tell of it
    (in the training scenes of the first bank).
    """
    learn, layout = find_method(config.method).learn, layout_priors(explored.counts, setting)
    method = {} if learn is None else jax.tree.map(jax.numpy.asarray, learn(world.banks, np.asarray(explored.counts)))
    if "layout" not in config.arms:
        return Knowledge(layout, method)
    key = jax.random.fold_in(jax.random.key(config.seed), _EXCHANGE)
    walks, pooled = 4 * config.layout.walks, config.layout.prior == "pooled"
    signs = jax.jit(learn_signs, static_argnums=(0, 4, 5))(
        world.env, world.params(0), explored.counts, key, walks, pooled
    )
    return Knowledge(layout, method, signs)


def say_what_is_cut(config: RunConfig, console: Console) -> None:
    """Say so if no rollout holds a whole choice."""
    interval, rollout = find_method(config.method).control.interval, config.ppo.rollout
    if rollout < interval:
        console.print(
            f"{config.method} chooses every {interval} actions: in rollouts of {rollout} it learns little of what a "
            f"choice leads to; give --ppo.rollout {2 * interval} or more, and fewer --ppo.num-envs"
        )


def make_trainer(
    config: RunConfig, env: ObjectNav, setting: Setting, knowledge: Knowledge, mesh: Mesh | None = None
) -> Trainer:
    """Make the trainer of a run's arms and seeds.

    Args:
      config: the run's settings.
      env: the environment.
      setting: of the layout estimator; training has no use for its gap, which is left out.
      knowledge: what was learned before training.
      mesh: of devices; None for one device.
    """
    spec, env = config.policy_spec(len(env.categories)), dataclasses.replace(env, near_starts=config.near_starts)
    settings = {"baseline": None, "layout": dataclasses.replace(setting, gap="none")}
    learners = {
        name: Learner(Acting(env, spec, settings[name]), config.ppo, config.counterfactual) for name in config.arms
    }
    stages, key = list(zip(config.stages, config.scalars, strict=True)), jax.random.key(config.seed)
    arguments = learners, stages, knowledge, key, config.seeds, config.chunk
    return Trainer(*arguments) if mesh is None else ShardedTrainer(*arguments, mesh=mesh)
