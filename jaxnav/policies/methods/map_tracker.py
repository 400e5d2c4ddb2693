"""Tracker of SemExp: the semantic map of an episode, and the state of the search on it.

`draw_view` draws views on a toroidal map by compass and odometry, one 32-bit word per cell. `MapTracker` updates the
`SearchState`, which holds the map and from which `jaxnav.policies.methods.local_policy` plans actions, and reads the
map block by block for the network.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.method import Knowledge, Percept
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.observation_row import (
    MIN_RANGE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
    relative_position,
    turn_offsets,
)
from jaxnav.scenes.task import MOVE_AHEAD, FrontCell, Rules

#: Number of categories that a cell can hold, one in each of its lowest bits.
MAX_CATEGORIES = 27
#: The bits of all categories.
CATEGORY_BITS = np.uint32((1 << MAX_CATEGORIES) - 1)
#: Flag of cells that were seen from nearby.
EXPLORED_BIT = np.uint32(1 << 27)
#: Flag of standable cells.
FREE_BIT = np.uint32(1 << 28)
#: Flag of cells where the agent cannot stand: walls and furniture.
WALL_BIT = np.uint32(1 << 29)
#: Flag of cells that the agent has visited.
VISITED_BIT = np.uint32(1 << 30)
#: Flag of cells that were tried as viewpoints of the goal without success.
TRIED_BIT = np.uint32(1 << 31)
#: Word without any bit.
NO_BITS = np.uint32(0)

#: Number of blocks along each side of the map; the policy chooses one of them.
BLOCKS_PER_SIDE = 8
#: Cells along each side of a square, the unit in which looks are counted: 0.5 m.
SQUARE_CELLS = 2
#: Width of the distance bins of looks, metres, and their number; the last bin holds all larger distances.
LOOK_SPACING = 0.5
NUM_LOOK_DISTANCES = 6
#: Value of `SearchState.goal_sight`: the goal is not in view, or too far for Done.
GOAL_FAR = 0
#: Value of `SearchState.goal_sight`: the goal is near enough for Done.
GOAL_NEAR = 1
#: Value of `SearchState.goal_sight`: the goal is near enough for Done, and an earlier view has shown it there too.
GOAL_CONFIRMED = 2


# The map


class ViewTable(NamedTuple):
    """Cells of the map that a view shows.

    A view turned by less than a right angle may have two of its cells in one map cell.

    Attributes:
      offsets: int32 [H, V V, 2], (dz, dx) from the agent, by heading.
      distances: float64 [H, V V], metres from the agent.
      twins: int32 [H, V V], for each cell of the view its twin in the same map cell; the cell itself if it has none.
    """

    offsets: np.ndarray
    distances: np.ndarray
    twins: np.ndarray


def draw_view(
    cells: jax.Array,
    row: jax.Array,
    position: jax.Array,
    heading: jax.Array,
    row_format: RowFormat,
    view_table: ViewTable,
) -> jax.Array:
    """Draw a view on the map of one episode, and return the map uint32 [N, N].

    The map is toroidal, so a home fits on it for every start of the agent. Nearby cells lose the categories that the
    detector does not report, because it would have detected them.

    Args:
      cells: uint32 [N, N], the map before the view; N is a multiple of 32.
      row: uint8 [R], the observation row.
      position: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
      row_format: format of the observation row.
      view_table: cells of the view, by heading.
    """
    # Map cells [V V] of the view. Two cells of the view may share a map cell, whose state they then share.
    size = len(cells)
    offsets = jnp.asarray(view_table.offsets)[heading]
    twins = jnp.asarray(view_table.twins)[heading]
    is_near = jnp.asarray(view_table.distances <= MIN_RANGE)[heading]
    rows, columns = ((position[None] + offsets) % size).T
    view = row_format.view_cells(row)
    view = jnp.maximum(view, view[twins])

    # Detected categories [K], each with a bit of its own.
    category_bits = np.uint32(1) << np.arange(row_format.num_categories, dtype=np.uint32)
    detected_bits = jnp.where(row_format.presence(row), category_bits, NO_BITS)

    # Floor and walls: seen cells get new flags, unseen cells keep theirs.
    is_free = view == VIEW_FREE
    is_seen = is_free | (view == VIEW_BLOCKED)
    new_bits = jnp.where(is_free, FREE_BIT, WALL_BIT) | jnp.where(is_near, EXPLORED_BIT, NO_BITS)
    undetected_bits = CATEGORY_BITS & ~detected_bits.sum(dtype=jnp.uint32)
    cleared_bits = jnp.where(is_near, undetected_bits, NO_BITS) | jnp.where(is_free, WALL_BIT, FREE_BIT)
    words = cells[rows, columns]
    cells = cells.at[rows, columns].set(jnp.where(is_seen, words & ~cleared_bits | new_bits, words))

    # The agent's own cell is always free, visited and explored.
    own_row, own_column = position
    own_word = cells[own_row, own_column] & ~WALL_BIT | VISITED_BIT | FREE_BIT | EXPLORED_BIT
    cells = cells.at[own_row, own_column].set(own_word)

    # Adding the missing bits is a bitwise or.
    rows, columns = detection_cells(row, position, heading, row_format, len(view_table.offsets), size).T
    return cells.at[rows, columns].add(detected_bits & ~cells[rows, columns])


def detection_cells(
    row: jax.Array, position: jax.Array, heading: jax.Array, row_format: RowFormat, headings: int, size: int
) -> jax.Array:
    """Return the map cell int32 [K, 2] of each category's detection; without a detection it is meaningless.

    Args:
      row, position, heading, row_format: as in `draw_view`.
      headings: H, number of headings of the task.
      size: N, cells along each side of the map.
    """
    # Metres ahead and to the right of the agent, [K].
    detections = row_format.detections(row).astype(jnp.float32)
    ahead, right = relative_position(detections)

    # Turn the offsets by the heading, (x, z), to those of the map, (z, x).
    forward = jnp.asarray(Rules(headings=headings).heading_directions(), jnp.float32)[heading]
    offsets = turn_offsets(ahead, right, forward[None])[:, ::-1] / CELL_SIZE
    return (position[None] + jnp.rint(offsets).astype(jnp.int32)) % size


def nearest_looks(
    row: jax.Array, position: jax.Array, heading: jax.Array, row_format: RowFormat, view_table: ViewTable, size: int
) -> jax.Array:
    """Return the distance bin from which a view shows each square, int32 [N / 2, N / 2].

    Squares that the view does not show have the bin `NUM_LOOK_DISTANCES`. Of a square's cells the nearest one counts.

    Args:
      row, position, heading, row_format, view_table: as in `draw_view`.
      size: N, cells along each side of the map.
    """
    # Squares and distance bins of the cells of the view, [V V].
    offsets = jnp.asarray(view_table.offsets)[heading]
    bin_table = np.minimum(view_table.distances / LOOK_SPACING, NUM_LOOK_DISTANCES - 1).astype(np.int32)
    rows, columns = ((position[None] + offsets) % size // SQUARE_CELLS).T
    view = row_format.view_cells(row)
    is_seen = (view == VIEW_FREE) | (view == VIEW_BLOCKED)
    distance_bins = jnp.where(is_seen, jnp.asarray(bin_table)[heading], NUM_LOOK_DISTANCES)

    num_squares = size // SQUARE_CELLS
    unseen = jnp.full((num_squares, num_squares), NUM_LOOK_DISTANCES, jnp.int32)
    return unseen.at[rows, columns].min(distance_bins)


def neighbourhood(position: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """Return rows and columns, int32 [9] each, of a cell int32 [2] and its eight neighbours on a map of N cells."""
    offsets = np.moveaxis(np.indices((3, 3)), 0, -1).reshape(-1, 2).astype(np.int32) - 1
    rows, columns = ((position[None] + offsets) % size).T
    return rows, columns


def mark_collision(cells: jax.Array, ahead: jax.Array, action: jax.Array, moved: jax.Array) -> jax.Array:
    """Mark the cell ahead of the agent as explored, and as a wall where the agent ran into it.

    Args:
      cells: uint32 [N, N].
      ahead: int32 [2], the cell ahead, which may lie beyond an edge.
      action: int32 [], the previous action.
      moved: bool [], True where the previous action changed the cell.
    """
    row, column = ahead % len(cells)
    is_wall = (action == MOVE_AHEAD) & ~moved
    word = cells[row, column]
    marked_word = jnp.where(is_wall, word & ~FREE_BIT | WALL_BIT, word) | EXPLORED_BIT
    return cells.at[row, column].set(marked_word)


def has_category(cells: jax.Array, category: jax.Array) -> jax.Array:
    """Return True for map cells that hold a category int32 [], bool [...]."""
    return cells & category_bit(category) > 0


def category_bit(category: jax.Array) -> jax.Array:
    """Return the bit uint32 [] of a category int32 []."""
    return jnp.uint32(1) << category.astype(jnp.uint32)


def other_category_bits(goal: jax.Array) -> jax.Array:
    """Return the bits of all categories but the goal, uint32 [...], for a goal float32 [..., K], one-hot."""
    category_bits = jnp.asarray(1 << np.arange(goal.shape[-1]), jnp.uint32)
    return jnp.where(goal > 0, NO_BITS, category_bits).sum(axis=-1, dtype=jnp.uint32)


@functools.lru_cache
def make_view_table(rules: Rules, view: int) -> ViewTable:
    """Return the cells of a view of V x V cells, by heading."""
    offsets = rules.view_offsets(view).reshape(rules.headings, -1, 2).astype(np.int32)
    distances = CELL_SIZE * np.hypot(*np.moveaxis(offsets, -1, 0))
    is_same_cell = (offsets[:, :, None] == offsets[:, None]).all(axis=-1)
    num_cells = is_same_cell.shape[-1]

    # At most two cells of the view share a map cell: the twin of the first is the last, and vice versa.
    first_twin = is_same_cell.argmax(axis=-1)
    last_twin = num_cells - 1 - is_same_cell[..., ::-1].argmax(axis=-1)
    twins = np.where(first_twin == np.arange(num_cells), last_twin, first_twin)
    return ViewTable(offsets, distances, twins.astype(np.int32))


def is_new_view(percept: Percept) -> jax.Array:
    """Return whether the view is a new one, bool []; after a collision it is the previous one."""
    return (percept.action != MOVE_AHEAD) | percept.moved


def learned_view_table(setup: Mapping[str, Any], view: int) -> ViewTable:
    """Return the cells of a view under the rules of the training homes.

    Args:
      setup: knowledge of SemExp; only that of tasks with `front_cell="move"` has the entry `front_cell_is_move`.
      view: V, cells along each side of a view.
    """
    # The presence of an entry is static, so the table is a constant of the program; a value would be traced.
    front_cell: FrontCell = "move" if "front_cell_is_move" in setup else "nearest"
    return make_view_table(Rules(headings=len(setup["steps"]), front_cell=front_cell), view)


# The tracker


class SearchState(NamedTuple):
    """Map of an episode and state of the search.

    Attributes:
      cells: uint32 [N, N], the map, see `draw_view`.
      position: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
      horizon: int32 [], index of the camera's horizon.
      goal: int32 [], category of the goal.
      goal_sight: int32 [], `GOAL_FAR`, `GOAL_NEAR` or `GOAL_CONFIRMED`.
      success_distance: float32 [], metres to the goal's centre within which Done succeeds.
      block_start: int32 [2], first cell of the block to search in.
      actions_left: int32 [], actions until the policy chooses another block; at 0 it chooses, unless the goal is on the
        map.
      search_horizon: int32 [], index of the horizon to search with, at first the lowest; -1 before the first view.
      failed_views: int32 [], number of viewpoints that did not show the goal since it was last near.
      looks: uint8 [D, N / 2, N / 2], number of views that showed each square, by the distance bin of `nearest_looks`;
        None for methods that do not count looks.
    """

    cells: jax.Array
    position: jax.Array
    heading: jax.Array
    horizon: jax.Array
    goal: jax.Array
    goal_sight: jax.Array
    success_distance: jax.Array
    block_start: jax.Array
    actions_left: jax.Array
    search_horizon: jax.Array
    failed_views: jax.Array
    looks: jax.Array | None = None


class MapReading(NamedTuple):
    """Network inputs from the map.

    Attributes:
      blocks: uint32 [..., M], the joined bits of all cells in each block around the agent, row by row; `EXPLORED_BIT`
        is inverted, so it marks blocks with unexplored cells.
      compass: float32 [..., 2], sine and cosine of the heading.
    """

    blocks: jax.Array
    compass: jax.Array


def goal_on_map(state: SearchState) -> jax.Array:
    """Return True where the goal is on the map, bool [...]."""
    return has_category(state.cells, state.goal[..., None, None]).any(axis=(-2, -1))


@dataclasses.dataclass(frozen=True)
class MapTracker:
    """Tracker of the map; `learn_search_setup` provides the method's knowledge."""

    def init(self, knowledge: Knowledge) -> SearchState:
        """Return an empty map with the agent at its centre."""
        # The knowledge has an entry for each row of the map.
        size = len(knowledge.method["lines"])
        centre = jnp.full(2, size // 2, jnp.int32)
        zero = jnp.int32(0)

        # Without actions left, the policy chooses a block at the first step.
        return SearchState(
            cells=jnp.zeros((size, size), jnp.uint32),
            position=centre,
            heading=zero,
            horizon=zero,
            goal=zero,
            goal_sight=zero,
            success_distance=knowledge.method["enough"],
            block_start=centre,
            actions_left=zero,
            search_horizon=jnp.int32(-1),
            failed_views=zero,
        )

    def update(self, state: SearchState, knowledge: Knowledge, percept: Percept) -> SearchState:
        """Draw a view on the map and update the state of the search."""
        # Follow the agent by compass and odometry.
        strides = knowledge.method["steps"]
        row_format = RowFormat(knowledge.priors.shape[-1])
        stride = strides[percept.heading]
        position = (state.position + jnp.where(percept.moved, stride, 0)) % len(state.cells)

        # Only a new view can confirm the goal: after a collision the view is the previous one.
        goal_sight, success_distance = self._judge_goal_sight(state, percept, position, knowledge)
        confirmed_sight = jnp.where(is_new_view(percept), goal_sight, jnp.minimum(goal_sight, state.goal_sight))

        # Draw the view, the collision and a cleared goal on the map.
        view_table = learned_view_table(knowledge.method, row_format.view)
        cells = draw_view(state.cells, percept.row, position, percept.heading, row_format, view_table)
        cells = mark_collision(cells, position + stride, percept.action, percept.moved)
        cells = _clear_goal_once(state.cells, cells, position, percept.goal)

        # The search starts with the lowest horizon; a goal nearby resets the failed views.
        lowest_horizon = knowledge.method["horizons"] - 1
        return state._replace(
            cells=cells,
            position=position,
            heading=percept.heading,
            horizon=percept.horizon,
            goal=percept.goal,
            goal_sight=confirmed_sight,
            success_distance=success_distance,
            actions_left=jnp.maximum(state.actions_left - 1, 0),
            search_horizon=jnp.where(state.search_horizon < 0, lowest_horizon, state.search_horizon),
            failed_views=jnp.where(goal_sight == GOAL_FAR, state.failed_views, 0),
        )

    def read(self, state: SearchState, knowledge: Knowledge, goal: jax.Array) -> MapReading:
        """Return the map around the agent, block by block, and the compass."""
        size = len(state.cells)
        block_size = size // BLOCKS_PER_SIDE
        headings = len(knowledge.method["steps"])

        # Put the agent at the centre, and join the bits of the cells in each of the 8 x 8 blocks.
        centred_cells = jnp.roll(state.cells ^ EXPLORED_BIT, size // 2 - state.position, axis=(0, 1))
        blocks = centred_cells.reshape(BLOCKS_PER_SIDE, block_size, BLOCKS_PER_SIDE, block_size)
        joined_bits = jax.lax.reduce(blocks, NO_BITS, jax.lax.bitwise_or, (1, 3))

        compass = jnp.asarray(Rules(headings=headings).heading_directions(), jnp.float32)[state.heading]
        return MapReading(joined_bits.reshape(-1), compass)

    def _judge_goal_sight(
        self, state: SearchState, percept: Percept, position: jax.Array, knowledge: Knowledge
    ) -> tuple[jax.Array, jax.Array]:
        """Judge if the view shows the goal near enough for Done.

        The distance to the goal's centre within which Done succeeds grows with the goal's size in tasks that measure
        the walk to the goal's edge.

        Returns:
          int32 [], the new `SearchState.goal_sight`, and float32 [], the new `SearchState.success_distance`.
        """
        setup = knowledge.method
        row_format = RowFormat(knowledge.priors.shape[-1])
        goal = percept.goal
        size = len(state.cells)

        # Distance of the detected goal, and how much its size adds to the distance of success.
        detection = row_format.detections(percept.row)[goal].astype(jnp.float32)
        is_detected = detection[0] > 0
        distance = jnp.hypot(*relative_position(detection))
        size_bonus = setup["edge"] * detection[3] / SIZE_SCALE * jnp.maximum(distance, CELL_SIZE)
        success_distance = setup["enough"] + size_bonus

        # An earlier view confirms the goal if it marked the goal in this cell or in a neighbouring cell.
        headings = len(setup["steps"])
        positions = detection_cells(percept.row, position, percept.heading, row_format, headings, size)
        rows, columns = neighbourhood(positions[goal], size)
        is_confirmed = has_category(state.cells[rows, columns], goal).any()

        near_sight = jnp.where(is_confirmed, GOAL_CONFIRMED, GOAL_NEAR)
        goal_sight = jnp.where(is_detected & (distance <= success_distance), near_sight, GOAL_FAR)
        return goal_sight, jnp.where(is_detected, success_distance, state.success_distance)


def _clear_goal_once(cells_before: jax.Array, cells: jax.Array, position: jax.Array, goal: jax.Array) -> jax.Array:
    """Let views from one cell clear the goal from the map only once.

    Otherwise the agent would turn to and fro at a cell that shows the goal at one heading and misses it at the next.
    """
    row, column = position
    own_word = cells[row, column]
    cleared_bits = cells_before & ~cells & category_bit(goal)

    # Restore the goal if this cell has cleared it before, but not where the agent stands. Mark this cell if it has
    # cleared the goal now.
    cells = cells | jnp.where(own_word & TRIED_BIT > 0, cleared_bits, NO_BITS)
    tried_bit = jnp.where((cleared_bits > 0).any(), TRIED_BIT, NO_BITS)
    return cells.at[row, column].set(own_word | tried_bit)
