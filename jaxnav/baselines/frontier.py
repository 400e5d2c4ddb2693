"""Frontier exploration: a systematic searcher without any prior.

It remembers which cells it perceived as standable, which as blocked, and which it has inspected from a short distance.
Frontiers are poses on known standable cells with a near cell in view that has not been inspected. It always takes the
first action of a shortest known way, turns included, to the nearest frontier, or, where the goal has been detected, to
the nearest pose with the detected place in view and near enough. There it says Done if the goal has been detected at
that place from two poses: false alarms are placed at random and seldom agree.
"""

import dataclasses
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from jaxnav.baselines.cell_sets import AROUND, SIDE, START, WITHIN, body, cell_set, facing, moved, union
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.scenes.scene import CELL
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import (
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
    detected_places,
    relative_position,
)
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, Rules

SAME_PLACE = 0.25  # metres between detections of one object from different poses
SLACK = 0.05  # metres by which the goal must be nearer than required, since offsets are rounded
PATIENCE = 2  # misses per sighting until a place is given up


def frontier_outcome(bank: Bank, episodes: EpisodeList, step_limit: np.ndarray) -> Outcome:
    """Run the searcher in episodes.

    Args:
      bank: the scenes.
      episodes: E of them.
      step_limit: int [S], actions of an episode in each scene.

    Returns:
      Leaves [E]; the weight is 0.
    """
    successor, limits = bank.successor, step_limit[episodes.scene]
    starts = zip(episodes.pose.tolist(), episodes.goal.tolist(), limits.tolist(), strict=True)
    walks = [list(walk(bank, successor, *start)) for start in starts]
    last, action = np.array([steps[-1] for steps in walks], np.int32).T
    reached = bank.best_length[last, episodes.goal] == 1
    end = successor[last, action] // bank.task.rules.poses_per_cell
    moves = [sum(action == MOVE_AHEAD for _, action in steps) for steps in walks]
    length = jnp.asarray([len(steps) for steps in walks], jnp.int32)
    return Outcome(
        done=jnp.asarray(action == DONE),
        success=jnp.asarray((action == DONE) & reached),
        length=length,
        moves=jnp.asarray(moves, jnp.int32),
        distance=jnp.asarray(bank.goal_distance[end, episodes.goal]),
        choices=length,
        weight=jnp.zeros(len(walks)),
    )


def walk(bank: Bank, successor: np.ndarray, pose: int, goal: int, limit: int) -> Iterator[tuple[int, int]]:
    """Yield the searcher's poses and its actions there.

    The episode ends with Done or after `limit` actions. The searcher gets nothing but view and detection from the bank.

    Args:
      bank: the scenes.
      successor: int [P, 6], pose after every action.
      pose: start of the episode.
      goal: index of the category to search for.
      limit: actions at most.
    """
    rules, row_format = bank.task.rules, RowFormat(len(bank.task.categories))
    searcher = Searcher(rules, *rules.split(pose)[1:])
    for _ in range(limit):
        row = bank.rows[pose]
        action = searcher.act(row_format.view_cells(row), row_format.detections(row)[goal])
        yield pose, action
        if action == DONE:
            return
        pose = int(successor[pose, action])


@dataclasses.dataclass
class _Place:
    """Hold a place where the goal was detected.

    Attributes:
      at: (x, z) from the start, metres.
      poses: by heading, the cells from which the place is in view and near enough.
      sightings: poses from which the goal was detected here.
      misses: poses of `poses` without a detection since the last sighting.
    """

    at: np.ndarray
    poses: list[int]
    sightings: set[tuple[int, int, int]]
    misses: int = 0


class Searcher:
    """Search for a goal in one episode, action by action."""

    def __init__(self, rules: Rules, heading: int, horizon: int):
        """Start an episode; its first cell is the origin.

        Args:
          rules: of the task.
          heading, horizon: of the start, indices of the rules.
        """
        self._rules, self._body = rules, body(rules)
        self._cell, self._heading, self._horizon = START, heading, horizon
        self._free = self._blocked = self._inspected = 0
        self._taken = [[0] * rules.headings for _ in rules.horizons]
        self._places: list[_Place] = []
        self._sweep = len(rules.horizons) - 1  # the horizon to search with, the lowest first

    def act(self, view: np.ndarray, detection: np.ndarray) -> int:
        """Take in what is perceived, and choose an action.

        Args:
          view: uint8 [V V], see `RowFormat.view_cells`.
          detection: uint8 [4], of the goal, see `RowFormat.detections`.
        """
        self._remember(view)
        action = DONE if self._sees_goal(detection) else self._next()
        body, headings = self._body, self._rules.headings
        if action == MOVE_AHEAD:
            self._cell += body.steps[self._heading]  # never in vain: the cell ahead is known to be standable
        self._heading = (self._heading + (action == ROTATE_RIGHT) - (action == ROTATE_LEFT)) % headings
        self._horizon += (action == LOOK_DOWN) - (action == LOOK_UP)
        return action

    def _remember(self, view: np.ndarray) -> None:
        body, heading = self._body, self._heading
        free, blocked = (
            moved(cell_set(body.view[heading][view == kind]), self._cell - START) for kind in (VIEW_FREE, VIEW_BLOCKED)
        )
        self._free |= free & WITHIN
        self._blocked |= blocked
        self._inspected |= (free | blocked) & moved(body.near[heading], self._cell - START)

    def _sees_goal(self, detection: np.ndarray) -> bool:
        """Take in a detection, and return whether to say Done."""
        taken, here = self._taken[self._horizon], 1 << self._cell
        new = not taken[self._heading] & here
        taken[self._heading] |= here
        seen, near = self._perceived(detection) if detection[0] else (None, False)
        for place in self._places:
            if place is not seen and new and place.poses[self._heading] & here:
                place.misses += 1
        return seen is not None and near and len(seen.sightings) > 1

    def _perceived(self, detection: np.ndarray) -> tuple[_Place, bool]:
        """Return a detection's place, and whether it is near enough."""
        away, rules = float(np.hypot(*relative_position(detection))), self._rules
        enough = rules.success_distance - SLACK
        if rules.success == "near":  # the walk ends at its edge
            enough += detection[3] / SIZE_SCALE * max(away, CELL) / 4
        z, x = divmod(self._cell, SIDE)
        here = CELL * (np.array([x, z]) - START // SIDE)
        at = detected_places(detection, here, rules.directions()[self._heading])
        for place in self._places:
            if np.hypot(*(place.at - at)) <= SAME_PLACE:
                break
        else:
            place = _Place(at, facing(rules, at, enough), set())
            self._places.append(place)
        place.sightings.add((self._cell, self._heading, self._horizon))
        place.misses = 0
        return place, away <= enough

    def _next(self) -> int:
        """Choose an action towards the goal or a frontier.

        Where there is neither, a new search begins with the next higher horizon. It avoids the poses that were taken
        with that horizon before.
        """
        if self._horizon != self._sweep:
            return LOOK_DOWN if self._horizon < self._sweep else LOOK_UP
        places = [place.poses for place in self._places if place.misses < PATIENCE * len(place.sightings)]
        action = self._towards([union(sets) for sets in zip(*places, strict=True)])
        if action is None:
            action = self._towards(self._frontiers())
        if action is None:
            self._inspected, self._sweep = 0, (self._sweep - 1) % len(self._rules.horizons)
            return ROTATE_RIGHT
        return action

    def _frontiers(self) -> list[int]:
        """Return the frontiers, a set of cells by heading.

        From them a near cell that has not been inspected would be in view.
        """
        edge = union(moved(self._free, step) for step in AROUND)
        wanted = (self._free | self._blocked | edge) & ~self._inspected
        return [union(moved(wanted, -offset) for offset in offsets) for offsets in self._body.offsets]

    def _towards(self, targets: list[int]) -> int | None:
        """Return the first action on a shortest known way.

        It leads to the nearest of the targets that have not been taken; None if there is no way.
        """
        free, steps, headings = self._free, self._body.steps, self._rules.headings
        taken = self._taken[self._horizon]
        reached = [cells & free & ~visited for cells, visited in zip(targets, taken, strict=False)]
        if not any(reached):
            return None
        here, heading = 1 << self._cell, self._heading
        while True:  # backwards from the targets, one action a turn
            before = reached
            reached = [
                before[h] | before[h - 1] | before[(h + 1) % headings] | (moved(before[h], -steps[h]) & free)
                for h in range(headings)
            ]
            if reached[heading] & here:
                break
            if reached == before:
                return None
        if before[heading] & moved(here, steps[heading]):
            return MOVE_AHEAD
        return ROTATE_RIGHT if before[(heading + 1) % headings] & here else ROTATE_LEFT
