"""Random walks in the training scenes, of which the layout prior is made."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.env.objectnav import NUM_PRIORS, ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting, Agent
from jaxnav.scenes.task import DONE


class Exploration(NamedTuple):
    """Hold what random walks saw.

    Attributes:
      counts: float32 [rooms, K, K], poses at which two categories were detected together, by room type.
      steps: int32 [], steps taken.
      poses: int32 [], distinct poses seen.
    """

    counts: jax.Array
    steps: jax.Array
    poses: jax.Array


def explore(
    env: ObjectNav, params: EnvParams, key: jax.Array, num_walks: int = 2048, num_steps: int = 100
) -> Exploration:
    """Count what is detected together along random walks.

    Walks know no Done, and each pose counts once (paper, section 3.3, stage i).

    Args:
      env: the environment.
      params: of the training scenes.
      key: consumed.
      num_walks: parallel walks.
      num_steps: steps of each.
    """
    start_key, walk_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
    acting = Acting(env)
    agent = acting.start(start_key, num_walks, None, None, params)
    actions = jax.random.randint(walk_key, (num_steps, num_walks), 0, DONE)

    def step(carry: tuple[Agent, jax.Array], action: jax.Array) -> tuple[tuple[Agent, jax.Array], None]:
        agent, seen = carry
        agent, _ = acting.step(agent, action, None, params)
        return (agent, seen.at[agent.state.pose].set(True)), None

    seen = jnp.zeros(params.tables.rows.shape[0], bool).at[agent.state.pose].set(True)
    (_, seen), _ = jax.lax.scan(step, (agent, seen), actions)

    presence = (env.row_format.presence(params.tables.rows) & seen[:, None]).astype(jnp.float32)
    scene = jnp.repeat(
        jnp.arange(len(params.room)),
        params.tables.num_cells * env.task.rules.poses_per_cell,
        total_repeat_length=len(seen),
    )

    def together(room: jax.Array) -> jax.Array:
        return (presence * (params.room[scene] == room)[:, None].astype(jnp.float32)).T @ presence

    return Exploration(
        counts=jax.lax.map(together, jnp.arange(NUM_PRIORS)),  # one at a time, to be sparing with memory
        steps=jnp.int32(num_walks * num_steps),
        poses=seen.sum(dtype=jnp.int32),
    )
