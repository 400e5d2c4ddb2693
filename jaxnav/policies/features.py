"""Network inputs: what a packed observation row holds, as numbers, and a perceptron shared by all categories.

`unpack_features` turns observation rows into `Features`, the input of every method. `CategoryMaps` applies one small
perceptron to the row of every category; the direct pathway and most methods embed their category tables with it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, add_bias, matmul_rows
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import (
    AHEAD_SCALE,
    RIGHT_ORIGIN,
    RIGHT_SCALE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
)

#: Number of features per category, the goal flag included.
NUM_FEATURES = 9
#: Column of `Features.table` with the confidence of the detection, 0 to 1.
CONFIDENCE_INDEX = 1

#: Size of an image in pixels: factor on the geometry of a detection in `scale_geometry`.
IMAGE_PIXELS = 300.0
#: Columns of `Features.table` with the geometry of a detection: offsets, distance, bearing (sine, cosine), size.
_GEOMETRY_COLUMNS = slice(2, 8)

_OFFSET_SCALE = 5.0  # metres; scales the offsets to about 1
_MIN_DISTANCE = 0.01  # of the scaled distance, against division by zero


class Features(NamedTuple):
    """Observation as the networks see it.

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


def unpack_features(row: jax.Array, goal: jax.Array, row_format: RowFormat) -> Features:
    """Unpack observation rows.

    Args:
      row: uint8 [..., R].
      goal: int [...], index of the category that is sought.
      row_format: format of the rows.

    Returns:
      The features, leaves [..., K, ...] and view [..., 2 V V].
    """
    # Cells of the view: two flags each, for nothing is known of the remaining ones.
    view_cells = row_format.view_cells(row)
    view = jnp.concatenate([view_cells == VIEW_FREE, view_cells == VIEW_BLOCKED], axis=-1).astype(jnp.float32)

    # Columns of the detections, [..., K] each, in units of about 1.
    detections = row_format.detections(row).astype(jnp.float32)
    confidence, ahead_byte, right_byte, size_byte = jnp.moveaxis(detections, -1, 0)
    visible = (confidence > 0).astype(jnp.float32)
    ahead = ahead_byte / (AHEAD_SCALE * _OFFSET_SCALE)
    right = (right_byte - RIGHT_ORIGIN) / (RIGHT_SCALE * _OFFSET_SCALE)
    distance = jnp.sqrt(ahead**2 + right**2)
    inverse_distance = 1.0 / jnp.maximum(distance, _MIN_DISTANCE)

    # The table [..., K, 9]: what is not detected has zeros in all columns but the goal flag.
    columns = [
        visible,
        confidence / 255.0,
        ahead,
        right,
        distance,
        right * inverse_distance,
        ahead * inverse_distance,
        size_byte / SIZE_SCALE,
    ]
    detected_columns = jnp.stack(columns, axis=-1) * visible[..., None]
    # The goal flag is known without a detection, so it is not masked.
    goal_one_hot = jax.nn.one_hot(goal, row_format.num_categories, dtype=jnp.float32)
    table = jnp.concatenate([detected_columns, goal_one_hot[..., None]], axis=-1)
    return Features(view=view, visible=visible, table=table, goal=goal_one_hot)


def scale_geometry(features: Features) -> Features:
    """Scale all six columns of geometry to the size of boxes in pixels: offsets, distance, bearing and apparent size.

    The released code multiplies the goal's column of w (eq. 7) into boxes in pixels, up to 300, so that weights of
    about 0.1 still leave large features. Confidence, visibility and the goal flag keep their scale.
    """
    return features._replace(table=features.table.at[..., _GEOMETRY_COLUMNS].multiply(IMAGE_PIXELS))


class CategoryMaps(nnx.Module):
    """Two-layer perceptron, applied to the row of every category.

    Rows [..., K, M] become maps [..., K m], category by category. A row may be [x A | y], where x A is a mixture of the
    appearances A [K, d] of the categories. The first layer is linear, so A can pass it once (`project_appearance`) and
    be mixed afterwards, which saves the product of every row with d rows of the kernel.

    Attributes:
      width: K m, size of the output.
    """

    def __init__(self, inputs: int, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.inner = Linear(inputs, spec.sizes.row_hidden, rngs=rngs)
        self.outer = Linear(spec.sizes.row_hidden, spec.sizes.row_outputs, rngs=rngs)
        self.width = spec.num_categories * spec.sizes.row_outputs

    @classmethod
    def for_detections(cls, spec: PolicySpec, rngs: nnx.Rngs) -> "CategoryMaps":
        """Build the perceptron for the rows of `project_detections`."""
        return cls(spec.sizes.appearance + NUM_FEATURES, spec, rngs)

    def project_appearance(self, appearance: jax.Array) -> jax.Array:
        """Pass appearances [K, d] through the first layer without its bias, [K, h]."""
        return appearance @ self.inner.kernel[...][: appearance.shape[-1]]

    def project_rows(self, rows: jax.Array) -> jax.Array:
        """Pass rows [..., K, M] through the last M inputs of the first layer without its bias, [..., K, h]."""
        return matmul_rows(rows, self.inner.kernel[...][-rows.shape[-1] :])

    def project_detections(self, seen: Features, appearance: jax.Array) -> jax.Array:
        """Pass the rows of detections through the first layer without its bias, [..., K, h].

        The row of a category holds its appearance, 0 where it is not detected, and its entries in the table.
        """
        # Appearances [K, h] pass the layer once for the whole batch; undetected categories get none.
        projected = self.project_appearance(appearance)
        projected = jnp.broadcast_to(projected, (*seen.visible.shape, projected.shape[-1]))
        return seen.visible[..., None] * projected + self.project_rows(seen.table)

    def finish(self, inner: jax.Array) -> jax.Array:
        """Complete the perceptron for rows [..., K, h] that passed the first layer without its bias, [..., K m]."""
        hidden = nnx.relu(add_bias(inner, self.inner))
        return self.finish_outputs(matmul_rows(hidden, self.outer.kernel[...]))

    def finish_outputs(self, outer: jax.Array) -> jax.Array:
        """Complete the perceptron for rows [..., K, m] that passed both layers without the last bias, [..., K m]."""
        maps = nnx.relu(add_bias(outer, self.outer))
        # The maps of all categories side by side, [..., K m].
        return maps.reshape(*maps.shape[:-2], -1)
