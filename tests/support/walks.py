"""Random walks."""

import jax
import jax.numpy as jnp

from jaxnav.scenes.task import MOVE_AHEAD, NUM_ACTIONS


def draw_walk_actions(key: jax.Array, num_walks: int) -> jax.Array:
    """Random actions int32 [num_walks]; of ten, six are moves ahead, each turn and each look is one, none is Done."""
    random_action = jax.random.randint(key, (num_walks,), 0, 2 * (NUM_ACTIONS - 1))
    return jnp.where(random_action < NUM_ACTIONS - 1, random_action, MOVE_AHEAD)
