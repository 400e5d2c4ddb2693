"""From a packed observation row to numbers a network reads."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.scenes.tables.observation_row import (
    AHEAD_SCALE,
    RIGHT_SCALE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
)

NUM_FEATURES = 9  # per category, the goal flag included
CONFIDENCE = 1  # which of them is the detection's confidence, 0 to 1
_REACH = 5.0  # metres; scales the offsets to about 1


class Features(NamedTuple):
    """Hold what the networks see of an observation.

    Attributes:
      view: float32 [..., 2 V V], standable and not standable cells of the ego-centric view.
      visible: float32 [..., K], 1 where a category is detected.
      table: float32 [..., K, 9]: visible, confidence, ahead / 5 m, right / 5 m, distance / 5 m, sine and cosine of the
        bearing, apparent size, and whether it is the goal. Only the last is non-zero where nothing is detected.
      goal: float32 [..., K], one-hot.
    """

    view: jax.Array
    visible: jax.Array
    table: jax.Array
    goal: jax.Array


def features(row: jax.Array, goal: jax.Array, row_format: RowFormat) -> Features:
    """Unpack rows uint8 [..., R] and goals int [...]."""
    cells = row_format.view_cells(row)
    view = jnp.concatenate([cells == VIEW_FREE, cells == VIEW_BLOCKED], axis=-1).astype(jnp.float32)
    confidence, ahead, right, size = jnp.moveaxis(row_format.detections(row).astype(jnp.float32), -1, 0)
    visible = (confidence > 0).astype(jnp.float32)
    ahead = ahead / (AHEAD_SCALE * _REACH)
    right = (right - 128.0) / (RIGHT_SCALE * _REACH)
    distance = jnp.sqrt(ahead**2 + right**2)
    scale = 1.0 / jnp.maximum(distance, 0.01)
    one_hot = jax.nn.one_hot(goal, row_format.num_categories, dtype=jnp.float32)
    seen = jnp.stack(
        [visible, confidence / 255.0, ahead, right, distance, right * scale, ahead * scale, size / SIZE_SCALE], axis=-1
    )
    table = jnp.concatenate([seen * visible[..., None], one_hot[..., None]], axis=-1)
    return Features(view=view, visible=visible, table=table, goal=one_hot)
