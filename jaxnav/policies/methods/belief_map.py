"""The belief about where the goal is, on the squares of the agent's own map.

A square is 2 x 2 cells of the semantic map (`map_tracker.draw_view`), 0.5 m wide. `read_squares` joins the cells of
each square. `floor_features` describes floor, walls and unexplored space around a square without any category, and
`nearby_categories` the categories seen within 0.5, 1, 2 and 4 m of it: predictors score squares by them.
`missed_looks` lowers the score of squares that were looked at in vain, and `score_targets` turns a belief into scores
of places to go: the log of the probability of detecting the goal there, per action.

Functions handle one episode; callers `vmap`. Symbols in shapes: N cells along each side of the map, n = N / 2 squares,
K categories, D distances of a look, R radii, F floor features.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.methods.map_tracker import EXPLORED_BIT, FREE_BIT, SQUARE_CELLS, WALL_BIT
from jaxnav.policies.wavefront import pack_board, walking_steps

#: Chebyshev distances, in squares, within which a category counts as seen nearby: 0.5, 1, 2 and 4 m.
RADII = (1, 2, 4, 8)
#: Chebyshev distances, in squares, of the floor around a square that predictors see.
FLOOR_RADII = (1, 3)
NUM_FLOOR_FEATURES = 3 * (1 + len(FLOOR_RADII))

#: Chebyshev distance, in squares, around a target within which the goal is expected to be detected: 1.5 m.
_DETECTION_RADIUS = 3
#: Actions that a walk takes in addition to its steps, on average, for turns and looks at its end.
_EXTRA_ACTIONS = 6.0
#: Score of squares to which the agent cannot go, or where nothing is left to explore.
NO_TARGET_SCORE = -1000.0
#: Smallest probability of detection, so that scores are finite.
_MIN_DETECTION_PROB = 1e-9


class MapSquares(NamedTuple):
    """The map of one episode, square by square.

    Attributes:
      categories: uint32 [n, n], a bit for each category that was seen in the square.
      floor: float32 [3, n, n], shares of the square's cells that are explored, free, and walls or furniture.
      looks: float32 [D, n, n], number of looks at the square, by distance.
    """

    categories: jax.Array
    floor: jax.Array
    looks: jax.Array


def read_squares(cells: jax.Array, look_counts: jax.Array) -> MapSquares:
    """Join the cells of each square.

    Args:
      cells: uint32 [N, N], the map.
      look_counts: uint8 [D, n, n], see `SearchState.looks`.
    """
    # The four cells of each square, one array for each corner.
    corners = split_corners(cells)
    joined_bits = corners[0] | corners[1] | corners[2] | corners[3]
    shares = []
    for flag in (EXPLORED_BIT, FREE_BIT, WALL_BIT):
        num_flagged = sum((corner & flag > 0).astype(jnp.float32) for corner in corners)
        shares.append(num_flagged / len(corners))
    return MapSquares(joined_bits, jnp.stack(shares), look_counts.astype(jnp.float32))


def split_corners(cells: jax.Array) -> list[jax.Array]:
    """Split an array of cells [N, N] by the corners of their squares, SQUARE_CELLS**2 arrays [n, n]."""
    corners = []
    for row in range(SQUARE_CELLS):
        for column in range(SQUARE_CELLS):
            corners.append(cells[row::SQUARE_CELLS, column::SQUARE_CELLS])
    return corners


def floor_features(floor: jax.Array) -> jax.Array:
    """Describe the floor around each square, alike for all categories.

    Args:
      floor: float32 [3, n, n], shares of a square's cells, see `MapSquares`.

    Returns:
      float32 [F, n, n], the shares of the square itself and their means within `FLOOR_RADII`.
    """
    features = [floor]
    for radius in FLOOR_RADII:
        features.append(box_sum(floor, radius) / (2 * radius + 1) ** 2)
    return jnp.concatenate(features)


def nearby_categories(categories: jax.Array) -> jax.Array:
    """Spread the categories of each square over the squares around it.

    Args:
      categories: uint32 [n, n], a bit for each category.

    Returns:
      uint32 [R, n, n], a bit for each category that was seen within each of `RADII`.
    """
    # Squares beyond an edge are those at the opposite edge.
    margin = RADII[-1]
    spread_bits = jnp.pad(categories, margin, mode="wrap")
    spread_by_radius = []
    last_radius = 0
    for radius in RADII:
        # The squares within the last radius, moved to both sides: rows first, then columns.
        shift = radius - last_radius
        for axis in (0, 1):
            size = spread_bits.shape[axis] - 2 * shift
            moved_bits = []
            for offset in (0, shift, 2 * shift):
                moved_bits.append(jax.lax.slice_in_dim(spread_bits, offset, offset + size, axis=axis))
            spread_bits = moved_bits[0] | moved_bits[1] | moved_bits[2]
            # Without the barrier XLA computes every radius from the first array, with many more operations.
            spread_bits = jax.lax.optimization_barrier(spread_bits)
        last_radius = radius
        rest = margin - radius
        spread_by_radius.append(spread_bits[rest : len(spread_bits) - rest, rest : len(spread_bits) - rest])
    return jnp.stack(spread_by_radius)


def relation_scores(nearby: jax.Array, weights: jax.Array) -> jax.Array:
    """Add up the weights of the categories nearby.

    Args:
      nearby: uint32 [R, n, n], see `nearby_categories`.
      weights: float32 [R, K], weight of each category within each radius.

    Returns:
      float32 [n, n].
    """
    # One category and radius after another: the sum is a single loop over the squares, without an array of all flags.
    num_radii, num_categories = weights.shape
    scores = jnp.zeros(nearby.shape[1:])
    for radius_index in range(num_radii):
        for category in range(num_categories):
            is_nearby = (nearby[radius_index] >> np.uint32(category)) & np.uint32(1)
            scores += weights[radius_index, category] * is_nearby.astype(jnp.float32)
    return scores


def missed_looks(look_counts: jax.Array, detection_rates: jax.Array, hidden_logit: jax.Array) -> jax.Array:
    """Log probability that the looks so far have missed a goal in each square.

    Looks miss independently unless the goal is hidden from all of them.

    Args:
      look_counts: float32 [D, n, n].
      detection_rates: float32 [D], in [0, 1), probability that a look from each distance detects a goal that is not
        hidden.
      hidden_logit: float32 [], log odds that the goal is hidden.

    Returns:
      float32 [n, n], 0 or less.
    """
    log_all_missed = jnp.tensordot(jnp.log1p(-detection_rates), look_counts, 1)
    log_hidden = jax.nn.log_sigmoid(hidden_logit)
    log_in_sight = jax.nn.log_sigmoid(-hidden_logit)
    return jnp.logaddexp(log_hidden, log_in_sight + log_all_missed)


def score_targets(log_belief: jax.Array, log_cost: jax.Array) -> jax.Array:
    """Log probability per action of detecting the goal around each square, float32 [n, n].

    Args:
      log_belief: float32 [n, n], log probability that the goal is in each square, up to a constant.
      log_cost: float32 [n, n], log number of actions to each square, see `travel_costs`.
    """
    belief = jax.nn.softmax(log_belief.reshape(-1)).reshape(log_belief.shape)
    detection_prob = box_sum(belief, _DETECTION_RADIUS)
    return jnp.log(jnp.maximum(detection_prob, _MIN_DETECTION_PROB)) - log_cost


def travel_costs(cells: jax.Array, position: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Find the number of actions to each square.

    Args:
      cells: uint32 [N, N], the map; unknown cells count as passable.
      position: int32 [2], (z, x) of the agent's cell.

    Returns:
      float32 [n, n], log number of actions to the nearest unexplored cell of each square; and bool [n, n], True where
      the square has an unexplored cell that can be reached.
    """
    steps = walking_steps(pack_board(cells & WALL_BIT == 0), position)
    unreachable = jnp.iinfo(jnp.int32).max
    is_target = (cells & EXPLORED_BIT == 0) & (steps >= 0)

    # The nearest unexplored cell of each square.
    target_steps = functools.reduce(jnp.minimum, split_corners(jnp.where(is_target, steps, unreachable)))
    has_target = target_steps < unreachable
    return jnp.log(jnp.where(has_target, target_steps, 0).astype(jnp.float32) + _EXTRA_ACTIONS), has_target


def box_sum(values: jax.Array, radius: int) -> jax.Array:
    """Sum over the squares within a Chebyshev distance, on a map that wraps around.

    Args:
      values: float32 [..., n, n].
      radius: squares.
    """
    # A band matrix adds up the neighbours of each square along one axis.
    num_squares = values.shape[-1]
    separation = (np.arange(num_squares)[:, None] - np.arange(num_squares)) % num_squares
    band = np.minimum(separation, num_squares - separation) <= radius
    band_matrix = jnp.asarray(band, jnp.float32)
    column_sums = jnp.matmul(values, band_matrix, precision="highest")
    return jnp.swapaxes(jnp.matmul(jnp.swapaxes(column_sums, -1, -2), band_matrix, precision="highest"), -1, -2)
