# pyright: reportMissingImports=false
"""The environment for gymnax 1.0 and what trains on it: observations are one array, spaces are gymnax's.

`env, params = jaxnav.env.gymnax.make("rooms")`. Reset, step and same-step auto-reset are those of `ObjectNav`.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces

from jaxnav.env import make as named
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE, VIEW_BLOCKED, VIEW_FREE

#: Farther than any detection, in metres, and more than any confidence and apparent size.
BOUND = 6.0


class FlatObjectNav(ObjectNav):
    """Observe one array, float32 [5 K + 2 V V].

    First confidence, metres ahead, metres to the right and apparent size of each category, zeros where it is not
    detected; then the goal, 1 at its category; then the cells of the view that are free, and those that are blocked.
    """

    def observation_space(self, params: EnvParams) -> Any:
        """Return the box of observations, as gymnax has it."""
        size = 5 * len(self.categories) + 2 * self.row_format.view**2
        return spaces.Box(-BOUND, BOUND, (size,), jnp.float32)

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Return the actions, as gymnax has them."""
        return spaces.Discrete(self.num_actions)

    def observe(self, state: State, params: EnvParams) -> Any:
        """Return what the agent perceives, float32 [5 K + 2 V V]."""
        seen = super().observe(state, params)
        detections = self.row_format.detections(seen.row)
        origin, scale = np.array([[0, 0, 128, 0]]), np.array([[255.0, AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE]])
        values = (detections.astype(jnp.float32) - origin.astype(np.float32)) / scale.astype(np.float32)
        values = jnp.where(detections[:, :1] > 0, values, 0.0)
        goal = jax.nn.one_hot(seen.goal, len(self.categories))
        cells = self.row_format.view_cells(seen.row)
        floor = [(cells == kind).astype(jnp.float32) for kind in (VIEW_FREE, VIEW_BLOCKED)]
        return jnp.concatenate([values.ravel(), goal, *floor])


def make(world: str = "rooms", **options: Any) -> tuple[FlatObjectNav, EnvParams]:
    """Make an environment for gymnax, and its parameters.

    The options are those of `jaxnav.make`.

    Raises:
      InputError: see `jaxnav.make`.
    """
    env, params = named.make(world, **options)
    return FlatObjectNav(**{field.name: getattr(env, field.name) for field in dataclasses.fields(env)}), params
