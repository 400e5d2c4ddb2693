"""Local policy of SemExp: a planner without parameters that turns chosen blocks of the map into actions.

`LocalPolicy.act` walks to unexplored cells of the chosen block or, once the goal is on the map, to a viewpoint near it.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.errors import InputError
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods.map_tracker import (
    BLOCKS_PER_SIDE,
    EXPLORED_BIT,
    GOAL_CONFIRMED,
    GOAL_FAR,
    NO_BITS,
    TRIED_BIT,
    WALL_BIT,
    SearchState,
    category_bit,
    goal_on_map,
    has_category,
    neighbourhood,
)
from jaxnav.policies.wavefront import PathField, find_path, follow_path, pack_board, turn_towards
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, ROTATE_RIGHT, Rules

#: Number of failed viewpoints after which the goal's place on the map is given up.
PATIENCE = 3


class GoalLocation(NamedTuple):
    """Location of the goal on the map.

    Attributes:
      is_known: bool [], True where the goal is on the map.
      position: int32 [2], the nearest cell with the goal.
      viewpoints: bool [N, N], untried cells where Done should succeed.
    """

    is_known: jax.Array
    position: jax.Array
    viewpoints: jax.Array


@dataclasses.dataclass(frozen=True)
class LocalPolicy:
    """Control that walks to the block of the map that the policy chooses.

    A choice is a block of cells around the agent. The agent walks to the nearest unexplored cell of the block or, if
    none can be reached, to the nearest unexplored cell of the map. Once the goal is on the map, the agent walks to the
    nearest viewpoint, and says Done when two views show the goal nearby.

    Attributes:
      interval: largest number of actions between two choices, while the agent searches.
      use_nearest_frontier: True to ignore the choices and always walk to the nearest unexplored cell.
    """

    interval: int = 25
    use_nearest_frontier: bool = False

    def __post_init__(self) -> None:
        if self.interval < 1:
            raise InputError(f"LocalPolicy: interval is {self.interval}; give 1 or more actions between two choices")

    @property
    def num_choices(self) -> int:
        """Number of blocks."""
        return BLOCKS_PER_SIDE**2

    def is_decision_step(self, state: SearchState) -> jax.Array:
        """Return True where the policy chooses a block now, bool [...].

        Once the goal is on the map, the search is over and the policy chooses no more blocks.
        """
        return (state.actions_left == 0) & ~goal_on_map(state)

    def act(self, choice: jax.Array, state: SearchState, knowledge: Knowledge) -> tuple[jax.Array, SearchState]:
        """Return the action int32 [] of a choice int32 [], and the state of the search."""
        # Store the chosen block at a decision step.
        strides = knowledge.method["steps"]
        num_headings = len(strides)
        size = len(state.cells)
        state = self._apply_choice(choice, state)

        # Targets: viewpoints of a known goal, or else unexplored cells of the chosen block.
        goal_location = _locate_goal(state)
        unexplored = pack_board(state.cells & EXPLORED_BIT == 0)
        search_targets = unexplored
        if not self.use_nearest_frontier:
            search_targets = unexplored & _block_board(state.block_start, self.block_size(size), size)
        targets = jnp.where(goal_location.is_known, pack_board(goal_location.viewpoints), search_targets)

        # Plan a path; the search has failed if no cell can be reached.
        path_field, is_reachable = _plan_path(targets, unexplored, state)
        has_arrived = path_field.length == 0
        has_failed = path_field.length < 0
        goal_heading = _nearest_heading(state.position, goal_location.position, num_headings, size)
        is_facing_goal = has_arrived & (goal_heading == state.heading)

        # The first true condition selects the action; otherwise the agent follows the path.
        actions_by_condition = [
            (state.goal_sight == GOAL_CONFIRMED, DONE),
            (state.horizon < state.search_horizon, LOOK_DOWN),
            (state.horizon > state.search_horizon, LOOK_UP),
            (has_failed | is_facing_goal, ROTATE_RIGHT),
            (has_arrived, turn_towards(goal_heading, state.heading, num_headings)),
        ]
        conditions, actions = zip(*actions_by_condition, strict=True)
        path_action = follow_path(path_field, state.position, state.heading, strides)
        action = jnp.select(list(conditions), list(actions), path_action)

        # A viewpoint fails if the goal is not near although the agent faces it with the right horizon.
        is_failed_view = is_facing_goal & (state.goal_sight == GOAL_FAR) & (state.horizon == state.search_horizon)
        state = _record_failed_view(state, goal_location, is_failed_view)
        state = _restart_search_if(has_failed, state, knowledge)

        # The policy chooses again at the next step if no cell of the block can be reached.
        actions_left = jnp.where(goal_location.is_known | is_reachable, state.actions_left, 1)
        return action.astype(jnp.int32), state._replace(actions_left=actions_left)

    def _apply_choice(self, choice: jax.Array, state: SearchState) -> SearchState:
        """Store the chosen block, at a decision step."""
        block_start = self._find_block(choice, state)
        is_decision_step = self.is_decision_step(state)
        return state._replace(
            block_start=jnp.where(is_decision_step, block_start, state.block_start),
            actions_left=jnp.where(is_decision_step, self.interval, state.actions_left),
        )

    def block_size(self, size: int) -> int:
        """Return the number of cells along each side of a block, on a map of N cells."""
        return size // BLOCKS_PER_SIDE

    def _find_block(self, choice: jax.Array, state: SearchState) -> jax.Array:
        """Return the first cell int32 [2] of a block."""
        # Blocks are numbered row by row from the corner of the map centred on the agent.
        size = len(state.cells)
        block = jnp.stack([choice // BLOCKS_PER_SIDE, choice % BLOCKS_PER_SIDE]).astype(jnp.int32)
        return (state.position - size // 2 + self.block_size(size) * block) % size


def _block_board(block_start: jax.Array, block_size: int, size: int) -> jax.Array:
    """Return the board uint32 [N, N / 32] of the block that starts at a cell int32 [2]."""
    in_rows, in_columns = (jnp.arange(size)[None] - block_start[:, None]) % size < block_size
    return jnp.where(in_rows[:, None], pack_board(in_columns)[None], NO_BITS)


def _locate_goal(state: SearchState) -> GoalLocation:
    """Find the nearest cell with the goal on the map, and its viewpoints."""
    # Cells without the goal are infinitely far.
    size = len(state.cells)
    infinity = jnp.iinfo(jnp.int32).max
    goal_distances = jnp.where(
        has_category(state.cells, state.goal), _squared_distances(state.position, size), infinity
    )
    nearest = goal_distances.argmin()
    position = jnp.stack([nearest // size, nearest % size]).astype(jnp.int32)

    # Viewpoints are near the goal, no walls, and not tried before.
    squared_metres = CELL_SIZE**2 * _squared_distances(position, size).astype(jnp.float32)
    is_near = squared_metres <= state.success_distance**2
    viewpoints = is_near & (state.cells & (WALL_BIT | TRIED_BIT) == 0)
    return GoalLocation(goal_distances.min() < infinity, position, viewpoints)


def _squared_distances(position: jax.Array, size: int) -> jax.Array:
    """Return the squared distances of all cells from one cell, in units of cells, int32 [N, N]."""
    row_squares, column_squares = jnp.square(wrapped_offset(position[:, None], jnp.arange(size)[None], size))
    return row_squares[:, None] + column_squares[None]


def wrapped_offset(start: jax.Array, end: jax.Array, size: int) -> jax.Array:
    """Return the shorter displacement between two positions on a toroidal map."""
    return (end - start + size // 2) % size - size // 2


def _nearest_heading(start: jax.Array, end: jax.Array, headings: int, size: int) -> jax.Array:
    """Return the heading int32 [] that points most directly from one cell to another."""
    directions = jnp.asarray(Rules(headings=headings).heading_directions()[:, ::-1], jnp.float32)  # (z, x)
    return (directions @ wrapped_offset(start, end, size).astype(jnp.float32)).argmax()


def _plan_path(targets: jax.Array, unexplored: jax.Array, state: SearchState) -> tuple[PathField, jax.Array]:
    """Find a path to the targets or, if no path leads there, to any unexplored cell.

    Returns:
      The path, and True where the targets can be reached, bool [].
    """
    # Unknown cells count as passable.
    passable = pack_board(state.cells & WALL_BIT == 0)
    target_path = find_path(targets, passable, state.position)
    is_reachable = target_path.length >= 0

    # A wave without targets ends at once, so the fallback costs nothing if the targets can be reached.
    fallback_targets = jnp.where(is_reachable, NO_BITS, unexplored)
    fallback_path = find_path(fallback_targets, passable, state.position)

    def select_leaf(target_leaf: jax.Array, fallback_leaf: jax.Array) -> jax.Array:
        return jnp.where(is_reachable, target_leaf, fallback_leaf)

    return jax.tree.map(select_leaf, target_path, fallback_path), is_reachable


def _record_failed_view(state: SearchState, goal_location: GoalLocation, is_failed_view: jax.Array) -> SearchState:
    """Record a failed view at the agent's cell, and give the goal up after `PATIENCE` failed views.

    Giving up clears the goal from its cell on the map and the neighbouring cells.
    """
    # Mark the cell of the agent if its view has failed.
    row, column = state.position
    own_word = state.cells[row, column]
    cells = state.cells.at[row, column].set(jnp.where(is_failed_view, own_word | TRIED_BIT, own_word))

    # A goal that fails in several views was probably a false detection.
    failed_views = state.failed_views + is_failed_view.astype(jnp.int32)
    is_given_up = failed_views >= PATIENCE
    cleared_bit = jnp.where(is_given_up, category_bit(state.goal), NO_BITS)
    rows, columns = neighbourhood(goal_location.position, len(cells))
    cells = cells.at[rows, columns].set(cells[rows, columns] & ~cleared_bit)
    return state._replace(cells=cells, failed_views=jnp.where(is_given_up, 0, failed_views))


def _restart_search_if(has_failed: jax.Array, state: SearchState, knowledge: Knowledge) -> SearchState:
    """Restart a failed search: no cell is explored or tried, and the camera searches with the next higher horizon."""
    forgotten_bits = jnp.where(has_failed, EXPLORED_BIT | TRIED_BIT, NO_BITS)
    next_horizon = (state.search_horizon - 1) % knowledge.method["horizons"]
    return state._replace(
        cells=state.cells & ~forgotten_bits,
        search_horizon=jnp.where(has_failed, next_horizon, state.search_horizon),
    )
