"""Floor plans of apartments and houses."""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.generate.furnished_room import FORWARD, RIGHT
from jaxnav.scenes.generate.rectangle import Rectangle
from jaxnav.scenes.generate.room_shapes import Shape
from jaxnav.scenes.generate.rooms import away_from_walls
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL

APARTMENT = (17, 37)  # cells of floor within its outer walls, (nz, nx)
APARTMENT_CELLS = (395, 445)  # standable cells without furniture
PASSAGE = 4  # cells between a partition and the outer wall, if they do not touch

ROOM_SIDE = 9  # cells, at least
ROOM_CELLS = (235.0, 0.25)  # median floor of a room in a house, and the spread of its logarithm
CORRIDOR_WIDTHS = (5, 6)  # cells
DOOR_WIDTHS = (4, 6, 8, 8)  # cells; bathrooms have the first
SECOND_DOOR = 0.2  # probability of a door that no room needs
#: Rooms of a house by their number, and how likely each number is.
ROOM_COUNTS = {4: 0.18, 5: 0.24, 6: 0.18, 7: 0.14, 8: 0.16, 10: 0.1}
BATHROOMS = {4: 1, 5: 1, 6: 2, 7: 2, 8: 2, 10: 3}
LIVING_ROOMS = {4: 1, 5: 1, 6: 1, 7: 2, 8: 2, 10: 2}


class FloorPlan(NamedTuple):
    """Hold the walls and rooms of a home.

    Attributes:
      walls: bool [nz, nx], with a ring of walls around.
      rooms: the floors of the rooms.
      types: their room types.
      doors: openings in the walls between rooms.
      partitions: walls that stand in a room.
    """

    walls: np.ndarray
    rooms: tuple[Rectangle, ...]
    types: tuple[str, ...]
    doors: tuple[Rectangle, ...] = ()
    partitions: tuple[Rectangle, ...] = ()


def room_shape(walls: np.ndarray) -> Shape:
    """Return the shape of a rectangular room.

    A partition in the room is a wall with two faces. At a door there is no wall to put anything at.

    Args:
      walls: bool [nz, nx], of the room and of the ring of cells around it; a cell of the ring that is no wall is a
        door.
    """
    floor = ~walls[1:-1, 1:-1]
    nz, nx = floor.shape
    starts, turns, lengths = [], [], []
    for turn, ((x, z), right) in enumerate(zip(FORWARD, RIGHT, strict=True)):
        face = floor & walls[1 - z : 1 - z + nz, 1 - x : 1 - x + nx]  # with a wall right behind
        lines = face if z else face.T
        edges = np.diff(np.pad(lines.astype(int), ((0, 0), (1, 1))), axis=1)
        (line, first), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        along, across = (first if right.sum() > 0 else end), line + (0 if x + z > 0 else 1)
        starts.append(CELL * np.stack([along, across] if z else [across, along], axis=-1))
        turns.append(np.full(len(line), turn))
        lengths.append(CELL * (end - first))
    size = CELL * np.array([nx, nz])
    return Shape(size, np.zeros((2, 2)), np.concatenate(starts), np.concatenate(turns), np.concatenate(lengths))


def apartment_plan(rng: np.random.Generator) -> FloorPlan:
    """Draw the plan of an apartment.

    It is one open space with straight, L-shaped, U-shaped or nearly closed partitions.
    """
    nz, nx = APARTMENT
    while True:
        middle = int(rng.integers(nx // 3, 2 * nx // 3))
        spans = [(0, middle), (middle, nx)] if rng.random() < 0.7 else [(0, nx)]
        partitions = tuple(wall for low, high in spans for wall in _partition(low, high, rng))
        walls = np.ones((nz + 2, nx + 2), bool)
        walls[1:-1, 1:-1] = False
        for wall in partitions:
            walls[wall.cells] = True
        free = away_from_walls(walls)
        low, high = APARTMENT_CELLS
        if low <= free.sum() <= high and len(standable_cells(free)) == free.sum():
            return FloorPlan(walls, (Rectangle(1, 1, nz + 1, nx + 1),), ("apartment",), partitions=partitions)


def _partition(low: int, high: int, rng: np.random.Generator) -> list[Rectangle]:
    """Draw some sides of a rectangle as walls.

    It lies between the columns `low` and `high` of the floor; one side may go on to the outer wall.
    """
    nz, nx = APARTMENT
    first, last = low + 1 + (PASSAGE if low == 0 else 1), high + 1 - (PASSAGE if high == nx else 1)
    width = int(rng.integers(6, min(18, last - first) + 1))
    depth = int(rng.integers(5, 9))
    x0 = int(rng.integers(first, last - width + 1))
    z0 = 1 + int(rng.integers(PASSAGE, nz - PASSAGE - depth + 1))
    z1, x1 = z0 + depth, x0 + width
    sides = [
        Rectangle(z0, x0, z0 + 1, x1),
        Rectangle(z1 - 1, x0, z1, x1),
        Rectangle(z0, x0, z1, x0 + 1),
        Rectangle(z0, x1 - 1, z1, x1),
    ]
    chosen = [sides[i] for i in rng.permutation(4)[: rng.choice([1, 2, 3], p=[0.2, 0.45, 0.35])]]
    if rng.random() < 0.4:
        side = chosen.pop()
        if side.z1 - side.z0 > 1:
            chosen.append(side._replace(z0=1) if rng.random() < 0.5 else side._replace(z1=nz + 1))
        else:
            chosen.append(side._replace(x0=1) if low == 0 else side._replace(x1=nx + 1))
    return chosen


def house_plan(rng: np.random.Generator) -> FloorPlan:
    """Draw the plan of a house.

    It has rectangular rooms, half of the time along a corridor, and doors that connect all of them.
    """
    while True:
        number = int(rng.choice(list(ROOM_COUNTS), p=list(ROOM_COUNTS.values())))
        median, spread = ROOM_CELLS
        area = number * median * np.exp(spread * rng.standard_normal())
        stretch = np.sqrt(rng.uniform(1.0, 1.8))
        nz, nx = (int(side) for side in np.round(rng.permutation([stretch, 1.0 / stretch]) * np.sqrt(area)))
        corridor, starts = _corridor(nz, nx, rng) if rng.random() < 0.5 else ([], [Rectangle(1, 1, nz + 1, nx + 1)])
        rooms = _divided(starts, number, rng)
        if rooms is None:
            continue
        rooms.sort(key=lambda room: -room.area)
        types = _room_types(number, rng) + ["corridor"] * len(corridor)
        rooms += corridor
        doors = _doors(rooms, types, rng)
        if doors is None:
            continue
        walls = np.ones((nz + 2, nx + 2), bool)
        for part in (*rooms, *doors):
            walls[part.cells] = False
        return FloorPlan(walls, tuple(rooms), tuple(types), tuple(doors))


def _corridor(nz: int, nx: int, rng: np.random.Generator) -> tuple[list[Rectangle], list[Rectangle]]:
    """Draw a corridor, and return it and its two sides."""
    width = int(rng.choice(CORRIDOR_WIDTHS))
    breadth = min(nz, nx)
    low = 1 + int(np.round((breadth - width) * rng.uniform(0.4, 0.6)))
    parts = [(low, low + width), (1, low - 1), (low + width + 1, breadth + 1)]
    if nz <= nx:
        corridor, *sides = (Rectangle(z0, 1, z1, nx + 1) for z0, z1 in parts)
    else:
        corridor, *sides = (Rectangle(1, x0, nz + 1, x1) for x0, x1 in parts)
    return [corridor], sides


def _divided(parts: list[Rectangle], number: int, rng: np.random.Generator) -> list[Rectangle] | None:
    """Divide the largest part until there are `number` parts.

    Returns:
      The parts, or None if a room would be too narrow.
    """
    parts = list(parts)
    while len(parts) < number:
        z0, x0, z1, x1 = parts.pop(int(np.argmax([part.area for part in parts])))
        length = max(z1 - z0, x1 - x0)
        first = int(np.round(length * rng.uniform(0.36, 0.64)))
        if z1 - z0 >= x1 - x0:
            parts += [Rectangle(z0, x0, z0 + first, x1), Rectangle(z0 + first + 1, x0, z1, x1)]
        else:
            parts += [Rectangle(z0, x0, z1, x0 + first), Rectangle(z0, x0 + first + 1, z1, x1)]
    sides = [side for z0, x0, z1, x1 in parts for side in (z1 - z0, x1 - x0)]
    return parts if min(sides) >= ROOM_SIDE else None


def _room_types(number: int, rng: np.random.Generator) -> list[str]:
    """Draw room types, from the largest room to the smallest."""
    living, baths = LIVING_ROOMS[number], BATHROOMS[number]
    between = ["kitchen"] + ["bedroom"] * (number - living - baths - 1)
    return ["living_room"] * living + [str(name) for name in rng.permutation(between)] + ["bathroom"] * baths


def _doors(rooms: list[Rectangle], types: list[str], rng: np.random.Generator) -> list[Rectangle] | None:
    """Draw doors that connect all rooms, and some more.

    Connections by way of corridors and living rooms are preferred to those by way of bathrooms.

    Returns:
      The doors, or None if they cannot connect all rooms.
    """
    rank = {"corridor": 0, "living_room": 1, "kitchen": 2, "bedroom": 3, "bathroom": 8}
    pairs = [(a, b) for b in range(len(rooms)) for a in range(b) if _shared_wall(rooms[a], rooms[b])]
    pairs.sort(key=lambda pair: rank[types[pair[0]]] + rank[types[pair[1]]] + rng.random())
    group = list(range(len(rooms)))
    doors = []
    for a, b in pairs:
        private = "bathroom" in (types[a], types[b])
        if group[a] == group[b] and (private or rng.random() > SECOND_DOOR):
            continue
        group = [group[a] if other == group[b] else other for other in group]
        z0, x0, z1, x1 = _shared_wall(rooms[a], rooms[b]) or rooms[a]
        stretch = max(z1 - z0, x1 - x0)
        width = DOOR_WIDTHS[0] if private else min(int(rng.choice(DOOR_WIDTHS)), stretch)
        low = int(rng.integers(stretch - width + 1))
        along_z = z1 - z0 > 1
        doors.append(
            Rectangle(z0 + low, x0, z0 + low + width, x1) if along_z else Rectangle(z0, x0 + low, z1, x0 + low + width)
        )
    return doors if len(set(group)) == 1 else None


def _shared_wall(a: Rectangle, b: Rectangle) -> Rectangle | None:
    """Return where a door between two rooms can be.

    Returns:
      Their common wall without a cell at each end, or None if it is too short.
    """
    z0, x0, z1, x1 = max(a.z0, b.z0) + 1, max(a.x0, b.x0) + 1, min(a.z1, b.z1) - 1, min(a.x1, b.x1) - 1
    if z1 - z0 >= DOOR_WIDTHS[0] and max(a.x0, b.x0) - min(a.x1, b.x1) == 1:
        return Rectangle(z0, min(a.x1, b.x1), z1, max(a.x0, b.x0))
    if x1 - x0 >= DOOR_WIDTHS[0] and max(a.z0, b.z0) - min(a.z1, b.z1) == 1:
        return Rectangle(min(a.z1, b.z1), x0, max(a.z0, b.z0), x1)
    return None
