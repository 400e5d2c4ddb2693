"""An ObjectNav episode in plain Python, from docs/environment.md alone.

It shares no arithmetic with the compiled environment; the best length is that of a breadth-first search over poses.
"""

import math
from collections import deque

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules
from support.twin_scene import Cell, TwinScene, neighbour

Pose = tuple[int, int, int, int]  # iz, ix, heading, horizon

MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(6)


class Twin:
    """Hold one episode; `reset` starts another in the same scene."""

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
        self.categories, self.rules = categories, rules
        self.scene = TwinScene(scene, categories, rules)
        self.reset(goal, cell, heading, horizon, step_limit)

    def reset(self, goal: int, cell: Cell, heading: int, horizon: int, step_limit: int) -> None:
        if cell not in self.scene.standable:
            raise ValueError(f"cell {cell} is not standable")
        self.goal, self.step_limit, self.steps, self.over = goal, step_limit, 0, False
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
        if self.over:
            raise RuntimeError("the episode is over")
        self.steps += 1
        terminated = action == DONE
        truncated = self.steps >= self.step_limit and not terminated
        self.over = terminated or truncated
        reward = 5.0 if terminated and self.goal in self.successes() else -0.01
        self.pose = self._moved(self.pose, action)
        return reward, terminated, truncated

    def _moved(self, pose: Pose, action: int) -> Pose:
        iz, ix, heading, horizon = pose
        if action == MOVE_AHEAD:
            dz, dx = neighbour(self.rules, heading)
            return (iz + dz, ix + dx, heading, horizon) if (iz + dz, ix + dx) in self.scene.standable else pose
        if action in (ROTATE_LEFT, ROTATE_RIGHT):
            return iz, ix, (heading + (1 if action == ROTATE_RIGHT else -1)) % self.rules.headings, horizon
        if action in (LOOK_UP, LOOK_DOWN):
            looked = horizon + (1 if action == LOOK_DOWN else -1)
            return iz, ix, heading, looked if 0 <= looked < len(self.rules.horizons) else horizon
        return pose

    def detections(self) -> list[list[tuple[float, float, float]]]:
        """Return the acceptable (ahead, right, apparent size) of each category.

        There are none if it is not detected, several if instances are equally near.
        """
        rows: list[list[tuple[float, float, float, float]]] = [[] for _ in self.categories]
        for box, distance in self.scene.detectable(self.cell):
            ahead, right, in_view = self.scene.offsets(self.cell, self.heading, self.horizon, box)
            if in_view and box.category is not None:
                rows[box.category].append((distance, ahead, right, box.size / max(distance, 0.25)))
        return [[row[1:] for row in category if row[0] <= min(category)[0] + 1e-9] for category in rows]

    def view(self) -> list[int]:
        return self.scene.view(self.cell, self.heading)

    def successes(self) -> set[int]:
        """Return the goals with which Done would succeed here."""
        return {goal for goal in range(len(self.categories)) if self._succeeds(self.pose, goal)}

    def _succeeds(self, pose: Pose, goal: int) -> bool:
        cell, heading, horizon = pose[:2], *pose[2:]
        limit = self.rules.success_distance + 1e-9
        if self.rules.success == "near":
            return self.scene.walk(cell, goal) <= limit
        # No range is below 1.5 m, so every object near enough for success is among the detectable ones.
        return any(
            box.category == goal and distance <= limit and self.scene.offsets(cell, heading, horizon, box)[2]
            for box, distance in self.scene.detectable(cell)
        )

    def best_length(self) -> int | None:
        """Return the least actions from the start to success.

        Done is included.
        """
        length, queue = {self.start: 1}, deque([self.start])
        while queue:
            pose = queue.popleft()
            if self._succeeds(pose, self.goal):
                return length[pose]
            for action in range(DONE):
                after = self._moved(pose, action)
                if after not in length:
                    length[after] = length[pose] + 1
                    queue.append(after)
        return None

    def goal_distance(self) -> float:
        """Return the distance to success at this cell, in metres."""
        if self.rules.success == "near":
            return max(self.scene.walk(self.cell, self.goal) - 1.0, 0.0)
        distances = (self.scene.distance(self.cell, box) for box in self.scene.boxes if box.category == self.goal)
        return max(min(distances, default=math.inf) - 1.0, 0.0)
