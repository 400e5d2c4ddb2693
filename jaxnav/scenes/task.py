"""What is asked of an agent: what it may look for, how it moves and sees, and when it has found it."""

import dataclasses
from typing import Literal

import numpy as np

from jaxnav.scenes.categories import (
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    ITHOR_CATEGORIES,
    ROBOTHOR_CATEGORIES,
    ROBOTHOR_GOALS,
)
from jaxnav.scenes.tables.detector import Detector

NUM_ACTIONS = 6
MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(NUM_ACTIONS)

#: (dz, dx) of the eight neighbouring cells, clockwise from +z.
NEIGHBOURS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])


@dataclasses.dataclass(frozen=True)
class Rules:
    """How an agent moves and sees, and when Done is a success.

    Attributes:
      headings: H; heading h looks 360 h / H degrees clockwise from +z.
      horizons: degrees downwards, the first of which every episode starts with.
      field_of_view: horizontal and vertical, degrees.
      camera: height above the floor, metres.
      success: `seen`, a visible goal object whose centre is near enough horizontally; or `near`, a goal object whose
        footprint is near enough to walk to.
      success_distance: how near that is, metres.
    """

    headings: int = 8
    horizons: tuple[float, ...] = (0.0, 30.0)
    field_of_view: tuple[float, float] = (100.0, 100.0)
    camera: float = 1.5
    success: Literal["seen", "near"] = "seen"
    success_distance: float = 1.5

    @property
    def poses_per_cell(self) -> int:
        """Poses of one cell; pose = (cell * headings + heading) * horizons + horizon."""
        return self.headings * len(self.horizons)

    @property
    def half_view(self) -> tuple[float, float]:
        """Tangents of half the field of view, horizontal and vertical."""
        across, up = np.tan(np.deg2rad(self.field_of_view) / 2)
        return float(across), float(up)

    def directions(self) -> np.ndarray:
        """Unit vectors (x, z) of the headings, float64 [H, 2]; rounded so that equal lengths are equal numbers."""
        angles = np.deg2rad(360.0 / self.headings * np.arange(self.headings))
        return np.round(np.stack([np.sin(angles), np.cos(angles)], axis=-1), 12)

    def view_offsets(self, view: int) -> np.ndarray:
        """(dz, dx) from the agent of the cells of the ego-centric view, `view` V cells a side: int [H, V, V, 2]."""
        ahead, side = np.arange(view), np.arange(view) - view // 2
        forward = self.directions()[:, None, None, ::-1]  # [H, 1, 1, (z, x)]
        rightward = np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
        return np.rint(forward * ahead[:, None, None] + rightward * side[:, None]).astype(int)

    def steps(self) -> np.ndarray:
        """(dz, dx) of MoveAhead for each heading, to the neighbouring cell in the nearest direction: int [H, 2]."""
        return NEIGHBOURS[np.rint(8 / self.headings * np.arange(self.headings)).astype(int) % 8]


@dataclasses.dataclass(frozen=True)
class Task:
    """What is asked of an agent; hashable.

    Attributes:
      categories: [K] what can be detected.
      goals: what can be looked for, some of `categories`; () for all.
      rules: of moving, seeing and success.
      detector: error rates.
    """

    categories: tuple[str, ...] = ITHOR_CATEGORIES
    goals: tuple[str, ...] = ()
    rules: Rules = Rules()
    detector: Detector = Detector()

    def is_goal(self) -> np.ndarray:
        """Which categories can be looked for, bool [K]."""
        return np.array([not self.goals or name in self.goals for name in self.categories])


#: What is asked in AI2-THOR rooms, in RoboTHOR apartments and in Gibson houses.
ROOMS = Task()
APARTMENTS = Task(
    ROBOTHOR_CATEGORIES, ROBOTHOR_GOALS, Rules(headings=12, field_of_view=(79.0, 63.5), success_distance=1.0)
)
HOUSES = Task(
    GIBSON_CATEGORIES,
    GIBSON_GOALS,
    Rules(headings=12, horizons=(0.0,), field_of_view=(79.0, 63.5), camera=0.88, success="near", success_distance=1.0),
)
