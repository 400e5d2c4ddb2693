"""Tasks: categories, goals and the rules of an episode."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from jaxnav.scenes.categories import (
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    ITHOR_CATEGORIES,
    ROBOTHOR_CATEGORIES,
    ROBOTHOR_GOALS,
)
from jaxnav.scenes.tables.detector import Detector

#: Names of the actions, in their order.
ACTIONS = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
NUM_ACTIONS = len(ACTIONS)
MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(NUM_ACTIONS)

#: (dz, dx) of the eight neighbouring cells, clockwise from +z.
NEIGHBOURS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])


@dataclasses.dataclass(frozen=True)
class Rules:
    """Describe motion, view and success.

    Attributes:
      headings: H; heading h looks 360 h / H degrees clockwise from +z.
      horizons: degrees downwards; every episode starts with the first.
      field_of_view: horizontal and vertical, degrees.
      camera: height above the floor, metres.
      success: when Done succeeds: `seen`, a visible goal object whose centre is within the success distance
        horizontally; or `near`, a goal object whose footprint is within the success distance on foot.
      success_distance: metres.
    """

    headings: int = 8
    horizons: tuple[float, ...] = (0.0, 30.0)
    field_of_view: tuple[float, float] = (100.0, 100.0)
    camera: float = 1.5
    success: Literal["seen", "near"] = "seen"
    success_distance: float = 1.5

    @property
    def poses_per_cell(self) -> int:
        """Return the number of poses of one cell.

        pose = (cell * headings + heading) * horizons + horizon, each an index.
        """
        return self.headings * len(self.horizons)

    def split(self, pose: Any) -> tuple[Any, Any, Any]:
        """Return cell, heading and horizon of poses.

        Each is an index, of the type and the shape of `pose`: an int or an array of ints.
        """
        horizons = len(self.horizons)
        return pose // self.poses_per_cell, pose // horizons % self.headings, pose % horizons

    @property
    def half_view(self) -> tuple[float, float]:
        """Return the tangents of half the field of view.

        Horizontal, then vertical.
        """
        across, up = np.tan(np.deg2rad(self.field_of_view) / 2)
        return float(across), float(up)

    def directions(self) -> np.ndarray:
        """Return the unit vectors of the headings.

        They are float64 [H, 2], (x, z), rounded so that equal lengths are equal numbers.
        """
        angles = np.deg2rad(360.0 / self.headings * np.arange(self.headings))
        return np.round(np.stack([np.sin(angles), np.cos(angles)], axis=-1), 12)

    def view_offsets(self, view: int) -> np.ndarray:
        """Return the cells of the ego-centric view.

        Args:
          view: V, cells along each side of the view.

        Returns:
          int [H, V, V, 2], (dz, dx) from the agent's cell, by heading; row 0 nearest to the agent, column 0 leftmost.
        """
        return self.turned_offsets(np.arange(view), np.arange(view) - view // 2)

    def turned_offsets(self, ahead: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return cells ahead and to the right of the agent.

        Args:
          ahead: int [A], cells.
          right: int [B], cells.

        Returns:
          int [H, A, B, 2], (dz, dx) from the agent's cell, by heading.
        """
        forward = self.directions()[:, None, None, ::-1]  # [H, 1, 1, (z, x)]
        rightward = np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
        return np.rint(forward * ahead[:, None, None] + rightward * right[:, None]).astype(int)

    def steps(self) -> np.ndarray:
        """Return the displacement of MoveAhead for each heading.

        It is int [H, 2], (dz, dx), and leads to the neighbouring cell in the nearest direction.
        """
        return NEIGHBOURS[np.rint(8 / self.headings * np.arange(self.headings)).astype(int) % 8]


@dataclasses.dataclass(frozen=True)
class Task:
    """Describe what an agent is asked to do; hashable.

    Attributes:
      categories: [K] names of what can be detected.
      goals: names of what can be searched for, some of `categories`; () for all.
      rules: of motion, view and success.
      detector: its error rates.
    """

    categories: tuple[str, ...] = ITHOR_CATEGORIES
    goals: tuple[str, ...] = ()
    rules: Rules = Rules()
    detector: Detector = Detector()

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Task":
        """Make the task of which JSON holds the fields."""
        rules, detector = _tupled(values["rules"]), _tupled(values["detector"])
        return cls(**_tupled(values) | {"rules": Rules(**rules), "detector": Detector(**detector)})

    def is_goal(self) -> np.ndarray:
        """Return which categories can be goals, bool [K]."""
        return np.array([not self.goals or name in self.goals for name in self.categories])


def _tupled(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with tuples for lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


#: The tasks of AI2-THOR rooms, RoboTHOR apartments and Gibson houses.
ROOMS = Task()
APARTMENTS = Task(
    ROBOTHOR_CATEGORIES, ROBOTHOR_GOALS, Rules(headings=12, field_of_view=(79.0, 63.5), success_distance=1.0)
)
HOUSES = Task(
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    Rules(headings=12, horizons=(0.0,), field_of_view=(79.0, 63.5), camera=0.88, success="near", success_distance=1.0),
)
