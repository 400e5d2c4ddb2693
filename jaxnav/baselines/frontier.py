"""Frontier exploration: systematic search without a prior.

The searcher remembers which cells it perceived as standable and as blocked, and which it has inspected from a short
distance. Frontiers are poses on known standable cells from which a near cell that was never inspected would be in view.
The searcher always takes the first action of a shortest known path, turns included, to the nearest frontier. Once the
goal has been detected, it goes to the nearest pose from which the detected place is in view and near enough instead.
There it says Done if the goal was detected at that place from two poses: false alarms are placed at random and seldom
agree.

`run_frontier_search` runs the searcher on a list of episodes, `FrontierSearcher` acts in one.

Sets of cells are Python integers: bit z * GRID_SIDE + x stands for the cell (z, x) of a square grid with the start in
the middle. Moving a set is then a bit shift, so that a path search over thousands of poses takes few operations.
"""

import dataclasses
import functools
import operator
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import (
    MIN_RANGE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
    detected_positions,
    relative_position,
)
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NEIGHBOURS, ROTATE_LEFT, ROTATE_RIGHT, Rules

SAME_PLACE_DISTANCE = 0.25  # metres between detections of one object from different poses
ROUNDING_SLACK = 0.05  # metres by which the goal must be nearer than required, because offsets are rounded
MISSES_PER_SIGHTING = 2  # misses per sighting until a place is given up

#: Cells from the start to the edge of the area in which standable cells are remembered.
MEMORY_RADIUS = 64
#: Cells from there to the edge of the grid: every view from the memory area fits, so that no shift wraps round.
GRID_MARGIN = 16
GRID_SIDE = 2 * (MEMORY_RADIUS + GRID_MARGIN) + 1
#: Index of the start cell, the centre of the grid.
START_CELL = (GRID_SIDE + 1) * (MEMORY_RADIUS + GRID_MARGIN)


def run_frontier_search(bank: Bank, episodes: EpisodeList, step_limit: np.ndarray) -> EpisodeOutcome:
    """Run the searcher in episodes.

    Args:
      bank: the scenes.
      episodes: E episodes.
      step_limit: int [S], greatest number of actions in each scene.

    Returns:
      Leaves [E]; the weight of removed experience is 0.
    """
    successor = bank.successor

    # Walk through every episode.
    final_poses = []
    final_actions = []
    lengths = []
    num_moves = []
    for scene, pose, goal in zip(episodes.scene, episodes.pose.tolist(), episodes.goal.tolist(), strict=True):
        steps = list(frontier_walk(bank, successor, pose, goal, int(step_limit[scene])))
        final_pose, final_action = steps[-1]
        final_poses.append(final_pose)
        final_actions.append(final_action)
        lengths.append(len(steps))
        num_moves.append(sum(action == MOVE_AHEAD for _, action in steps))

    # Done succeeds where the shortest path has length 1.
    final_pose = np.array(final_poses, np.int32)
    final_action = np.array(final_actions, np.int32)
    is_done = final_action == DONE
    at_goal = bank.best_length[final_pose, episodes.goal] == 1
    end_cell = successor[final_pose, final_action] // bank.task.rules.poses_per_cell
    length = jnp.asarray(lengths, jnp.int32)
    return EpisodeOutcome(
        done=jnp.asarray(is_done),
        success=jnp.asarray(is_done & at_goal),
        length=length,
        moves=jnp.asarray(num_moves, jnp.int32),
        distance=jnp.asarray(bank.goal_distance[end_cell, episodes.goal]),
        num_decisions=length,
        total_weight=jnp.zeros(len(lengths)),
    )


def frontier_walk(bank: Bank, successor: np.ndarray, pose: int, goal: int, limit: int) -> Iterator[tuple[int, int]]:
    """Yield the searcher's poses and the actions taken there.

    The episode ends with Done or after `limit` actions. The searcher only receives views and detections.

    Args:
      bank: the scenes.
      successor: int [P, 6], pose after every action.
      pose: start of the episode.
      goal: category to search for.
      limit: greatest number of actions.
    """
    rules = bank.task.rules
    row_format = RowFormat(len(bank.task.categories))
    _, heading, horizon = rules.split_pose(pose)
    searcher = FrontierSearcher(rules, heading, horizon)
    for _ in range(limit):
        row = bank.rows[pose]
        action = searcher.act(row_format.view_cells(row), row_format.detections(row)[goal])
        yield pose, action
        if action == DONE:
            return
        pose = int(successor[pose, action])


@dataclasses.dataclass
class _GoalPlace:
    """A place where the goal was detected.

    Attributes:
      position: float64 [2], (x, z) from the start, metres.
      viewpoints: cells from which the place is in view and near enough, by heading.
      sightings: poses from which the goal was detected at this place.
      misses: number of viewpoints without a detection since the last sighting.
    """

    position: np.ndarray
    viewpoints: list[int]
    sightings: set[tuple[int, int, int]]
    misses: int = 0


class FrontierSearcher:
    """Searcher for a goal in one episode, action by action."""

    def __init__(self, rules: Rules, heading: int, horizon: int):
        """Start an episode; the first cell becomes the origin.

        Args:
          rules: rules of the task.
          heading: index of the first heading.
          horizon: index of the first horizon.
        """
        self._rules = rules
        self._geometry = motion_and_view(rules)
        self._cell = START_CELL
        self._heading = heading
        self._horizon = horizon

        # Sets of cells; visited ones by horizon and heading.
        self._free = 0
        self._blocked = 0
        self._inspected = 0
        self._visited = [[0] * rules.headings for _ in rules.horizons]

        self._goal_places: list[_GoalPlace] = []
        self._search_horizon = len(rules.horizons) - 1  # the lowest first

    def act(self, view: np.ndarray, detection: np.ndarray) -> int:
        """Perceive the view from the current pose, and choose an action.

        Args:
          view: uint8 [V V], see `RowFormat.view_cells`.
          detection: uint8 [4], detection of the goal, see `RowFormat.detections`.
        """
        self._update_map(view)
        action = DONE if self._update_goal_places(detection) else self._choose_action()

        # Dead reckoning. A MoveAhead always succeeds, because the cell ahead is known to be standable.
        if action == MOVE_AHEAD:
            self._cell += self._geometry.move_shifts[self._heading]
        turn = (action == ROTATE_RIGHT) - (action == ROTATE_LEFT)
        self._heading = (self._heading + turn) % self._rules.headings
        self._horizon += (action == LOOK_DOWN) - (action == LOOK_UP)
        return action

    def _update_map(self, view: np.ndarray) -> None:
        """Add the free, blocked and inspected cells of a view to the map."""
        shift = self._cell - START_CELL
        view_cells = self._geometry.view_cells[self._heading]
        free = shift_cells(cell_set(view_cells[view == VIEW_FREE]), shift)
        blocked = shift_cells(cell_set(view_cells[view == VIEW_BLOCKED]), shift)
        self._free |= free & MEMORY_AREA
        self._blocked |= blocked
        self._inspected |= (free | blocked) & shift_cells(self._geometry.near_cells[self._heading], shift)

    def _update_goal_places(self, detection: np.ndarray) -> bool:
        """Take in a detection of the goal, and return True where Done is due."""
        visited = self._visited[self._horizon]
        cell_bit = 1 << self._cell
        is_new_pose = not visited[self._heading] & cell_bit
        visited[self._heading] |= cell_bit

        detected_place = None
        is_near = False
        if detection[0]:
            detected_place, is_near = self._record_sighting(detection)

        # A new viewpoint without a detection counts against its place.
        for place in self._goal_places:
            if place is not detected_place and is_new_pose and place.viewpoints[self._heading] & cell_bit:
                place.misses += 1
        return detected_place is not None and is_near and len(detected_place.sightings) > 1

    def _record_sighting(self, detection: np.ndarray) -> tuple[_GoalPlace, bool]:
        """Return the place of a detection, and True if it is near enough for Done."""
        rules = self._rules
        distance = float(np.hypot(*relative_position(detection)))
        near_enough = rules.success_distance - ROUNDING_SLACK
        if rules.success == "near":  # the walk ends at the object's edge
            near_enough += detection[3] / SIZE_SCALE * max(distance, CELL_SIZE) / 4

        # Position of the detection from the start.
        z, x = divmod(self._cell, GRID_SIDE)
        agent_position = CELL_SIZE * (np.array([x, z]) - START_CELL // GRID_SIDE)
        position = detected_positions(detection, agent_position, rules.heading_directions()[self._heading])

        # Detections close to a known place belong to it.
        for place in self._goal_places:
            if np.hypot(*(place.position - position)) <= SAME_PLACE_DISTANCE:
                break
        else:
            place = _GoalPlace(position, cells_facing(rules, position, near_enough), set())
            self._goal_places.append(place)
        place.sightings.add((self._cell, self._heading, self._horizon))
        place.misses = 0
        return place, distance <= near_enough

    def _choose_action(self) -> int:
        """Choose an action towards a goal place, or else towards a frontier.

        Without either, a new search starts with the next higher horizon, which avoids the poses that were visited with
        that horizon.
        """
        if self._horizon != self._search_horizon:
            return LOOK_DOWN if self._horizon < self._search_horizon else LOOK_UP

        # Viewpoints of the goal places that are not given up.
        action = None
        viewpoints = []
        for place in self._goal_places:
            if place.misses < MISSES_PER_SIGHTING * len(place.sightings):
                viewpoints.append(place.viewpoints)
        if viewpoints:
            action = self._first_action_towards([union(cells) for cells in zip(*viewpoints, strict=True)])

        if action is None:
            action = self._first_action_towards(self._frontiers())
        if action is None:
            self._inspected = 0
            self._search_horizon = (self._search_horizon - 1) % len(self._rules.horizons)
            return ROTATE_RIGHT
        return action

    def _frontiers(self) -> list[int]:
        """Return by heading the cells from which a near cell that was never inspected would be in view."""
        frontier_edge = union(shift_cells(self._free, shift) for shift in NEIGHBOUR_SHIFTS)
        uninspected = (self._free | self._blocked | frontier_edge) & ~self._inspected
        frontiers = []
        for shifts in self._geometry.near_shifts:
            frontiers.append(union(shift_cells(uninspected, -shift) for shift in shifts))
        return frontiers

    def _first_action_towards(self, targets: list[int]) -> int | None:
        """Return the first action of a shortest known path to the nearest unvisited target.

        Args:
          targets: cells by heading.

        Returns:
          The action; None if no target can be reached.
        """
        free = self._free
        move_shifts = self._geometry.move_shifts
        num_headings = self._rules.headings
        visited = self._visited[self._horizon]
        reached = [cells & free & ~visited_cells for cells, visited_cells in zip(targets, visited, strict=True)]
        if not any(reached):
            return None

        # Search backwards from the targets, one action per iteration, until the own pose is reached.
        cell_bit = 1 << self._cell
        while True:
            last_reached = reached
            reached = []
            for heading in range(num_headings):
                turned = last_reached[heading - 1] | last_reached[(heading + 1) % num_headings]
                moved = shift_cells(last_reached[heading], -move_shifts[heading]) & free
                reached.append(last_reached[heading] | turned | moved)
            if reached[self._heading] & cell_bit:
                break
            if reached == last_reached:
                return None

        # The first action leads to a pose that was reached one iteration earlier.
        if last_reached[self._heading] & shift_cells(cell_bit, move_shifts[self._heading]):
            return MOVE_AHEAD
        if last_reached[(self._heading + 1) % num_headings] & cell_bit:
            return ROTATE_RIGHT
        return ROTATE_LEFT


class MotionAndView(NamedTuple):
    """Motion and view of the searcher on the grid, by heading.

    Attributes:
      move_shifts: shift of MoveAhead.
      view_cells: int [H, V V], cells of the view around `START_CELL`.
      near_cells: set of the view's cells in which objects of every size are in the detector's range.
      near_shifts: shifts to these cells.
    """

    move_shifts: list[int]
    view_cells: np.ndarray
    near_cells: list[int]
    near_shifts: list[list[int]]


@functools.lru_cache
def motion_and_view(rules: Rules) -> MotionAndView:
    """Return motion and view under the rules of docs/environment.md."""
    view = RowFormat(0).view
    ahead = np.arange(view).repeat(view)
    right = np.tile(np.arange(view) - view // 2, view)
    offsets = rules.view_offsets(view).reshape(rules.headings, -1, 2)  # [H, V V, (dz, dx)]
    shifts = offsets @ (GRID_SIDE, 1)

    # Cells in the view cone and within the least detection range.
    distance = CELL_SIZE * np.hypot(*np.moveaxis(offsets, -1, 0))
    is_near = (np.abs(right) <= rules.half_view_tangents[0] * ahead) & (distance <= MIN_RANGE)
    near_cells = []
    near_shifts = []
    for heading_shifts, mask in zip(shifts, is_near, strict=True):
        near_cells.append(cell_set(START_CELL + heading_shifts[mask]))
        near_shifts.append(np.unique(heading_shifts[mask]).tolist())

    move_shifts = (rules.move_steps() @ (GRID_SIDE, 1)).tolist()
    return MotionAndView(move_shifts, START_CELL + shifts, near_cells, near_shifts)


def cells_facing(rules: Rules, position: np.ndarray, max_distance: float) -> list[int]:
    """Return by heading the cells that have a position in view.

    Args:
      rules: headings and field of view.
      position: float64 [2], (x, z) from the start, metres.
      max_distance: greatest distance from a cell to the position, metres.
    """
    # Cells (x, z) of the memory area around the position, and their displacements to it.
    window = np.stack(np.meshgrid(*[np.arange(-GRID_MARGIN, GRID_MARGIN + 1)] * 2), axis=-1)
    cells = np.rint(position / CELL_SIZE).astype(int) + window  # [N, N, (x, z)]
    displacement = position - CELL_SIZE * cells
    is_close = np.hypot(displacement[..., 0], displacement[..., 1]) <= max_distance
    is_close &= (np.abs(cells) <= MEMORY_RADIUS).all(axis=-1)
    cell_indices = START_CELL + cells[is_close] @ (1, GRID_SIDE)

    # Field of view of each heading.
    directions = rules.heading_directions()
    ahead = displacement[is_close] @ directions.T  # [cells, H]
    right = displacement[is_close] @ np.stack([directions[:, 1], -directions[:, 0]])
    in_view = (ahead > 0) & (np.abs(right) <= rules.half_view_tangents[0] * ahead)
    return [cell_set(cell_indices[mask]) for mask in in_view.T]


def cell_set(indices: np.ndarray) -> int:
    """Return the set of cells with the given indices."""
    bits = np.zeros(GRID_SIDE * GRID_SIDE, bool)
    bits[indices] = True
    return int.from_bytes(np.packbits(bits, bitorder="little").tobytes(), "little")


def union(sets: Iterable[int]) -> int:
    """Return the union of sets of cells."""
    return functools.reduce(operator.or_, sets, 0)


def shift_cells(cells: int, shift: int) -> int:
    """Return a set of cells moved by a shift."""
    return cells << shift if shift >= 0 else cells >> -shift


def _memory_area() -> int:
    """Return the set of the cells within `MEMORY_RADIUS` of the start, row by row."""
    row = ((1 << (2 * MEMORY_RADIUS + 1)) - 1) << GRID_MARGIN
    return union(row << (GRID_SIDE * z) for z in range(GRID_MARGIN, GRID_SIDE - GRID_MARGIN))


#: Shifts to the eight neighbouring cells.
NEIGHBOUR_SHIFTS = (NEIGHBOURS @ (GRID_SIDE, 1)).tolist()
MEMORY_AREA = _memory_area()
