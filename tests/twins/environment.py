"""An ObjectNav episode in plain Python, from docs/environment.md alone.

The twin shares no arithmetic with the compiled environment; best lengths come from a breadth-first search over poses.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

from support.scenes import BOOK, CATEGORIES, ROOMS, DrawnObject, draw
from twins.scene import Cell, TwinScene, neighbour

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules

Pose = tuple[int, int, int, int]  # iz, ix, heading, horizon

MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(6)


class Twin:
    """One episode; `reset` starts another in the same scene."""

    def __init__(
        self,
        scene: Scene,
        categories: tuple[str, ...],
        rules: Rules,
        goal: int,
        cell: Cell,
        heading: int,
        horizon: int,
        step_limit: int,
    ):
        self.categories = categories
        self.rules = rules
        self.scene = TwinScene(scene, categories, rules)
        self.reset(goal, cell, heading, horizon, step_limit)

    def reset(self, goal: int, cell: Cell, heading: int, horizon: int, step_limit: int) -> None:
        if cell not in self.scene.standable:
            raise ValueError(f"cell {cell} is not standable")
        self.goal = goal
        self.step_limit = step_limit
        self.steps = 0
        self.is_over = False
        self.pose: Pose = (*cell, heading, horizon)
        self.start = self.pose

    @property
    def cell(self) -> Cell:
        return self.pose[:2]

    @property
    def heading(self) -> int:
        return self.pose[2]

    @property
    def horizon(self) -> int:
        return self.pose[3]

    def standable(self) -> set[Cell]:
        return self.scene.standable

    def step(self, action: int) -> tuple[float, bool, bool]:
        """Take an action; return the reward, `terminated` and `truncated`."""
        if self.is_over:
            raise RuntimeError("the episode is over")
        self.steps += 1
        terminated = action == DONE
        truncated = self.steps >= self.step_limit and not terminated
        self.is_over = terminated or truncated
        reward = 5.0 if terminated and self.goal in self.successes() else -0.01
        self.pose = self._next_pose(self.pose, action)
        return reward, terminated, truncated

    def _next_pose(self, pose: Pose, action: int) -> Pose:
        iz, ix, heading, horizon = pose
        if action == MOVE_AHEAD:
            dz, dx = neighbour(self.rules, heading)
            next_cell = (iz + dz, ix + dx)
            return (*next_cell, heading, horizon) if next_cell in self.scene.standable else pose
        if action in (ROTATE_LEFT, ROTATE_RIGHT):
            turn = 1 if action == ROTATE_RIGHT else -1
            return iz, ix, (heading + turn) % self.rules.headings, horizon
        if action in (LOOK_UP, LOOK_DOWN):
            next_horizon = horizon + (1 if action == LOOK_DOWN else -1)
            return iz, ix, heading, min(max(next_horizon, 0), len(self.rules.horizons) - 1)
        return pose

    def detections(self) -> list[list[tuple[float, float, float]]]:
        """Return the acceptable (ahead, right, apparent size) of each category.

        The list is empty for a category that is not detected, and has several entries where instances are equally near.
        """
        detections = []
        for instances in self._instances_in_view():
            min_distance = min((instance[0] for instance in instances), default=math.inf)
            detections.append([instance[1:] for instance in instances if instance[0] <= min_distance + 1e-9])
        return detections

    def instance_counts(self) -> list[int]:
        """Return the number of instances that a detector without errors detects of each category."""
        return [len(instances) for instances in self._instances_in_view()]

    def _instances_in_view(self) -> list[list[tuple[float, float, float, float]]]:
        """Return (distance, ahead, right, apparent size) of the instances in view, by category."""
        instances: list[list[tuple[float, float, float, float]]] = [[] for _ in self.categories]
        for box, distance in self.scene.detectable(self.cell):
            ahead, right, in_view = self.scene.offsets(self.cell, self.heading, self.horizon, box)
            if in_view and box.category is not None:
                apparent_size = box.size / max(distance, 0.25)
                instances[box.category].append((distance, ahead, right, apparent_size))
        return instances

    def view(self) -> list[int]:
        return self.scene.view(self.cell, self.heading)

    def successes(self) -> set[int]:
        """Return the goals with which Done would succeed here."""
        return {goal for goal in range(len(self.categories)) if self._succeeds(self.pose, goal)}

    def _succeeds(self, pose: Pose, goal: int) -> bool:
        iz, ix, heading, horizon = pose
        cell = (iz, ix)
        limit = self.rules.success_distance + 1e-9
        if self.rules.success == "near":
            return self.scene.walk(cell, goal) <= limit
        # No range is below 1.5 m, so every object near enough for success is among the detectable ones.
        return any(
            box.category == goal and distance <= limit and self.scene.offsets(cell, heading, horizon, box)[2]
            for box, distance in self.scene.detectable(cell)
        )

    def best_length(self) -> int | None:
        """Return the least number of actions from the start to success, Done included; None if there is no way."""
        lengths = {self.start: 1}
        queue = deque([self.start])
        while queue:
            pose = queue.popleft()
            if self._succeeds(pose, self.goal):
                return lengths[pose]
            for action in range(DONE):
                next_pose = self._next_pose(pose, action)
                if next_pose not in lengths:
                    lengths[next_pose] = lengths[pose] + 1
                    queue.append(next_pose)
        return None

    def goal_distance(self) -> float:
        """Return the distance to success at this cell, in metres."""
        if self.rules.success == "near":
            return max(self.scene.walk(self.cell, self.goal) - 1.0, 0.0)
        distances = (self.scene.distance(self.cell, box) for box in self.scene.boxes if box.category == self.goal)
        return max(min(distances, default=math.inf) - 1.0, 0.0)


def start_twin(
    scene: Scene,
    goal: int = BOOK,
    cell: Cell = (0, 0),
    heading: int = 0,
    horizon: int = 0,
    step_limit: int = 100,
    rules: Rules = ROOMS,
) -> Twin:
    """Start an episode in a scene with the categories of drawn scenes."""
    return Twin(scene, CATEGORIES, rules, goal, cell, heading, horizon, step_limit)


def start_in_one_cell(*objects: DrawnObject, walls: Iterable[Cell] = (), **start_options: Any) -> Twin:
    """Start an episode in a lattice of 16 x 4 cells, of which only [0, 0] is standable."""
    scene = draw([".###"] + ["####"] * 15, *objects, walls=walls)
    return start_twin(scene, **start_options)


def detected_categories(twin: Twin) -> set[int]:
    """Return the categories of which an instance is detected."""
    return {category for category, detections in enumerate(twin.detections()) if detections}
