"""A scene in plain Python, from docs/environment.md alone.

The twin shares no arithmetic with the compiled tables: lines of sight are tested object by object with the separating
axis theorem, and walks come from Dijkstra's algorithm.
"""

import functools
import heapq
import itertools
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

from twins.shapes import SHRINK, Box, contains, meets

from jaxnav.scenes.categories import ALIASES
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules

Cell = tuple[int, int]  # iz, ix

NEIGHBOURS = tuple((dz, dx) for dz in (-1, 0, 1) for dx in (-1, 0, 1) if (dz, dx) != (0, 0))
UNKNOWN, STANDABLE, NOT_STANDABLE = range(3)
VIEW = 11


def largest_component(reach: set[Cell]) -> set[Cell]:
    """Return the largest connected part of cells, and the first in row order among parts of equal size."""
    largest: set[Cell] = set()
    unvisited = set(reach)
    for seed in sorted(reach):  # row order
        if seed not in unvisited:
            continue

        # Collect the cells that are connected with the seed.
        unvisited.remove(seed)
        component = {seed}
        queue = [seed]
        while queue:
            iz, ix = queue.pop()
            for dz, dx in NEIGHBOURS:
                cell = (iz + dz, ix + dx)
                if cell in unvisited:
                    unvisited.remove(cell)
                    component.add(cell)
                    queue.append(cell)

        if len(component) > len(largest):
            largest = component
    return largest


def degrees(rules: Rules, heading: int) -> float:
    return 360 * heading / rules.headings


@functools.cache
def neighbour(rules: Rules, heading: int) -> Cell:
    """Return (dz, dx) of the neighbour in a heading's direction."""

    def angle_to_heading(step: Cell) -> float:
        step_angle = math.degrees(math.atan2(step[1], step[0]))
        return abs((step_angle - degrees(rules, heading) + 180) % 360 - 180)

    return min(NEIGHBOURS, key=angle_to_heading)


@functools.cache
def view_lines(rules: Rules, heading: int) -> list[tuple[Cell, set[Cell]] | None]:
    """Return the offset (dz, dx) of each view cell and the offsets on the line to it; None outside the cone."""
    yaw = math.radians(degrees(rules, heading))
    half_width = math.tan(math.radians(rules.field_of_view[0] / 2))
    view: list[tuple[Cell, set[Cell]] | None] = []
    for ahead in range(VIEW):
        for right in range(-(VIEW // 2), VIEW // 2 + 1):
            if abs(right) > half_width * ahead:
                view.append(None)
                continue

            # Round twice, because 2.4999999999999996 counts as a half.
            dz = round(round(ahead * math.cos(yaw) - right * math.sin(yaw), 9))
            dx = round(round(ahead * math.sin(yaw) + right * math.cos(yaw), 9))
            # The cell in front is the one to which MoveAhead leads.
            if (ahead, right) == (1, 0) and rules.front_cell == "move":
                dz, dx = neighbour(rules, heading)

            # Sample the line to the cell at 21 inner points, without the cells at its ends.
            line_offsets = {(round(Fraction(dz * k, 22)), round(Fraction(dx * k, 22))) for k in range(1, 22)}
            view.append(((dz, dx), line_offsets - {(0, 0), (dz, dx)}))
    return view


class TwinScene:
    """A scene under some rules, with computed distances and detections."""

    def __init__(self, scene: Scene, categories: tuple[str, ...], rules: Rules):
        self.rules = rules
        self.origin = (float(scene.origin[0]), float(scene.origin[1]))
        self.lattice = {(iz, ix) for iz in range(scene.reach.shape[0]) for ix in range(scene.reach.shape[1])}
        self.walls = {cell for cell in self.lattice if scene.walls[cell]}
        self.standable = largest_component({cell for cell in self.lattice if scene.reach[cell]})

        # Objects, with the category of their type or of its alias.
        self.boxes = []
        for object_type, values in zip(scene.types, scene.boxes, strict=True):
            name = object_type if object_type in categories else ALIASES.get(object_type, object_type)
            category = categories.index(name) if name in categories else None
            self.boxes.append(Box(values, category))

        #: Cells that hide the floor behind them: walls, and cells under boxes as high as the camera.
        self.hiding_cells = set(self.walls)
        tall_boxes = [box for box in self.boxes if box.opaque and box.top >= self.rules.camera - 1e-9]
        for cell in self.lattice:
            position = self.position(cell)
            if any(contains(position, box.centre[::2], box.half[::2], 1e-9) for box in tall_boxes):
                self.hiding_cells.add(cell)

        # Results by cell and by category, computed at their first use.
        self._detectable: dict[Cell, list[tuple[Box, float]]] = {}
        self._walks: dict[int, dict[Cell, float]] = {}

    def position(self, cell: Cell) -> tuple[float, float]:
        return self.origin[0] + 0.25 * cell[1], self.origin[1] + 0.25 * cell[0]

    def distance(self, cell: Cell, box: Box) -> float:
        return math.dist(self.position(cell), (box.centre[0], box.centre[2]))

    def detectable(self, cell: Cell) -> list[tuple[Box, float]]:
        """Return the objects that can be detected from a cell, with their distances.

        Such objects have a category, a clear line of sight and a distance within their range.
        """
        if cell in self._detectable:
            return self._detectable[cell]

        detectable = []
        for box in self.boxes:
            distance = self.distance(cell, box)
            if box.category is not None and distance <= box.range + 1e-9 and self._is_clear(cell, box):
                detectable.append((box, distance))
        self._detectable[cell] = detectable
        return detectable

    def _is_clear(self, cell: Cell, target: Box) -> bool:
        """Check that the camera over a cell has a clear line of sight to a box."""
        x, z = self.position(cell)
        camera = (x, self.rules.camera, z)
        target_centre = target.centre

        # The line of sight ends 0.3 m before the target.
        length = math.dist(camera, target_centre)
        if length < 0.3:
            return True
        share = (length - 0.3) / length
        end = tuple(c + share * (t - c) for c, t in zip(camera, target_centre, strict=True))

        # Opaque boxes block, except the target itself and boxes around the target's centre or the camera.
        for box in self.boxes:
            is_exempt = (
                box is target
                or contains(target_centre, box.centre, box.half)
                or contains((x, z), box.centre[::2], box.half[::2])
            )
            if box.opaque and not is_exempt and meets(camera, end, box.centre, [h - SHRINK for h in box.half]):
                return False

        # Wall cells block at every height.
        return not self._meets_wall((x, z), end[::2], target_centre[::2])

    def _meets_wall(self, start: Sequence[float], end: Sequence[float], target: Sequence[float]) -> bool:
        """Check whether a segment in the plane meets walls.

        Wall cells that contain the start of the segment or the target do not count.
        """
        # Only the cells around the segment can meet it.
        ranges = []
        for a, b, origin in zip(start, end, self.origin, strict=True):
            first = round((min(a, b) - origin) / 0.25) - 1
            last = round((max(a, b) - origin) / 0.25) + 1
            ranges.append(range(first, last + 1))
        columns, rows = ranges

        for wall in itertools.product(rows, columns):
            if wall not in self.walls:
                continue
            centre = self.position(wall)
            is_exempt = any(contains(point, centre, (0.125, 0.125)) for point in (start, target))
            if not is_exempt and meets(start, end, centre, (0.125 - SHRINK, 0.125 - SHRINK)):
                return True
        return False

    def offsets(self, cell: Cell, heading: int, horizon: int, box: Box) -> tuple[float, float, bool]:
        """Return metres ahead and right of a box, and whether the camera's frustum holds its centre."""
        # Offset from the camera to the box, in the world's axes.
        x, z = self.position(cell)
        offset_x = box.centre[0] - x
        up = box.centre[1] - self.rules.camera
        offset_z = box.centre[2] - z

        # Turn the offset by the heading, then tilt it by the horizon.
        yaw = math.radians(degrees(self.rules, heading))
        forward_x = math.sin(yaw)
        forward_z = math.cos(yaw)
        ahead = offset_x * forward_x + offset_z * forward_z
        right = offset_x * forward_z - offset_z * forward_x
        pitch = math.radians(self.rules.horizons[horizon])
        depth = ahead * math.cos(pitch) - up * math.sin(pitch)
        rise = ahead * math.sin(pitch) + up * math.cos(pitch)

        # The frustum at this depth.
        half_width, half_height = (math.tan(math.radians(angle / 2)) * depth for angle in self.rules.field_of_view)
        is_in_view = depth > 0 and abs(right) <= half_width and abs(rise) <= half_height
        return ahead, right, is_in_view

    def walk(self, cell: Cell, category: int) -> float:
        """Return the metres to walk to a category's nearest object, infinite if there is no way."""
        if category not in self._walks:
            self._walks[category] = self._walks_to(category)
        return self._walks[category].get(cell, math.inf)

    def _walks_to(self, category: int) -> dict[Cell, float]:
        """Return the metres from every cell to a category, by Dijkstra's algorithm that starts at the objects."""
        queue = []
        for box in self.boxes:
            if box.category == category:
                queue.extend(self._last_parts(box))
        heapq.heapify(queue)

        walks = {}
        while queue:
            length, (iz, ix) = heapq.heappop(queue)
            if (iz, ix) in walks:
                continue
            walks[iz, ix] = length
            for dz, dx in NEIGHBOURS:
                neighbour_cell = (iz + dz, ix + dx)
                if neighbour_cell in self.standable:
                    heapq.heappush(queue, (length + 0.25 * math.hypot(dz, dx), neighbour_cell))
        return walks

    def _last_parts(self, box: Box) -> Iterator[tuple[float, Cell]]:
        """Yield length and first cell of the straight last parts of walks to a box."""
        for cell in self.standable:
            start = self.position(cell)
            end = box.nearest(*start)
            length = math.dist(start, end)
            if length <= 1 + 1e-9 and not self._meets_wall(start, end, box.centre[::2]):
                yield length, cell

    def view(self, cell: Cell, heading: int) -> list[int]:
        """Return the ego-centric view, near edge and left first."""
        iz, ix = cell
        view = []
        for line in view_lines(self.rules, heading):
            if line is None:
                view.append(UNKNOWN)
                continue
            (dz, dx), line_offsets = line
            if any((iz + line_dz, ix + line_dx) in self.hiding_cells for line_dz, line_dx in line_offsets):
                view.append(UNKNOWN)
            elif (iz + dz, ix + dx) in self.standable:
                view.append(STANDABLE)
            else:
                view.append(NOT_STANDABLE)
        return view
