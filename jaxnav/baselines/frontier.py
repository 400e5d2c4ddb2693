"""A systematic searcher without any prior: frontier exploration from what is perceived alone.

It remembers which cells it perceived as standable, which as blocked, and which it has looked at from near by. Frontiers
are poses on known standable cells with something in view and near that has not been looked at. It always takes the
first action of a shortest known way, turns included, to the nearest frontier, or, where the goal has been detected, to
the nearest pose with the perceived place in view and near enough. There it says Done if the goal has been detected at
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
    AHEAD_SCALE,
    RIGHT_SCALE,
    SIZE_SCALE,
    VIEW_BLOCKED,
    VIEW_FREE,
    RowFormat,
)
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, Rules

SAME_PLACE = 0.25  # metres between detections of one object from different poses
SLACK = 0.05  # metres by which the goal must be nearer than it need be, since offsets are rounded
PATIENCE = 2  # poses, per sighting, at which the goal should be detected but is not, until its place is given up


def frontier_outcome(bank: Bank, episodes: EpisodeList, step_limit: np.ndarray) -> Outcome:
    """How the searcher fares in episodes.

    Args:
      bank: the scenes.
      episodes: E of them.
      step_limit: int [S], of each scene.

    Returns:
      Leaves [E]; the weight is 0.
    """
    successor, limits = bank.successor, step_limit[episodes.scene]
    starts = zip(episodes.pose.tolist(), episodes.goal.tolist(), limits.tolist(), strict=True)
    walks = [list(walk(bank, successor, *start)) for start in starts]
    last, action = np.array([steps[-1] for steps in walks], np.int32).T
    found = bank.best_length[last, episodes.goal] == 1
    end = successor[last, action] // bank.task.rules.poses_per_cell
    moves = [sum(action == MOVE_AHEAD for _, action in steps) for steps in walks]
    return Outcome(
        success=jnp.asarray((action == DONE) & found),
        length=jnp.asarray([len(steps) for steps in walks], jnp.int32),
        moves=jnp.asarray(moves, jnp.int32),
        distance=jnp.asarray(bank.goal_distance[end, episodes.goal]),
        weight=jnp.zeros(len(walks)),
    )


def walk(bank: Bank, successor: np.ndarray, pose: int, goal: int, limit: int) -> Iterator[tuple[int, int]]:
    """The searcher's poses and the actions it takes there, until it says Done or `limit` actions are taken.

    The bank takes it from pose to pose (by `successor`, int [P, 6]); of it the searcher gets view and detection alone.
    """
    rules, row_format = bank.task.rules, RowFormat(len(bank.task.categories))
    horizons = len(rules.horizons)
    searcher = Searcher(rules, pose // horizons % rules.headings, pose % horizons)
    for _ in range(limit):
        row = bank.rows[pose]
        action = searcher.act(row_format.view_cells(row), row_format.detections(row)[goal])
        yield pose, action
        if action == DONE:
            return
        pose = int(successor[pose, action])


@dataclasses.dataclass
class _Place:
    """Where the goal was detected.

    Attributes:
      at: (x, z) from the start, metres.
      poses: for each heading, the cells from which the place is in view and near enough.
      sightings: poses at which the goal was detected here.
      misses: poses of `poses` that the searcher came to without detecting it, since the last sighting.
    """

    at: np.ndarray
    poses: list[int]
    sightings: set[tuple[int, int, int]]
    misses: int = 0


class Searcher:
    """The searcher in one episode: `act` takes what is perceived and answers with an action."""

    def __init__(self, rules: Rules, heading: int, horizon: int):
        """Start with a heading and a horizon (both indices of the rules); the start's place is its origin."""
        self._rules, self._body = rules, body(rules)
        self._cell, self._heading, self._horizon = START, heading, horizon
        self._free = self._blocked = self._looked_at = 0
        self._taken = [[0] * rules.headings for _ in rules.horizons]
        self._places: list[_Place] = []
        self._sweep = len(rules.horizons) - 1  # the horizon to search with, at first the one that sees most things near

    def act(self, view: np.ndarray, detection: np.ndarray) -> int:
        """Perceive, and choose the next action.

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
        self._looked_at |= (free | blocked) & moved(body.near[heading], self._cell - START)

    def _sees_goal(self, detection: np.ndarray) -> bool:
        """Take a detection in; whether the goal is believed to be found here."""
        taken, here = self._taken[self._horizon], 1 << self._cell
        new = not taken[self._heading] & here
        taken[self._heading] |= here
        seen, near = self._perceived(detection) if detection[0] else (None, False)
        for place in self._places:
            if place is not seen and new and place.poses[self._heading] & here:
                place.misses += 1
        return seen is not None and near and len(seen.sightings) > 1

    def _perceived(self, detection: np.ndarray) -> tuple[_Place, bool]:
        """The place of a detection, and whether it is near enough."""
        ahead, right, apparent = detection[1] / AHEAD_SCALE, (detection[2] - 128.0) / RIGHT_SCALE, detection[3]
        away, rules = float(np.hypot(ahead, right)), self._rules
        enough = rules.success_distance - SLACK
        if rules.success == "near":  # to walk to its edge
            enough += apparent / SIZE_SCALE * max(away, CELL) / 4
        z, x = divmod(self._cell, SIDE)
        forward = rules.directions()[self._heading]
        rightward = np.array([forward[1], -forward[0]])
        at = CELL * (np.array([x, z]) - START // SIDE) + ahead * forward + right * rightward
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
        """The next action on the way to the goal's places, or else to frontiers; where there are none, it begins anew.

        Each new search is with the next higher horizon, and keeps away from poses that were taken with it before.
        """
        if self._horizon != self._sweep:
            return LOOK_DOWN if self._horizon < self._sweep else LOOK_UP
        places = [place.poses for place in self._places if place.misses < PATIENCE * len(place.sightings)]
        action = self._towards([union(own) for own in zip(*places, strict=True)])
        if action is None:
            action = self._towards(self._frontiers())
        if action is None:
            self._looked_at, self._sweep = 0, (self._sweep - 1) % len(self._rules.horizons)
            return ROTATE_RIGHT
        return action

    def _frontiers(self) -> list[int]:
        """For each heading, the cells from which a near cell that has not been looked at would be in view."""
        edge = union(moved(self._free, step) for step in AROUND)
        wanted = (self._free | self._blocked | edge) & ~self._looked_at
        return [union(moved(wanted, -offset) for offset in offsets) for offsets in self._body.offsets]

    def _towards(self, targets: list[int]) -> int | None:
        """First action on a shortest known way to the nearest of the poses that have not been taken."""
        free, steps, headings = self._free, self._body.steps, self._rules.headings
        taken = self._taken[self._horizon]
        reached = [cells & free & ~own for cells, own in zip(targets, taken, strict=False)]
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
