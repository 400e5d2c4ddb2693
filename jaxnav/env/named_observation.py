"""Observations with names: what every agent may perceive, as a dictionary of arrays.

The Gymnasium environments return these observations, and `jaxnav.evaluate` gives them to functions and to objects with
`predict`.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, ObjectNav, State, unpack_detections


def name_observation(env: ObjectNav, params: EnvParams, state: State, moved: jax.Array) -> dict[str, jax.Array]:
    """Return the named observation of a state.

    Args:
      env: the environment, with K categories and a view of V x V cells.
      params: scenes, limits and rewards.
      state: state of one episode.
      moved: bool [], True where the last action changed the cell.

    Returns:
      `view` uint8 [V, V], `detections` float32 [K, 4], and int32 [] `goal`, `heading`, `horizon` and `moved`; see
      `jaxnav.env.gym.observation_space`.
    """
    row = env.observe(state, params).row
    _, heading, horizon = env.task.rules.split_pose(state.pose)

    # The view is square, [V V] -> [V, V].
    view_side = env.row_format.view
    return {
        "view": env.row_format.view_cells(row).reshape(view_side, view_side),
        "detections": unpack_detections(env.row_format.detections(row)),
        "goal": state.goal,
        "heading": heading,
        "horizon": horizon,
        "moved": moved.astype(jnp.int32),
    }


def to_numpy(observations: dict[str, jax.Array]) -> dict[str, np.ndarray]:
    """Copy named observations to NumPy arrays in the dtypes of their Gymnasium space, where integers are int64."""
    arrays = {}
    for name, batch_values in observations.items():
        space_dtype = np.int64 if batch_values.dtype == np.int32 else batch_values.dtype
        arrays[name] = np.array(batch_values, space_dtype)
    return arrays
