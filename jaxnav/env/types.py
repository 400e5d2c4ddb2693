"""Parameters, state and observation of one episode."""

from typing import Any

import jax
from flax import struct


class Tables(struct.PyTreeNode):
    """Hold a bank of scenes on the device.

    See `jaxnav.scenes.tables.compile.Bank` for the shapes. `success`, uint8 [P, ceil(K / 8)], holds a bit per pose and
    goal: whether Done succeeds there. `expert` is `Bank.expert`, None where nobody imitates it. Both stand apart from
    the rows, so that no observation holds them.
    """

    ahead: jax.Array
    rows: jax.Array
    success: jax.Array
    goal_distance: jax.Array
    first_cell: jax.Array
    num_cells: jax.Array
    goals: jax.Array
    num_goals: jax.Array
    expert: jax.Array | None = None


class EnvParams(struct.PyTreeNode):
    """Hold what may differ between runs of one compiled environment.

    Attributes:
      tables: the bank.
      room: int32 [S], index of each scene's room type (it picks the layout prior).
      step_limit: int32 [S], actions after which an episode of a scene is truncated.
      success_reward: float32 [], reward of Done where it succeeds.
      step_reward: float32 [], reward of every other action.
    """

    tables: Tables
    room: jax.Array
    step_limit: jax.Array
    success_reward: jax.Array
    step_reward: jax.Array


class State(struct.PyTreeNode):
    """Hold the state of one episode.

    Attributes:
      pose: int32 [], global pose index.
      scene: int32 [], scene index.
      goal: int32 [], category that is sought.
      time: int32 [], actions taken so far.
      nearest: float32 [], metres to the goal where the episode came nearest to it; None where nothing is shaped.
    """

    pose: jax.Array
    scene: jax.Array
    goal: jax.Array
    time: jax.Array
    nearest: jax.Array | None = None


class Observation(struct.PyTreeNode):
    """Hold what the agent perceives.

    Attributes:
      row: uint8 [R], the packed row of the pose (see `jaxnav.scenes.tables.observation_row.RowFormat`).
      goal: int32 [], category that is sought.
    """

    row: jax.Array
    goal: jax.Array


#: reset and step return nested pytrees; `info` holds the last observation of the episode, its success and its length.
StepResult = tuple[Observation, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]
