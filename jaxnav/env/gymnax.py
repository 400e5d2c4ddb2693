# pyright: reportMissingImports=false
"""The environment for gymnax 1.0 and trainers built on it: flat observations and gymnax's own spaces.

    env, params = jaxnav.env.gymnax.make("rooms")

Reset, step and same-step auto-reset are those of `ObjectNav`.
"""

from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces

from jaxnav.env import make as env_make
from jaxnav.env.objectnav import EnvParams, ObjectNav, State, unpack_detections
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE

#: Bound of all entries of an observation: above every distance (metres), confidence and apparent size.
OBSERVATION_BOUND = 6.0


class FlatObjectNav(ObjectNav):
    """ObjectNav whose observations are one array, float32 [5 K + 2 V V].

    The array holds confidence, metres ahead, metres to the right and apparent size of each category (zeros where the
    category is not detected), the goal as a one-hot vector, a mask of the free cells of the view and one of the blocked
    cells.
    """

    def observation_space(self, params: EnvParams) -> Any:
        """Return the space of observations, a gymnax `Box`."""
        num_entries = 5 * len(self.categories) + 2 * self.row_format.view**2
        return spaces.Box(-OBSERVATION_BOUND, OBSERVATION_BOUND, (num_entries,), jnp.float32)

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Return the space of actions, a gymnax `Discrete`."""
        return spaces.Discrete(self.num_actions)

    def observe(self, state: State, params: EnvParams) -> Any:
        """Return the observation of a state, float32 [5 K + 2 V V]."""
        observation = super().observe(state, params)

        detection_values = unpack_detections(self.row_format.detections(observation.row))  # [K, 4]

        # Goal and floor cells as indicators.
        one_hot_goal = jax.nn.one_hot(observation.goal, len(self.categories))
        view_cells = self.row_format.view_cells(observation.row)  # [V V]
        free_mask = (view_cells == VIEW_FREE).astype(jnp.float32)
        blocked_mask = (view_cells == VIEW_BLOCKED).astype(jnp.float32)
        return jnp.concatenate([detection_values.ravel(), one_hot_goal, free_mask, blocked_mask])


def make(world: str = "rooms", **options: Any) -> tuple[FlatObjectNav, EnvParams]:
    """Make an environment with flat observations, and its parameters.

    Args:
      world: `rooms`, `apartments` or `houses`.
      **options: those of `jaxnav.make`.

    Raises:
      InputError: see `jaxnav.make`.
    """
    env, params = env_make.make(world, **options)
    # The subclass differs only in its observations, so it takes over every attribute.
    return FlatObjectNav(**vars(env)), params
