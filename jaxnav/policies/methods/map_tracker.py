"""Tracker of SemExp: the semantic map of an episode, and the state of the search on it.

`SemanticMap` draws views on a toroidal map by compass and odometry, one 32-bit word per cell. `MapTracker` keeps the
map and the rest of `SearchState`, which `jaxnav.policies.methods.local_policy` turns into actions, and reads the map
block by block for the network.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.wavefront import WORD_BITS
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.observation_row import (
    AHEAD_SCALE,
    MIN_RANGE,
    RIGHT_SCALE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
)
from jaxnav.scenes.task import MOVE_AHEAD, Rules

#: Categories that a cell can hold, in its lowest bits.
MAX_CATEGORIES = 27
CATEGORY_BITS = np.uint32((1 << MAX_CATEGORIES) - 1)
#: Flags of a cell in its highest bits: seen from nearby, standable, not standable, visited by the agent, and tried as a
#: viewpoint of the goal without success.
EXPLORED_BIT, FREE_BIT, WALL_BIT, VISITED_BIT, TRIED_BIT = (np.uint32(1 << bit) for bit in range(27, 32))

#: Number of blocks along each side of the map; the policy chooses one of them.
BLOCKS_PER_SIDE = 8
#: Values of `SearchState.goal_sight`: the goal is not in view or too far; near enough for Done; and near enough at a
#: place where an earlier view showed it too.
GOAL_FAR, GOAL_NEAR, GOAL_CONFIRMED = range(3)

_NO_BITS = np.uint32(0)


# The map


class PlacedView(NamedTuple):
    """A view and the pose that it was seen from.

    Attributes:
      row: uint8 [R], the observation row.
      position: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
    """

    row: jax.Array
    position: jax.Array
    heading: jax.Array


@dataclasses.dataclass(frozen=True)
class SemanticMap:
    """Functions on the map uint32 [N, N] of one episode; hashable.

    The map is toroidal, so a home fits on it wherever the agent starts. All functions take one episode; callers `vmap`.

    Attributes:
      size: N, cells along each side, a multiple of 32.
    """

    size: int = 64

    def __post_init__(self) -> None:
        if self.size < WORD_BITS or self.size % WORD_BITS:
            raise InputError(f"SemanticMap: size is {self.size}; give a multiple of {WORD_BITS}, {WORD_BITS} or more")

    def init(self) -> jax.Array:
        """Return an empty map."""
        return jnp.zeros((self.size, self.size), jnp.uint32)

    def advance(self, position: jax.Array, moved: jax.Array, step: jax.Array) -> jax.Array:
        """Return the position int32 [2] after a step (dz, dx), which only counts where the agent moved."""
        return (position + jnp.where(moved, step, 0)) % self.size

    def update(self, cells: jax.Array, look: PlacedView, row_format: RowFormat, headings: int) -> jax.Array:
        """Draw a view.

        Categories that are not detected are cleared where the view shows a cell nearby: the detector would have
        reported them.

        Args:
          cells: uint32 [N, N], the map before the view.
          look: the view.
          row_format: format of its row.
          headings: H of the task.
        """
        # Cells [V V] of the view on the map. Two cells of the view may be one of the map; both then get the same state.
        offset_table, twin_table = _view_tables(headings, row_format.view)
        near_table = CELL_SIZE * np.hypot(*np.moveaxis(offset_table, -1, 0)) <= MIN_RANGE
        offsets = jnp.asarray(offset_table)[look.heading]
        twins = jnp.asarray(twin_table)[look.heading]
        is_near = jnp.asarray(near_table)[look.heading]
        rows, columns = ((look.position[None] + offsets) % self.size).T
        view = row_format.view_cells(look.row)
        view = jnp.maximum(view, view[twins])

        # Floor and walls: cells of the view replace their flags, unseen ones stay.
        is_free = view == VIEW_FREE
        is_seen = is_free | (view == VIEW_BLOCKED)
        new_bits = jnp.where(is_free, FREE_BIT, WALL_BIT) | jnp.where(is_near, EXPLORED_BIT, _NO_BITS)
        undetected_bits = CATEGORY_BITS & ~self.detected_bits(look.row, row_format)
        cleared_bits = jnp.where(is_near, undetected_bits, _NO_BITS) | jnp.where(is_free, WALL_BIT, FREE_BIT)
        words = cells[rows, columns]
        cells = cells.at[rows, columns].set(jnp.where(is_seen, words & ~cleared_bits | new_bits, words))

        # The agent's own cell is free whatever the view says.
        row, column = look.position
        own_word = cells[row, column] & ~WALL_BIT | VISITED_BIT | FREE_BIT | EXPLORED_BIT
        cells = cells.at[row, column].set(own_word)

        # Detected categories [K]. Each has a bit of its own, so adding missing bits is a bitwise or.
        rows, columns = self.detection_cells(look, row_format, headings).T
        detected_bits = jnp.where(row_format.presence(look.row), _category_bits(row_format), _NO_BITS)
        return cells.at[rows, columns].add(detected_bits & ~cells[rows, columns])

    def detection_cells(self, look: PlacedView, row_format: RowFormat, headings: int) -> jax.Array:
        """Return the cells int32 [K, 2] in which categories are detected."""
        # Metres ahead and to the right of the agent, [K].
        detections = row_format.detections(look.row).astype(jnp.float32)
        ahead = detections[:, 1] / AHEAD_SCALE
        right = (detections[:, 2] - 128.0) / RIGHT_SCALE

        # Turn them by the heading; directions are (z, x).
        forward = jnp.asarray(Rules(headings=headings).heading_directions(), jnp.float32)[look.heading][::-1]
        rightward = jnp.stack([-forward[1], forward[0]])
        offsets = (ahead[:, None] * forward[None] + right[:, None] * rightward[None]) / CELL_SIZE
        return (look.position[None] + jnp.rint(offsets).astype(jnp.int32)) % self.size

    def neighbourhood(self, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return lines and columns, int32 [9] each, of a cell int32 [2] and its neighbours."""
        offsets = np.moveaxis(np.indices((3, 3)), 0, -1).reshape(-1, 2).astype(np.int32) - 1
        rows, columns = ((position[None] + offsets) % self.size).T
        return rows, columns

    @staticmethod
    def detected_bits(row: jax.Array, row_format: RowFormat) -> jax.Array:
        """Return the word uint32 [] with the bits of all detected categories."""
        return jnp.where(row_format.presence(row), _category_bits(row_format), _NO_BITS).sum(dtype=jnp.uint32)

    def mark_collision(self, cells: jax.Array, ahead: jax.Array, action: jax.Array, moved: jax.Array) -> jax.Array:
        """Mark the cell ahead of the agent as explored, and as a wall where the agent ran into it.

        Args:
          cells: uint32 [N, N].
          ahead: int32 [2], the cell ahead; it may lie beyond an edge.
          action: int32 [], the last action.
          moved: bool [], True where it changed the cell.
        """
        row, column = ahead % self.size
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


def _category_bits(row_format: RowFormat) -> np.ndarray:
    """Return the bits of all categories, uint32 [K]."""
    return np.uint32(1) << np.arange(row_format.num_categories, dtype=np.uint32)


@functools.lru_cache
def _view_tables(headings: int, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where the cells of a view lie on the map, by heading.

    A view turned by less than a right angle may have two of its cells in one cell of the map.

    Returns:
      int32 [H, V V, 2], (dz, dx) from the agent, and int32 [H, V V], the other cell of the view in the same cell of the
      map; the cell itself where there is no other.
    """
    offsets = Rules(headings=headings).view_offsets(view).reshape(headings, -1, 2).astype(np.int32)
    is_same_cell = (offsets[:, :, None] == offsets[:, None]).all(axis=-1)
    num_cells = is_same_cell.shape[-1]

    # Of the at most two cells, the twin of the first is the last, and vice versa.
    first_twin = is_same_cell.argmax(axis=-1)
    last_twin = num_cells - 1 - is_same_cell[..., ::-1].argmax(axis=-1)
    twins = np.where(first_twin == np.arange(num_cells), last_twin, first_twin)
    return offsets, twins.astype(np.int32)


# The tracker


class SearchState(NamedTuple):
    """Map of an episode and state of the search.

    Attributes:
      cells: uint32 [N, N], see `SemanticMap`.
      position: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
      horizon: int32 [], index of the camera's horizon.
      goal: int32 [], the category that is sought.
      goal_sight: int32 [], `GOAL_FAR`, `GOAL_NEAR` or `GOAL_CONFIRMED`.
      success_distance: float32 [], metres to the goal's centre within which Done succeeds.
      block_start: int32 [2], first cell of the block to search in.
      actions_left: int32 [], actions until the policy chooses another block, which it does at 0 unless the goal is on
        the map.
      search_horizon: int32 [], index of the horizon to search with, the lowest first; -1 before the first view.
      failed_views: int32 [], viewpoints from which the goal was not seen since it was last near.
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


class MapReading(NamedTuple):
    """Network inputs from the map.

    Attributes:
      blocks: uint32 [..., M], the bits of all cells in each block around the agent, line by line; `EXPLORED_BIT` is
        inverted and says that some cell is unexplored.
      compass: float32 [..., 2], sine and cosine of the heading.
    """

    blocks: jax.Array
    compass: jax.Array


def goal_on_map(state: SearchState) -> jax.Array:
    """Return True where the goal is on the map, bool [...]."""
    return has_category(state.cells, state.goal[..., None, None]).any(axis=(-2, -1))


@dataclasses.dataclass(frozen=True)
class MapTracker:
    """Tracker of the map; the method's knowledge is that of `learn_search_setup`."""

    def init(self, knowledge: Knowledge) -> SearchState:
        """Return an empty map with the agent at its centre."""
        semantic_map = SemanticMap(len(knowledge.method["lines"]))
        centre = jnp.full(2, semantic_map.size // 2, jnp.int32)
        zero = jnp.int32(0)
        return SearchState(
            cells=semantic_map.init(),
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
        strides = knowledge.method["steps"]
        row_format = RowFormat(knowledge.layout.shape[-1])
        semantic_map = SemanticMap(len(state.cells))
        stride = strides[percept.heading]

        # A collision leaves the view as it is, so it cannot confirm the goal.
        position = semantic_map.advance(state.position, percept.moved, stride)
        look = PlacedView(percept.row, position, percept.heading)
        goal_sight, success_distance = self._sight(state, look, percept.goal, knowledge)
        is_new_view = (percept.action != MOVE_AHEAD) | percept.moved
        confirmed_sight = jnp.where(is_new_view, goal_sight, jnp.minimum(goal_sight, state.goal_sight))

        # Draw.
        cells = semantic_map.update(state.cells, look, row_format, len(strides))
        cells = semantic_map.mark_collision(cells, position + stride, percept.action, percept.moved)
        cells = _clear_goal_once(state.cells, cells, position, percept.goal)

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
        del goal
        size = len(state.cells)
        block_size = size // BLOCKS_PER_SIDE
        headings = len(knowledge.method["steps"])

        # Put the agent at the centre, and join the bits of the cells in each of the 8 x 8 blocks.
        centred_cells = jnp.roll(state.cells ^ EXPLORED_BIT, size // 2 - state.position, axis=(0, 1))
        blocks = centred_cells.reshape(BLOCKS_PER_SIDE, block_size, BLOCKS_PER_SIDE, block_size)
        joined_bits = jax.lax.reduce(blocks, _NO_BITS, jax.lax.bitwise_or, (1, 3))

        compass = jnp.asarray(Rules(headings=headings).heading_directions(), jnp.float32)[state.heading]
        return MapReading(joined_bits.reshape(-1), compass)

    def _sight(
        self, state: SearchState, look: PlacedView, goal: jax.Array, knowledge: Knowledge
    ) -> tuple[jax.Array, jax.Array]:
        """Return how near the goal is seen, and the distance within which Done succeeds.

        Where success is measured on foot, the walk ends at the goal's edge, so a share of its size is added.
        """
        setup = knowledge.method
        row_format = RowFormat(knowledge.layout.shape[-1])
        semantic_map = SemanticMap(len(state.cells))

        # Distance of the detection, and its size as seen from there.
        detection = row_format.detections(look.row)[goal].astype(jnp.float32)
        is_detected = detection[0] > 0
        distance = jnp.hypot(detection[1] / AHEAD_SCALE, (detection[2] - 128.0) / RIGHT_SCALE)
        size_bonus = setup["edge"] * detection[3] / SIZE_SCALE * jnp.maximum(distance, CELL_SIZE)
        success_distance = setup["enough"] + size_bonus

        # Confirmed where an earlier view marked the goal in the same or a neighbouring cell.
        goal_position = semantic_map.detection_cells(look, row_format, len(setup["steps"]))[goal]
        rows, columns = semantic_map.neighbourhood(goal_position)
        is_confirmed = has_category(state.cells[rows, columns], goal).any()

        near_sight = jnp.where(is_confirmed, GOAL_CONFIRMED, GOAL_NEAR)
        goal_sight = jnp.where(is_detected & (distance <= success_distance), near_sight, GOAL_FAR)
        return goal_sight, jnp.where(is_detected, success_distance, state.success_distance)


def _clear_goal_once(cells_before: jax.Array, cells: jax.Array, position: jax.Array, goal: jax.Array) -> jax.Array:
    """Let views from one cell clear the goal from the map only once.

    Where the goal is detected at one heading and missed at the next, the agent would otherwise turn to and fro.
    """
    row, column = position
    own_word = cells[row, column]
    cleared_bits = cells_before & ~cells & category_bit(goal)

    # Restore the goal if this cell has cleared it before; mark the cell if it has cleared it now.
    cells = cells | jnp.where(own_word & TRIED_BIT > 0, cleared_bits, _NO_BITS)
    tried_bit = jnp.where((cleared_bits > 0).any(), TRIED_BIT, _NO_BITS)
    return cells.at[row, column].set(own_word | tried_bit)
