"""Local policy of SemExp: a planner without parameters that turns chosen blocks of the map into actions.

`LocalPolicy.act` walks to unexplored cells of the chosen block or, once the goal is on the map, to a viewpoint near it.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods.map_tracker import (
    BLOCKS_PER_SIDE,
    EXPLORED_BIT,
    GOAL_CONFIRMED,
    GOAL_FAR,
    TRIED_BIT,
    WALL_BIT,
    SearchState,
    SemanticMap,
    category_bit,
    goal_on_map,
    has_category,
)
from jaxnav.policies.wavefront import PathField, find_path, follow_path, pack_board, turn_towards
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, ROTATE_RIGHT, Rules

#: Number of viewpoints from which the goal is not seen until its place on the map is given up.
PATIENCE = 3

_NO_BITS = np.uint32(0)


class GoalLocation(NamedTuple):
    """Location of the goal on the map.

    Attributes:
      is_known: bool [], True where the goal is on the map.
      position: int32 [2], the nearest cell that holds it.
      viewpoints: bool [N, N], cells where Done should succeed and which have not been tried without success.
    """

    is_known: jax.Array
    position: jax.Array
    viewpoints: jax.Array


@dataclasses.dataclass(frozen=True)
class LocalPolicy:
    """Control that walks to where the policy wants to search, by the map alone.

    A choice is a block of cells around the agent. The agent walks to the nearest unexplored cell of the block or, if
    none can be reached, to the nearest unexplored cell of all. Once the goal is on the map, the agent walks to the
    nearest viewpoint of it, and says Done when the goal is near in two views.

    Attributes:
      interval: largest number of actions between two choices, while the agent searches.
      use_nearest_frontier: True to ignore the choices and always search in the nearest unexplored cell.
    """

    interval: int = 25
    use_nearest_frontier: bool = False

    def __post_init__(self) -> None:
        if self.interval < 1:
            raise InputError(f"LocalPolicy: interval is {self.interval}; give 1 action or more from choice to choice")

    @property
    def num_choices(self) -> int:
        """Number of blocks."""
        return BLOCKS_PER_SIDE**2

    def is_decision_step(self, state: SearchState) -> jax.Array:
        """Return True where the policy chooses a block now, bool [...].

        Once the goal is on the map the search is over and nothing is chosen.
        """
        return (state.actions_left == 0) & ~goal_on_map(state)

    def act(self, choice: jax.Array, state: SearchState, knowledge: Knowledge) -> tuple[jax.Array, SearchState]:
        """Return the action int32 [] of a choice int32 [], and the state of the search."""
        strides = knowledge.method["steps"]
        num_headings = len(strides)
        size = len(state.cells)
        state = self._apply_choice(choice, state)

        # Targets: viewpoints of a known goal, or else unexplored cells of the chosen block.
        goal_location = _locate_goal(state)
        unexplored = pack_board(state.cells & EXPLORED_BIT == 0)
        search_targets = unexplored
        if not self.use_nearest_frontier:
            search_targets = unexplored & _block_board(state.block_start, size)
        targets = jnp.where(goal_location.is_known, pack_board(goal_location.viewpoints), search_targets)

        # Plan; nothing left to reach means that the search has failed.
        path_field, is_reachable = _plan_path(targets, unexplored, state)
        has_arrived = path_field.length == 0
        has_failed = path_field.length < 0
        goal_heading = _nearest_heading(state.position, goal_location.position, num_headings, size)
        is_facing_goal = has_arrived & (goal_heading == state.heading)

        # The first condition that holds selects the action; without any the agent follows the path.
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

        # Choose again at once where nothing in the block can be reached.
        actions_left = jnp.where(goal_location.is_known | is_reachable, state.actions_left, 1)
        return action.astype(jnp.int32), state._replace(actions_left=actions_left)

    def _apply_choice(self, choice: jax.Array, state: SearchState) -> SearchState:
        """Store the chosen block, at a decision step."""
        # Blocks are numbered line by line from the corner of the map centred on the agent.
        size = len(state.cells)
        block = jnp.stack([choice // BLOCKS_PER_SIDE, choice % BLOCKS_PER_SIDE]).astype(jnp.int32)
        block_start = (state.position - size // 2 + size // BLOCKS_PER_SIDE * block) % size

        is_decision_step = self.is_decision_step(state)
        return state._replace(
            block_start=jnp.where(is_decision_step, block_start, state.block_start),
            actions_left=jnp.where(is_decision_step, self.interval, state.actions_left),
        )


def _block_board(block_start: jax.Array, size: int) -> jax.Array:
    """Return the board uint32 [N, N / 32] of the block with this first cell."""
    block_size = size // BLOCKS_PER_SIDE
    in_rows, in_columns = (jnp.arange(size)[None] - block_start[:, None]) % size < block_size
    return jnp.where(in_rows[:, None], pack_board(in_columns)[None], _NO_BITS)


def _locate_goal(state: SearchState) -> GoalLocation:
    """Find the nearest cell with the goal on the map, and its viewpoints."""
    size = len(state.cells)
    infinity = jnp.iinfo(jnp.int32).max
    # Cells without the goal are infinitely far.
    goal_distances = jnp.where(
        has_category(state.cells, state.goal), _squared_distances(state.position, size), infinity
    )
    nearest = goal_distances.argmin()
    position = jnp.stack([nearest // size, nearest % size]).astype(jnp.int32)

    # Viewpoints are near the goal, and neither walls nor tried in vain.
    squared_metres = CELL_SIZE**2 * _squared_distances(position, size).astype(jnp.float32)
    is_near = squared_metres <= state.success_distance**2
    viewpoints = is_near & (state.cells & (WALL_BIT | TRIED_BIT) == 0)
    return GoalLocation(goal_distances.min() < infinity, position, viewpoints)


def _squared_distances(position: jax.Array, size: int) -> jax.Array:
    """Return squared distances from a cell in cells, int32 [N, N]."""
    row_squares, column_squares = jnp.square(_wrapped_offset(position[:, None], jnp.arange(size)[None], size))
    return row_squares[:, None] + column_squares[None]


def _wrapped_offset(start: jax.Array, end: jax.Array, size: int) -> jax.Array:
    """Return the shorter of the two displacements on a toroidal map."""
    return (end - start + size // 2) % size - size // 2


def _nearest_heading(start: jax.Array, end: jax.Array, headings: int, size: int) -> jax.Array:
    """Return the heading int32 [] whose direction is nearest to that of another cell."""
    directions = jnp.asarray(Rules(headings=headings).heading_directions()[:, ::-1], jnp.float32)  # (z, x)
    return (directions @ _wrapped_offset(start, end, size).astype(jnp.float32)).argmax()


def _plan_path(targets: jax.Array, unexplored: jax.Array, state: SearchState) -> tuple[PathField, jax.Array]:
    """Find a path to the targets or, if there is none, to any unexplored cell.

    Returns:
      The path, and True where the targets can be reached, bool [].
    """
    # Unknown cells count as passable.
    passable = pack_board(state.cells & WALL_BIT == 0)
    target_path = find_path(targets, passable, state.position)
    is_reachable = target_path.length >= 0

    # Without targets the second wave ends at once, so it costs nothing where the first one succeeds.
    other_targets = jnp.where(is_reachable, _NO_BITS, unexplored)
    other_path = find_path(other_targets, passable, state.position)
    path_field = jax.tree.map(lambda a, b: jnp.where(is_reachable, a, b), target_path, other_path)
    return path_field, is_reachable


def _record_failed_view(state: SearchState, goal_location: GoalLocation, is_failed_view: jax.Array) -> SearchState:
    """Mark the agent's cell as tried, and give the goal up after `PATIENCE` failed views.

    Giving up clears the goal from its cell on the map and the neighbouring cells.
    """
    row, column = state.position
    # Mark the cell of the agent, where the view has failed.
    own_word = state.cells[row, column]
    cells = state.cells.at[row, column].set(jnp.where(is_failed_view, own_word | TRIED_BIT, own_word))

    # A goal that fails in several views was probably a false detection.
    failed_views = state.failed_views + is_failed_view.astype(jnp.int32)
    gives_up = failed_views >= PATIENCE
    cleared_bit = jnp.where(gives_up, category_bit(state.goal), _NO_BITS)
    rows, columns = SemanticMap(len(cells)).neighbourhood(goal_location.position)
    cells = cells.at[rows, columns].set(cells[rows, columns] & ~cleared_bit)
    return state._replace(cells=cells, failed_views=jnp.where(gives_up, 0, failed_views))


def _restart_search_if(has_failed: jax.Array, state: SearchState, knowledge: Knowledge) -> SearchState:
    """Forget which cells are explored and tried, and search with the next higher horizon."""
    forgotten_bits = jnp.where(has_failed, EXPLORED_BIT | TRIED_BIT, _NO_BITS)
    next_horizon = (state.search_horizon - 1) % knowledge.method["horizons"]
    return state._replace(
        cells=state.cells & ~forgotten_bits,
        search_horizon=jnp.where(has_failed, next_horizon, state.search_horizon),
    )
