"""Tasks: categories, goals and the rules of an episode.

`ROOMS`, `APARTMENTS` and `HOUSES` are the tasks of the three worlds; `Rules` also defines the geometry of poses, moves
and the ego-centric view.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np

from jaxnav.errors import InputError, check_choice
from jaxnav.scenes.categories import (
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    ITHOR_CATEGORIES,
    ROBOTHOR_CATEGORIES,
    ROBOTHOR_GOALS,
)
from jaxnav.scenes.tables.observation_row import Detector, RowFormat, turn_offsets

#: Names of the actions; an action is an index into them.
ACTIONS = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
NUM_ACTIONS = len(ACTIONS)
MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(NUM_ACTIONS)

#: (dz, dx) of the eight neighbouring cells, clockwise from +z.
NEIGHBOURS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])

#: Cell in front of the agent that a view shows, see `Rules.front_cell`.
FrontCell = Literal["move", "nearest"]


@dataclasses.dataclass(frozen=True)
class Rules:
    """Rules of motion, view and success.

    Attributes:
      headings: H; heading h looks 360 h / H degrees clockwise from +z. With fewer than 8, some of the eight moves are
        missing, and only goals that can be reached from every cell are sought.
      horizons: camera pitches, degrees downwards; training episodes start with the first.
      field_of_view: horizontal and vertical, degrees.
      camera: height above the floor, metres.
      front_cell: cell that the middle of the view's row 1 shows. `move`: the cell that MoveAhead leads to, so that the
        agent can see if it is free. `nearest`: the one nearest to the point a cell's length along the heading, as in
        files from before this setting. With 4 or 8 headings, both are the same; other tasks should have `move`.
      success: condition for Done to succeed: `seen`, a visible goal object whose centre is within the success distance
        horizontally; or `near`, a goal object whose footprint is within the success distance on foot.
      success_distance: metres.
    """

    headings: int = 8
    horizons: tuple[float, ...] = (0.0, 30.0)
    field_of_view: tuple[float, float] = (100.0, 100.0)
    camera: float = 1.5
    # Not a part of the text, which the checksums of banks and benchmarks from before this setting contain.
    front_cell: FrontCell = dataclasses.field(default="nearest", repr=False)
    success: Literal["seen", "near"] = "seen"
    success_distance: float = 1.5

    def __post_init__(self) -> None:
        if type(self.headings) is not int or self.headings < 1:
            raise InputError(f"Rules.headings {self.headings!r}: give a whole number of at least 1")
        check_choice("Rules.success", self.success, ("seen", "near"))
        check_choice("Rules.front_cell", self.front_cell, get_args(FrontCell))

    @property
    def poses_per_cell(self) -> int:
        """Number of poses of one cell.

        Poses are numbered by pose = (cell * headings + heading) * horizons + horizon, each an index.
        """
        return self.headings * len(self.horizons)

    def join_pose(self, cell: Any, heading: Any, horizon: Any) -> Any:
        """Pose with a cell, a heading and a horizon: indices, ints or arrays of ints of shapes that broadcast."""
        return (cell * self.headings + heading) * len(self.horizons) + horizon

    def split_pose(self, pose: Any) -> tuple[Any, Any, Any]:
        """Cell, heading and horizon of poses, the inverse of `join_pose`.

        Each is an index of the type and the shape of `pose`: an int or an array of ints.
        """
        num_horizons = len(self.horizons)
        return pose // self.poses_per_cell, pose // num_horizons % self.headings, pose % num_horizons

    @property
    def half_view_tangents(self) -> tuple[float, float]:
        """Tangents of half the field of view, horizontal and vertical."""
        horizontal, vertical = np.tan(np.deg2rad(self.field_of_view) / 2)
        return float(horizontal), float(vertical)

    def heading_directions(self) -> np.ndarray:
        """Return the unit vectors of the headings, float64 [H, 2], (x, z).

        Components are rounded so that equal lengths are equal numbers.
        """
        # Clockwise from +z, so x is the sine and z the cosine.
        angles = np.deg2rad(360.0 / self.headings * np.arange(self.headings))
        return np.round(np.stack([np.sin(angles), np.cos(angles)], axis=-1), 12)

    def view_offsets(self, view: int) -> np.ndarray:
        """Return the cells of the ego-centric view.

        Args:
          view: V, cells along each side of the view.

        Returns:
          int [H, V, V, 2], (dz, dx) from the agent's cell, by heading; row 0 nearest to the agent, column 0 leftmost.
        """
        offsets = self.offsets_by_heading(np.arange(view), np.arange(view) - view // 2)
        if self.front_cell == "move":
            offsets[:, 1, view // 2] = self.move_steps()
        return offsets

    def offsets_by_heading(self, ahead: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return cells ahead and to the right of the agent.

        Args:
          ahead: int [A], cells.
          right: int [B], cells.

        Returns:
          int [H, A, B, 2], (dz, dx) from the agent's cell, by heading.
        """
        forward = self.heading_directions()[:, None, None]  # [H, 1, 1, 2]
        offsets = turn_offsets(ahead[:, None], right, forward)
        return np.rint(offsets[..., ::-1]).astype(int)  # (x, z) to (z, x)

    def move_steps(self) -> np.ndarray:
        """Return the displacement of MoveAhead for each heading, int [H, 2], (dz, dx).

        MoveAhead leads to the neighbouring cell in the nearest direction.
        """
        # There are eight neighbours, so several headings can share one.
        nearest_neighbour = np.rint(8 / self.headings * np.arange(self.headings)).astype(int) % 8
        return NEIGHBOURS[nearest_neighbour]


@dataclasses.dataclass(frozen=True)
class Task:
    """Search task of an agent; hashable.

    Attributes:
      categories: [K] names of the object categories that can be detected.
      goals: the categories that can be goals; () for all of `categories`.
      rules: rules of motion, view and success.
      detector: detector with its error rates.
      instance_counts: whether observation rows also hold the number of detected instances of each category, which
        layout estimators with `counts="instances"` need; all other bytes of a row stay the same.
    """

    categories: tuple[str, ...] = ITHOR_CATEGORIES
    goals: tuple[str, ...] = ()
    rules: Rules = Rules()
    detector: Detector = Detector()
    instance_counts: bool = False

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Task":
        """Make a task from its fields as read from JSON."""
        # JSON has lists where the dataclasses have tuples.
        task_rules = Rules(**_lists_to_tuples(values["rules"]))
        task_detector = Detector(**_lists_to_tuples(values["detector"]))
        return cls(**_lists_to_tuples(values) | {"rules": task_rules, "detector": task_detector})

    @property
    def row_format(self) -> RowFormat:
        """Format of the observation rows."""
        return RowFormat(len(self.categories), has_counts=self.instance_counts)

    def is_goal(self) -> np.ndarray:
        """Return where categories can be goals, bool [K]."""
        return np.array([not self.goals or name in self.goals for name in self.categories])

    def check(self) -> None:
        """Check that scenes can be compiled for this task.

        Raises:
          InputError: a category occurs twice, a goal is no category, or a rate of the detector is no probability.
        """
        for name in self.categories:
            if self.categories.count(name) > 1:
                raise InputError(f"Task.categories: {name!r} occurs more than once; give each category once")
        for name in self.goals:
            if name not in self.categories:
                raise InputError(f"Task.goals: {name!r} is no category; choose from {', '.join(self.categories)}")
        for name in ("miss_near", "miss_far", "false_alarm"):
            rate = getattr(self.detector, name)
            if not 0.0 <= rate <= 1.0:  # also refuses NaN
                raise InputError(f"Task.detector.{name} {rate}: give a probability from 0 to 1")


def _lists_to_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with tuples in place of lists."""
    converted = dict(values)
    for name, field_value in values.items():
        if isinstance(field_value, list):
            converted[name] = tuple(field_value)
    return converted


#: The tasks of AI2-THOR rooms, RoboTHOR apartments and Gibson houses.
ROOMS = Task()
APARTMENTS = Task(
    ROBOTHOR_CATEGORIES,
    ROBOTHOR_GOALS,
    Rules(headings=12, field_of_view=(79.0, 63.5), front_cell="move", success_distance=1.0),
)
HOUSES = Task(
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    Rules(
        headings=12,
        horizons=(0.0,),
        field_of_view=(79.0, 63.5),
        camera=0.88,
        front_cell="move",
        success="near",
        success_distance=1.0,
    ),
)
