"""From a compiled bank of scenes to an environment and its parameters."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav, prior_index
from jaxnav.env.types import EnvParams, Tables
from jaxnav.scenes.tables.compile import Bank


def build(
    bank: Bank,
    step_limits: dict[str, int],
    default_limit: int,
    num_cells: int = 0,
    num_scenes: int = 0,
    shaping: float = 0.0,
    expert: bool = False,
) -> tuple[ObjectNav, EnvParams]:
    """Build environment and parameters of a compiled bank.

    Args:
      bank: the scenes.
      step_limits: step limit by room type.
      default_limit: step limit of the other room types.
      num_cells, num_scenes: sizes to pad the tables to where the bank is smaller, so that banks of equal sizes share
        one compilation: with cells that no episode gets to, and with its own scenes again from the first.
      shaping: see `ObjectNav`.
      expert: whether somebody imitates shortest paths.
    """
    rooms = [prior_index(room) for room in bank.room_types]
    limits = [step_limits.get(room, default_limit) for room in bank.room_types]
    poses_per_cell = bank.task.rules.poses_per_cell
    more_cells = max(num_cells - len(bank.ahead), 0)
    scenes = np.arange(max(num_scenes, len(bank.names))) % len(bank.names)

    def padded(table: np.ndarray, per_cell: int = 1) -> jax.Array:
        if not more_cells:
            return jnp.asarray(table)
        whole = np.zeros((len(table) + per_cell * more_cells, *table.shape[1:]), table.dtype)
        whole[: len(table)] = table
        return jnp.asarray(whole)

    tables = Tables(
        ahead=padded(bank.ahead),
        rows=padded(bank.rows, poses_per_cell),
        success=padded(np.packbits(bank.best_length == 1, axis=1, bitorder="little"), poses_per_cell),
        goal_distance=padded(bank.goal_distance),
        expert=padded(bank.expert, poses_per_cell) if expert else None,
        **{
            name: jnp.asarray(getattr(bank, name)[scenes]) for name in ("first_cell", "num_cells", "goals", "num_goals")
        },
    )
    params = EnvParams(
        tables=tables,
        room=jnp.asarray(np.array(rooms, np.int32)[scenes]),
        step_limit=jnp.asarray(np.array(limits, np.int32)[scenes]),
        success_reward=jnp.float32(5.0),
        step_reward=jnp.float32(-0.01),
    )
    return ObjectNav(bank.task, shaping), params
