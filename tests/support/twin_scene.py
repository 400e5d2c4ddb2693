"""A scene in plain Python, from docs/environment.md alone.

It shares no arithmetic with the compiled tables: lines of sight are tested object by object with the separating axis
theorem, and walks are those of Dijkstra's algorithm.
"""

import functools
import heapq
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

from jaxnav.scenes.categories import ALIASES
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules
from support.twin_shapes import SHRINK, Box, contains, meets

Cell = tuple[int, int]  # iz, ix

NEIGHBOURS = tuple((dz, dx) for dz in (-1, 0, 1) for dx in (-1, 0, 1) if (dz, dx) != (0, 0))
UNKNOWN, STANDABLE, NOT_STANDABLE = range(3)
VIEW = 11


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


def degrees(rules: Rules, heading: int) -> float:
    return 360 * heading / rules.headings


@functools.cache
def neighbour(rules: Rules, heading: int) -> Cell:
    """Return (dz, dx) of the neighbour in a heading's direction."""

    def turn(step: Cell) -> float:
        return abs((math.degrees(math.atan2(step[1], step[0])) - degrees(rules, heading) + 180) % 360 - 180)

    return min(NEIGHBOURS, key=turn)


@functools.cache
def view_lines(rules: Rules, heading: int) -> list[tuple[Cell, set[Cell]] | None]:
    """Return the place (dz, dx) of each view cell.

    With it come the places that the line to it passes. Both are None outside the cone.
    """
    yaw = math.radians(degrees(rules, heading))
    view: list[tuple[Cell, set[Cell]] | None] = []
    for ahead in range(VIEW):
        for right in range(-(VIEW // 2), VIEW // 2 + 1):
            if abs(right) > math.tan(math.radians(rules.field_of_view[0] / 2)) * ahead:
                view.append(None)
                continue
            place = (
                ahead * math.cos(yaw) - right * math.sin(yaw),
                ahead * math.sin(yaw) + right * math.cos(yaw),
            )
            dz, dx = (round(round(value, 9)) for value in place)  # 2.4999999999999996 is a half, too
            passed = {(round(Fraction(dz * k, 22)), round(Fraction(dx * k, 22))) for k in range(1, 22)}
            view.append(((dz, dx), passed - {(0, 0), (dz, dx)}))
    return view


class TwinScene:
    """Hold a scene under some rules, with what was computed."""

    def __init__(self, scene: Scene, categories: tuple[str, ...], rules: Rules):
        self.rules = rules
        self.origin = (float(scene.origin[0]), float(scene.origin[1]))
        self.lattice = {(iz, ix) for iz in range(scene.reach.shape[0]) for ix in range(scene.reach.shape[1])}
        self.walls = {cell for cell in self.lattice if scene.walls[cell]}
        self.standable = largest_component({cell for cell in self.lattice if scene.reach[cell]})
        self.boxes = []
        for name, values in zip(scene.types, scene.boxes, strict=True):
            name = name if name in categories else ALIASES.get(name, name)
            self.boxes.append(Box(values, categories.index(name) if name in categories else None))
        tall = [box for box in self.boxes if box.opaque and box.top >= self.rules.camera - 1e-9]
        #: Cells that hide the floor behind them: walls, and those under what is as high as the camera.
        self.hiding = self.walls | {
            cell
            for cell in self.lattice
            if any(contains(self.position(cell), box.centre[::2], box.half[::2], 1e-9) for box in tall)
        }
        self._detectable: dict[Cell, list[tuple[Box, float]]] = {}
        self._walks: dict[int, dict[Cell, float]] = {}

    def position(self, cell: Cell) -> tuple[float, float]:
        return self.origin[0] + 0.25 * cell[1], self.origin[1] + 0.25 * cell[0]

    def distance(self, cell: Cell, box: Box) -> float:
        return math.dist(self.position(cell), (box.centre[0], box.centre[2]))

    def detectable(self, cell: Cell) -> list[tuple[Box, float]]:
        """Return the objects detected from a cell, and their distances.

        They have a category and a clear line of sight, and are within their range.
        """
        if cell not in self._detectable:
            near = [(box, self.distance(cell, box)) for box in self.boxes if box.category is not None]
            self._detectable[cell] = [
                (box, distance) for box, distance in near if distance <= box.range + 1e-9 and self._clear(cell, box)
            ]
        return self._detectable[cell]

    def _clear(self, cell: Cell, target: Box) -> bool:
        """Check that the camera over a cell sees a box."""
        x, z = self.position(cell)
        camera, goal = (x, self.rules.camera, z), target.centre
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
        return not self._walled((x, z), end[::2], goal[::2])  # a wall cell blocks at every height

    def _walled(self, start: Sequence[float], end: Sequence[float], target: Sequence[float]) -> bool:
        """Check whether a segment in the plane meets walls.

        Those that contain its start or the target do not count.
        """
        # Only the cells around the segment can meet it.
        columns, rows = (
            range(round((min(a, b) - o) / 0.25) - 1, round((max(a, b) - o) / 0.25) + 2)
            for a, b, o in zip(start, end, self.origin, strict=True)
        )
        for wall in ((iz, ix) for iz in rows for ix in columns if (iz, ix) in self.walls):
            centre = self.position(wall)
            exempt = any(contains(point, centre, (0.125, 0.125)) for point in (start, target))
            if not exempt and meets(start, end, centre, (0.125 - SHRINK, 0.125 - SHRINK)):
                return True
        return False

    def offsets(self, cell: Cell, heading: int, horizon: int, box: Box) -> tuple[float, float, bool]:
        """Return metres ahead and right of a box, and visibility."""
        x, z = self.position(cell)
        vx, up, vz = box.centre[0] - x, box.centre[1] - self.rules.camera, box.centre[2] - z
        yaw, pitch = math.radians(degrees(self.rules, heading)), math.radians(self.rules.horizons[horizon])
        fx, fz = math.sin(yaw), math.cos(yaw)
        ahead, right = vx * fx + vz * fz, vx * fz - vz * fx
        depth = ahead * math.cos(pitch) - up * math.sin(pitch)
        rise = ahead * math.sin(pitch) + up * math.cos(pitch)
        across, high = (math.tan(math.radians(angle / 2)) * depth for angle in self.rules.field_of_view)
        return ahead, right, depth > 0 and abs(right) <= across and abs(rise) <= high

    def walk(self, cell: Cell, category: int) -> float:
        """Return the metres to walk to a category's nearest object.

        They are infinite if there is no way.
        """
        if category not in self._walks:
            queue = [way for box in self.boxes if box.category == category for way in self._straight(box)]
            heapq.heapify(queue)
            walks = self._walks[category] = {}
            while queue:
                length, (iz, ix) = heapq.heappop(queue)
                if (iz, ix) in walks:
                    continue
                walks[iz, ix] = length
                for dz, dx in NEIGHBOURS:
                    if (iz + dz, ix + dx) in self.standable:
                        heapq.heappush(queue, (length + 0.25 * math.hypot(dz, dx), (iz + dz, ix + dx)))
        return self._walks[category].get(cell, math.inf)

    def _straight(self, box: Box) -> Iterator[tuple[float, Cell]]:
        """Yield length and first cell of walks' last parts."""
        for cell in self.standable:
            here = self.position(cell)
            end = box.nearest(*here)
            length = math.dist(here, end)
            if length <= 1 + 1e-9 and not self._walled(here, end, box.centre[::2]):
                yield length, cell

    def view(self, cell: Cell, heading: int) -> list[int]:
        """Return the ego-centric view, near edge and left first."""
        iz, ix = cell
        view = []
        for look in view_lines(self.rules, heading):
            if look is None or any((iz + dz, ix + dx) in self.hiding for dz, dx in look[1]):
                view.append(UNKNOWN)
            else:
                there = iz + look[0][0], ix + look[0][1]
                view.append(STANDABLE if there in self.standable else NOT_STANDABLE)
        return view
