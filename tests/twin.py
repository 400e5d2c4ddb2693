"""One ObjectNav episode in plain Python, written from docs/environment.md alone.

It shares no arithmetic with the compiled environment: lines of sight are tested object by object with the separating
axis theorem, and the best length is found by breadth-first search over poses.
"""

import math
from collections import deque
from collections.abc import Sequence

from jaxnav.scenes.categories import ALIASES
from jaxnav.scenes.scene import Scene

Cell = tuple[int, int]  # iz, ix
Pose = tuple[int, int, int, int]  # iz, ix, heading, horizon

MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(6)
CAMERA_HEIGHT = 1.5
SHRINK = TOLERANCE = 1e-6
#: (dz, dx) of the neighbouring cell in the direction of each heading.
NEIGHBOURS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))


def meets(start: Sequence[float], end: Sequence[float], centre: Sequence[float], half: Sequence[float]) -> bool:
    """Whether a segment meets the inside of a box of half sides `half`, in two or three dimensions.

    It does unless one of the candidate axes separates the two: those of the box, and their cross products with the
    segment, one for each pair of coordinates.
    """
    middle = [(a + b) / 2 - c for a, b, c in zip(start, end, centre, strict=True)]
    along = [(b - a) / 2 for a, b in zip(start, end, strict=True)]
    for i in range(len(half)):
        if abs(middle[i]) >= half[i] + abs(along[i]):
            return False
        for j in range(i):
            radius = half[i] * abs(along[j]) + half[j] * abs(along[i])
            # A radius of 0 belongs to no axis at all: the segment is parallel to the third one.
            if 0 < radius <= abs(middle[i] * along[j] - middle[j] * along[i]):
                return False
    return True


def contains(point: Sequence[float], centre: Sequence[float], half: Sequence[float]) -> bool:
    return all(abs(p - c) <= h + TOLERANCE for p, c, h in zip(point, centre, half, strict=True))


def largest_component(reach: set[Cell]) -> set[Cell]:
    best: set[Cell] = set()
    left = set(reach)
    for seed in sorted(reach):  # row order
        if seed not in left:
            continue
        left.remove(seed)
        part, queue = {seed}, [seed]
        while queue:
            iz, ix = queue.pop()
            for dz, dx in NEIGHBOURS:
                cell = (iz + dz, ix + dx)
                if cell in left:
                    left.remove(cell)
                    part.add(cell)
                    queue.append(cell)
        if len(part) > len(best):
            best = part
    return best


class Box:
    """An object: its centre, half sides and what follows from its size."""

    def __init__(self, values: Sequence[float], category: int | None):
        x, y, z, sx, sy, sz = (float(value) for value in values)
        self.centre = (x, y, z)
        self.half = (sx / 2, sy / 2, sz / 2)
        self.category = category
        limits = (sx - 0.3, sz - 0.3, 0.3 - (y - sy / 2), y + sy / 2 - 0.85)
        self.opaque = min(limits) >= -1e-9
        sides = sorted((sx, sy, sz))
        self.size = math.sqrt(sides[1] * sides[2])
        self.range = min(max(self.size / 0.12, 1.5), 5.0)


class Twin:
    """One episode; `reset` starts another one in the same scene and keeps the lines of sight found so far."""

    def __init__(
        self,
        scene: Scene,
        categories: tuple[str, ...],
        goal: int,
        cell: Cell,
        heading: int,
        horizon: int,
        step_limit: int,
    ):
        self.categories = categories
        self.origin = (float(scene.origin[0]), float(scene.origin[1]))
        cells = [(iz, ix) for iz in range(scene.reach.shape[0]) for ix in range(scene.reach.shape[1])]
        self.walls = {cell for cell in cells if scene.walls[cell]}
        self._standable = largest_component({cell for cell in cells if scene.reach[cell]})
        self.boxes = []
        for name, values in zip(scene.types, scene.boxes, strict=True):
            name = ALIASES.get(name, name)
            self.boxes.append(Box(values, categories.index(name) if name in categories else None))
        self._seen_from: dict[Cell, list[tuple[Box, float]]] = {}
        self.reset(goal, cell, heading, horizon, step_limit)

    def reset(self, goal: int, cell: Cell, heading: int, horizon: int, step_limit: int) -> None:
        if cell not in self._standable:
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
        return self._standable

    def step(self, action: int) -> tuple[float, bool, bool]:
        """Returns the reward, `terminated` and `truncated`."""
        if self.over:
            raise RuntimeError("the episode is over")
        self.steps += 1
        terminated = action == DONE
        truncated = self.steps >= self.step_limit and not terminated
        self.over = terminated or truncated
        reward = 5.0 if terminated and self.goal in self.found() else -0.01
        self.pose = self._moved(self.pose, action)
        return reward, terminated, truncated

    def _moved(self, pose: Pose, action: int) -> Pose:
        iz, ix, heading, horizon = pose
        if action == MOVE_AHEAD:
            dz, dx = NEIGHBOURS[heading]
            return (iz + dz, ix + dx, heading, horizon) if (iz + dz, ix + dx) in self._standable else pose
        if action in (ROTATE_LEFT, ROTATE_RIGHT):
            return iz, ix, (heading + (1 if action == ROTATE_RIGHT else -1)) % 8, horizon
        if action in (LOOK_UP, LOOK_DOWN):
            return iz, ix, heading, int(action == LOOK_DOWN)
        return pose

    def _position(self, cell: Cell) -> tuple[float, float]:
        return self.origin[0] + 0.25 * cell[1], self.origin[1] + 0.25 * cell[0]

    def _distance(self, cell: Cell, box: Box) -> float:
        return math.dist(self._position(cell), (box.centre[0], box.centre[2]))

    def _clear(self, cell: Cell, target: Box) -> bool:
        """Whether the line of sight from the camera over `cell` to the centre of `target` is clear."""
        x, z = self._position(cell)
        camera, goal = (x, CAMERA_HEIGHT, z), target.centre
        length = math.dist(camera, goal)
        if length < 0.3:
            return True
        part = (length - 0.3) / length
        end = tuple(c + part * (g - c) for c, g in zip(camera, goal, strict=True))
        for box in self.boxes:
            exempt = (
                box is target
                or contains(goal, box.centre, box.half)
                or contains((x, z), box.centre[::2], box.half[::2])
            )
            if box.opaque and not exempt and meets(camera, end, box.centre, [h - SHRINK for h in box.half]):
                return False
        # A wall cell blocks at every height, so it is tested in the plane; only those around the line can meet it.
        rows, columns = (
            range(round((min(a, b) - o) / 0.25) - 1, round((max(a, b) - o) / 0.25) + 2)
            for a, b, o in ((z, end[2], self.origin[1]), (x, end[0], self.origin[0]))
        )
        for wall in ((iz, ix) for iz in rows for ix in columns if (iz, ix) in self.walls):
            centre = self._position(wall)
            exempt = any(contains(point, centre, (0.125, 0.125)) for point in (goal[::2], (x, z)))
            if not exempt and meets((x, z), end[::2], centre, (0.125 - SHRINK, 0.125 - SHRINK)):
                return False
        return True

    def _detectable(self, cell: Cell) -> list[tuple[Box, float]]:
        """Objects of a category with a clear line of sight from `cell` and within their range, and their distances."""
        if cell not in self._seen_from:
            near = [(box, self._distance(cell, box)) for box in self.boxes if box.category is not None]
            self._seen_from[cell] = [
                (box, distance) for box, distance in near if distance <= box.range + 1e-9 and self._clear(cell, box)
            ]
        return self._seen_from[cell]

    def _offsets(self, pose: Pose, box: Box) -> tuple[float, float, bool]:
        """Offsets ahead and to the right of the centre of `box`, and whether it is in view."""
        x, z = self._position(pose[:2])
        vx, up, vz = box.centre[0] - x, box.centre[1] - CAMERA_HEIGHT, box.centre[2] - z
        yaw, pitch = math.radians(45 * pose[2]), math.radians(30 * pose[3])
        fx, fz = math.sin(yaw), math.cos(yaw)
        ahead, right = vx * fx + vz * fz, vx * fz - vz * fx
        depth = ahead * math.cos(pitch) - up * math.sin(pitch)
        rise = ahead * math.sin(pitch) + up * math.cos(pitch)
        limit = math.tan(math.radians(50)) * depth
        return ahead, right, depth > 0 and abs(right) <= limit and abs(rise) <= limit

    def detections(self) -> list[list[tuple[float, float, float]]]:
        """Per category the acceptable (ahead, right, apparent size): none if not detected, several if equally near."""
        rows: list[list[tuple[float, float, float, float]]] = [[] for _ in self.categories]
        for box, distance in self._detectable(self.cell):
            ahead, right, in_view = self._offsets(self.pose, box)
            if in_view and box.category is not None:
                rows[box.category].append((distance, ahead, right, box.size / max(distance, 0.25)))
        return [[row[1:] for row in category if row[0] <= min(category)[0] + 1e-9] for category in rows]

    def found(self) -> set[int]:
        return self._found(self.pose)

    def _found(self, pose: Pose) -> set[int]:
        # No range is below 1.5 m, so every object near enough for success is among the detectable ones.
        return {
            box.category
            for box, distance in self._detectable(pose[:2])
            if box.category is not None and distance <= 1.5 + 1e-9 and self._offsets(pose, box)[2]
        }

    def best_length(self) -> int | None:
        """Number of actions, Done included, of the shortest successful episode from the start, or None."""
        length, queue = {self.start: 1}, deque([self.start])
        while queue:
            pose = queue.popleft()
            if self.goal in self._found(pose):
                return length[pose]
            for action in range(DONE):
                after = self._moved(pose, action)
                if after not in length:
                    length[after] = length[pose] + 1
                    queue.append(after)
        return None

    def goal_distance(self) -> float:
        """DTS at the present cell, in metres."""
        goals = [box for box in self.boxes if box.category == self.goal]
        return max(min(self._distance(self.cell, box) for box in goals) - 1.0, 0.0)
