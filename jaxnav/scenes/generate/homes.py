"""Procedural homes: apartments with partitions (after RoboTHOR) and houses with rooms (after ProcTHOR and Gibson).

`generate_apartment` and `generate_house` are the entry points. Both sample a `FloorPlan`, furnish it room by room with
a `HomeBuilder`, and repeat until the home has a realistic size and its goals are within reach.
"""

import copy
import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.categories import GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.room_shapes import CellRectangle, RoomShape
from jaxnav.scenes.generate.rooms import (
    FORWARD_XZ,
    MIN_CONNECTED_SHARE,
    RIGHT_XZ,
    FurnishedRoom,
    GoalRange,
    ObjectSpec,
    PlacementRule,
    cells_away_from_boxes,
    cells_away_from_walls,
    furnish_room,
    home_rules,
    largest_connected_part,
    make_scene,
    sample_contents,
)
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, SPLITS, Room, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import APARTMENTS

# Apartments.
APARTMENT_SHAPE = (17, 37)  # cells of floor within the outer walls, (nz, nx)
BARE_APARTMENT_CELLS = (395, 445)  # range of the standable cells without furniture
FURNISHED_APARTMENT_CELLS = (155, 340)  # range of the standable cells
FURNISHINGS_PER_PLAN = 5
PASSAGE_CELLS = 4  # cells between a partition and the outer wall, if they do not touch

# Houses.
FURNISHED_HOUSE_CELLS = (250, 1500)  # range of the standable cells
MIN_ROOM_SIDE = 9  # cells
ROOM_CELLS = (235.0, 0.25)  # median floor of a room, and the standard deviation of its logarithm
CORRIDOR_WIDTHS = (5, 6)  # cells
DOOR_WIDTHS = (4, 6, 8, 8)  # cells; doors of bathrooms have the first width
EXTRA_DOOR_PROBABILITY = 0.2  # of a door between rooms that are already connected
#: Probability of each number of rooms.
ROOM_COUNT_PROBABILITIES = {4: 0.18, 5: 0.24, 6: 0.18, 7: 0.14, 8: 0.16, 10: 0.1}
BATHROOM_COUNTS = {4: 1, 5: 1, 6: 2, 7: 2, 8: 2, 10: 3}
LIVING_ROOM_COUNTS = {4: 1, 5: 1, 6: 1, 7: 2, 8: 2, 10: 2}
#: Rooms with a lower rank are preferred for passing through.
PASSAGE_RANK = {"corridor": 0, "living_room": 1, "kitchen": 2, "bedroom": 3, "bathroom": 8}

MAX_CONTENTS_ATTEMPTS = 8  # to sample contents that a room has space for
MAX_FURNISHING_ATTEMPTS = 10  # to furnish a room with its contents

# Object types that stand for walls and doors while a room is being furnished; the scene has cells instead.
PARTITION = "Partition"
DOORWAY = "Doorway"
_FIXTURES = (PARTITION, DOORWAY)
_FIXTURE_HEIGHT = 2.5  # metres
_PARTITION_SPEC = ObjectSpec(size=(0.0, 0.0, 0.0), rule=PlacementRule({}))
_DOORWAY_SPEC = dataclasses.replace(_PARTITION_SPEC, clear=0.7)

# One stream of random numbers each: apartments share their walls.
_PLAN_STREAM = 2
_APARTMENT_STREAM = 3
_HOUSE_STREAM = 4

_APARTMENT_RANGE = GoalRange(ROBOTHOR_GOALS, 0.85, to_footprint=False)
_HOUSE_RANGE = GoalRange(GIBSON_GOALS, 0.6, to_footprint=True)


def generate_apartment(split: str, index: int, seed: int) -> Scene:
    """Generate one furnishing of an apartment, with all twelve goals within reach.

    Five consecutive scenes share the floor plan `index // 5`.

    Args:
      split: `train`, `val` or `test`.
      index: index of at least 0; 60 training and 15 validation scenes have twelve and three floor plans.
      seed: seed of at least 0.

    Returns:
      The scene, named like `train-apartment-03-2`; it depends on the arguments alone.
    """
    # The plan of the apartment, which all its furnishings share.
    plan_index, furnishing = divmod(index, FURNISHINGS_PER_PLAN)
    apartment_key = (seed, SPLITS.index(split))
    plan = sample_apartment_plan(np.random.default_rng((*apartment_key, plan_index, _PLAN_STREAM)))
    builder = HomeBuilder(plan, home_rules("apartments"), _APARTMENT_RANGE)

    # Furnish the plan until the apartment is accepted.
    rng = np.random.default_rng((*apartment_key, index, _APARTMENT_STREAM))
    scene_name = f"{split}-apartment-{plan_index:02d}-{furnishing}"
    min_cells, max_cells = FURNISHED_APARTMENT_CELLS
    while True:
        scene = builder.sample_scene(scene_name, "apartments", "apartment", split, rng)
        if scene is None or not min_cells <= scene.reach.sum() <= max_cells:
            continue

        # Accept the apartment if an agent succeeds for every goal from some pose.
        best_length = compile_scene(scene, APARTMENTS).best_length  # [P, K]
        if best_length[:, APARTMENTS.is_goal()].any(axis=0).all():
            return scene


def generate_house(split: str, index: int, seed: int) -> Scene:
    """Generate a house of four to ten rooms.

    The scene's `rooms` are the types and floors of its rooms.

    Args:
      split: `train`, `val` or `test`.
      index: index of at least 0.
      seed: seed of at least 0.

    Returns:
      The scene, named like `train-house-00017`; it depends on the arguments alone.
    """
    rules = home_rules("houses")
    rng = np.random.default_rng((seed, SPLITS.index(split), index, _HOUSE_STREAM))
    min_cells, max_cells = FURNISHED_HOUSE_CELLS

    # Sample and furnish plans until a house has a realistic size.
    while True:
        builder = HomeBuilder(sample_house_plan(rng), rules, _HOUSE_RANGE)
        scene = builder.sample_scene(f"{split}-house-{index:05d}", "houses", "house", split, rng)
        if scene is not None and min_cells <= scene.reach.sum() <= max_cells:
            return dataclasses.replace(scene, rooms=builder.scene_rooms())


# Floor plans.


class FloorPlan(NamedTuple):
    """Walls and rooms of a home.

    Attributes:
      walls: bool [nz, nx], with a ring of walls around.
      rooms: the floors of the rooms.
      types: room type of each room.
      doors: openings in the walls between rooms.
      partitions: walls that stand in a room.
    """

    walls: np.ndarray
    rooms: tuple[CellRectangle, ...]
    types: tuple[str, ...]
    doors: tuple[CellRectangle, ...] = ()
    partitions: tuple[CellRectangle, ...] = ()


def sample_apartment_plan(rng: np.random.Generator) -> FloorPlan:
    """Sample the plan of an apartment.

    An apartment is one open space with straight, L-shaped, U-shaped or nearly closed partitions.
    """
    num_z, num_x = APARTMENT_SHAPE
    min_cells, max_cells = BARE_APARTMENT_CELLS
    while True:
        # One partition in each half of the apartment, or one in the whole of it.
        middle = int(rng.integers(num_x // 3, 2 * num_x // 3))
        column_ranges = [(0, num_x)]
        if rng.random() < 0.7:
            column_ranges = [(0, middle), (middle, num_x)]
        partitions = []
        for first_column, end_column in column_ranges:
            partitions += _sample_partition(first_column, end_column, rng)

        # Outer walls and partitions.
        walls = np.ones((num_z + 2, num_x + 2), bool)
        walls[1:-1, 1:-1] = False
        for wall in partitions:
            walls[wall.cells] = True

        # Accept the plan if its standable cells are connected.
        free_cells = cells_away_from_walls(walls)
        if min_cells <= free_cells.sum() <= max_cells and len(standable_cells(free_cells)) == free_cells.sum():
            floor = CellRectangle(1, 1, num_z + 1, num_x + 1)
            return FloorPlan(walls, (floor,), ("apartment",), partitions=tuple(partitions))


def _sample_partition(first_column: int, end_column: int, rng: np.random.Generator) -> list[CellRectangle]:
    """Sample some sides of a rectangle as walls.

    The rectangle lies in the columns [first_column, end_column) of the floor; one side may extend to the outer wall.
    """
    # Columns for the rectangle, with a passage before the outer wall.
    num_z, num_x = APARTMENT_SHAPE
    min_x = first_column + 1 + (PASSAGE_CELLS if first_column == 0 else 1)
    max_x = end_column + 1 - (PASSAGE_CELLS if end_column == num_x else 1)

    # The rectangle and its four sides, each one cell thick.
    width = int(rng.integers(6, min(18, max_x - min_x) + 1))
    depth = int(rng.integers(5, 9))
    x0 = int(rng.integers(min_x, max_x - width + 1))
    z0 = 1 + int(rng.integers(PASSAGE_CELLS, num_z - PASSAGE_CELLS - depth + 1))
    x1 = x0 + width
    z1 = z0 + depth
    sides = [
        CellRectangle(z0, x0, z0 + 1, x1),
        CellRectangle(z1 - 1, x0, z1, x1),
        CellRectangle(z0, x0, z1, x0 + 1),
        CellRectangle(z0, x1 - 1, z1, x1),
    ]

    # One to three of the sides are walls.
    side_order = rng.permutation(4)
    num_sides = rng.choice([1, 2, 3], p=[0.2, 0.45, 0.35])
    walls = [sides[i] for i in side_order[:num_sides]]

    # Sometimes the last wall extends to the outer wall: along z to either end, along x to the nearer end.
    if rng.random() < 0.4:
        wall = walls.pop()
        if wall.z1 - wall.z0 > 1:
            extended_wall = wall._replace(z0=1) if rng.random() < 0.5 else wall._replace(z1=num_z + 1)
        else:
            extended_wall = wall._replace(x0=1) if first_column == 0 else wall._replace(x1=num_x + 1)
        walls.append(extended_wall)
    return walls


def sample_house_plan(rng: np.random.Generator) -> FloorPlan:
    """Sample the plan of a house.

    A house has rectangular rooms, half of the time along a corridor, and doors that connect all of them.
    """
    median_cells, log_std = ROOM_CELLS
    while True:
        # Outer dimensions from the number of rooms.
        num_rooms = int(rng.choice(list(ROOM_COUNT_PROBABILITIES), p=list(ROOM_COUNT_PROBABILITIES.values())))
        area = num_rooms * median_cells * np.exp(log_std * rng.standard_normal())
        stretch = np.sqrt(rng.uniform(1.0, 1.8))
        sides = np.round(rng.permutation([stretch, 1.0 / stretch]) * np.sqrt(area))
        num_z = int(sides[0])
        num_x = int(sides[1])

        # Divide the house into rooms; half of the houses have a corridor and are divided on both sides of it.
        corridors: list[CellRectangle] = []
        parts = [CellRectangle(1, 1, num_z + 1, num_x + 1)]
        if rng.random() < 0.5:
            corridors, parts = _sample_corridor(num_z, num_x, rng)
        rooms = _divide_into_rooms(parts, num_rooms, rng)
        if rooms is None:
            continue

        # Room types depend on the order by size; corridors are the last rooms.
        rooms.sort(key=lambda room: -room.area)
        types = _sample_room_types(num_rooms, rng) + ["corridor"] * len(corridors)
        rooms += corridors
        doors = _sample_doors(rooms, types, rng)
        if doors is None:
            continue

        # Everything but rooms and doors is wall.
        walls = np.ones((num_z + 2, num_x + 2), bool)
        for opening in (*rooms, *doors):
            walls[opening.cells] = False
        return FloorPlan(walls, tuple(rooms), tuple(types), tuple(doors))


def _sample_corridor(
    num_z: int, num_x: int, rng: np.random.Generator
) -> tuple[list[CellRectangle], list[CellRectangle]]:
    """Sample a corridor along the longer side.

    Returns:
      The corridor as a list of one, and the two parts of the house on its sides.
    """
    width = int(rng.choice(CORRIDOR_WIDTHS))
    house_breadth = min(num_z, num_x)
    corridor_start = 1 + int(np.round((house_breadth - width) * rng.uniform(0.4, 0.6)))
    corridor_end = corridor_start + width

    # Ranges across the corridor: of the corridor and of both parts, with walls of one cell between them.
    band_ranges = [(corridor_start, corridor_end), (1, corridor_start - 1), (corridor_end + 1, house_breadth + 1)]
    bands = []
    for band_start, band_end in band_ranges:
        if num_z <= num_x:
            bands.append(CellRectangle(band_start, 1, band_end, num_x + 1))
        else:
            bands.append(CellRectangle(1, band_start, num_z + 1, band_end))
    return bands[:1], bands[1:]


def _divide_into_rooms(
    parts: list[CellRectangle], num_rooms: int, rng: np.random.Generator
) -> list[CellRectangle] | None:
    """Divide the largest part until there are `num_rooms` parts.

    Returns:
      The parts, or None if a room would be too narrow.
    """
    rooms = list(parts)
    while len(rooms) < num_rooms:
        largest_index = int(np.argmax([room.area for room in rooms]))
        z0, x0, z1, x1 = rooms.pop(largest_index)

        # A wall of one cell across the longer side.
        length = max(z1 - z0, x1 - x0)
        wall = int(np.round(length * rng.uniform(0.36, 0.64)))
        if z1 - z0 >= x1 - x0:
            rooms += [CellRectangle(z0, x0, z0 + wall, x1), CellRectangle(z0 + wall + 1, x0, z1, x1)]
        else:
            rooms += [CellRectangle(z0, x0, z1, x0 + wall), CellRectangle(z0, x0 + wall + 1, z1, x1)]

    # Refuse narrow rooms.
    shortest_side = min(min(z1 - z0, x1 - x0) for z0, x0, z1, x1 in rooms)
    return rooms if shortest_side >= MIN_ROOM_SIDE else None


def _sample_room_types(num_rooms: int, rng: np.random.Generator) -> list[str]:
    """Sample room types, from the largest room to the smallest."""
    num_living = LIVING_ROOM_COUNTS[num_rooms]
    num_baths = BATHROOM_COUNTS[num_rooms]
    medium_rooms = ["kitchen"] + ["bedroom"] * (num_rooms - num_living - num_baths - 1)
    medium_types = [str(room_type) for room_type in rng.permutation(medium_rooms)]
    return ["living_room"] * num_living + medium_types + ["bathroom"] * num_baths


def _sample_doors(rooms: list[CellRectangle], types: list[str], rng: np.random.Generator) -> list[CellRectangle] | None:
    """Sample doors that connect all rooms, and some extra doors.

    Connections through corridors and living rooms are preferred to connections through bathrooms.

    Returns:
      The doors, or None if they cannot connect all rooms.
    """
    # All pairs of rooms with a wall that has space for a door.
    room_pairs = []
    for second_room in range(len(rooms)):
        for first_room in range(second_room):
            wall = _shared_wall(rooms[first_room], rooms[second_room])
            if wall is not None:
                room_pairs.append((first_room, second_room, wall))

    # Preferred pairs come first; pairs of equal rank are shuffled.
    def sample_pair_rank(room_pair: tuple[int, int, CellRectangle]) -> float:
        first_room, second_room, _ = room_pair
        return PASSAGE_RANK[types[first_room]] + PASSAGE_RANK[types[second_room]] + rng.random()

    room_pairs.sort(key=sample_pair_rank)

    # Kruskal's spanning tree with some extra doors; connected rooms have equal numbers in `component`.
    component = list(range(len(rooms)))
    doors = []
    for first_room, second_room, wall in room_pairs:
        has_bathroom = "bathroom" in (types[first_room], types[second_room])
        is_connected = component[first_room] == component[second_room]
        if is_connected and (has_bathroom or rng.random() > EXTRA_DOOR_PROBABILITY):
            continue
        _merge_components(component, first_room, second_room)
        width = DOOR_WIDTHS[0] if has_bathroom else int(rng.choice(DOOR_WIDTHS))
        doors.append(_sample_door(wall, width, rng))
    return doors if len(set(component)) == 1 else None


def _merge_components(component: list[int], first_room: int, second_room: int) -> None:
    """Give all rooms connected with the second room the number of the first room's component."""
    old_number = component[second_room]
    for room_index, number in enumerate(component):
        if number == old_number:
            component[room_index] = component[first_room]


def _sample_door(wall: CellRectangle, max_width: int, rng: np.random.Generator) -> CellRectangle:
    """Sample the position of a door in a wall of one cell's thickness."""
    wall_length = max(wall.z1 - wall.z0, wall.x1 - wall.x0)
    width = min(max_width, wall_length)
    offset = int(rng.integers(wall_length - width + 1))
    if wall.z1 - wall.z0 > 1:
        return wall._replace(z0=wall.z0 + offset, z1=wall.z0 + offset + width)
    return wall._replace(x0=wall.x0 + offset, x1=wall.x0 + offset + width)


def _shared_wall(first_room: CellRectangle, second_room: CellRectangle) -> CellRectangle | None:
    """Return the cells for a door between two rooms.

    Returns:
      The common wall of the rooms without a cell at each end, or None if the wall is too short for a door.
    """
    # The ranges that the rooms have in common; a range of length -1 is the wall between the rooms.
    z_low = max(first_room.z0, second_room.z0)
    z_high = min(first_room.z1, second_room.z1)
    x_low = max(first_room.x0, second_room.x0)
    x_high = min(first_room.x1, second_room.x1)
    if z_high - z_low - 2 >= DOOR_WIDTHS[0] and x_low - x_high == 1:
        return CellRectangle(z_low + 1, x_high, z_high - 1, x_low)
    if x_high - x_low - 2 >= DOOR_WIDTHS[0] and z_low - z_high == 1:
        return CellRectangle(z_high, x_low + 1, z_low, x_high - 1)
    return None


def room_shape_from_walls(walls: np.ndarray) -> RoomShape:
    """Return the shape of a rectangular room.

    A partition in the room is a wall with two faces. A door interrupts the wall, so nothing can be placed at it.

    Args:
      walls: bool [nz, nx], of the room and of the ring of cells around it; a cell of the ring that is no wall is a
        door.
    """
    # Walls of each direction, seen by an object that stands with its back to the wall.
    floor = ~walls[1:-1, 1:-1]
    num_z, num_x = floor.shape
    wall_starts = []
    wall_turns = []
    wall_lengths = []
    for turn, ((forward_x, forward_z), right_xz) in enumerate(zip(FORWARD_XZ, RIGHT_XZ, strict=True)):
        # Floor cells with a wall right behind the object, one lattice line per row.
        cells_behind = walls[1 - forward_z : 1 - forward_z + num_z, 1 - forward_x : 1 - forward_x + num_x]
        has_wall_behind = floor & cells_behind
        wall_lines = has_wall_behind if forward_z else has_wall_behind.T

        # Each run of such cells is a wall.
        edges = np.diff(np.pad(wall_lines.astype(int), ((0, 0), (1, 1))), axis=1)
        line, run_start = np.nonzero(edges == 1)
        _, run_end = np.nonzero(edges == -1)

        # A wall extends to the right of the object, which is towards lower indices for two turns.
        position_along = run_start if right_xz.sum() > 0 else run_end
        position_across = line + (0 if forward_x + forward_z > 0 else 1)
        start_xz = [position_along, position_across] if forward_z else [position_across, position_along]
        wall_starts.append(CELL_SIZE * np.stack(start_xz, axis=-1))
        wall_turns.append(np.full(len(line), turn))
        wall_lengths.append(CELL_SIZE * (run_end - run_start))

    # A rectangular room has no notch.
    size = CELL_SIZE * np.array([num_x, num_z])
    no_notch = np.zeros((2, 2))
    return RoomShape(
        size, no_notch, np.concatenate(wall_starts), np.concatenate(wall_turns), np.concatenate(wall_lengths)
    )


# Furnishing.


class HomeBuilder:
    """Furnishes a floor plan room by room.

    The origin of each room is the low corner of its floor.
    """

    def __init__(self, plan: FloorPlan, rules: Mapping[str, Mapping[str, ObjectSpec]], goal_range: GoalRange):
        self.plan = plan
        self.goal_range = goal_range
        self.bare_free_cells = cells_away_from_walls(plan.walls)
        self.room_specs = [rules[room_type] for room_type in plan.types]
        self.bare_rooms = [self._make_bare_room(floor) for floor in plan.rooms]

    def sample_scene(self, name: str, world: str, room_type: str, split: str, rng: np.random.Generator) -> Scene | None:
        """Furnish the rooms by the rules of their types.

        Returns:
          The scene, or None if a room has no space for its furniture.
        """
        rooms = []
        for room_index in range(len(self.bare_rooms)):
            room = self._furnish_room(room_index, rng)
            if room is None:
                return None
            rooms.append(room)

        home = self._merge_rooms(rooms)
        reach = largest_connected_part(cells_away_from_boxes(self.bare_free_cells, home.boxes))
        return make_scene(name, world, room_type, split, self.plan.walls, reach, home)

    def is_usable(self, room_index: int, room: FurnishedRoom) -> bool:
        """Return True if an agent can walk through the room.

        All doors and nearly all free cells must be connected, with a standable cell near every goal.
        """
        # Free cells of the room and of the ring around its floor.
        floor = self.plan.rooms[room_index]
        furniture_boxes = room.boxes[[object_type not in _FIXTURES for object_type in room.types]]
        free_cells = cells_away_from_boxes(self.bare_free_cells[floor.with_ring.cells], furniture_boxes)
        reach = largest_connected_part(free_cells)

        # Free cells in the ring around the floor are doors.
        door_cells = free_cells.copy()
        door_cells[1:-1, 1:-1] = False
        if (door_cells & ~reach).any() or reach.sum() < MIN_CONNECTED_SHARE * free_cells.sum():
            return False
        return bool(reach[1:-1, 1:-1].any()) and room.has_goals_in_range(reach, self.goal_range)

    def scene_rooms(self) -> tuple[Room, ...]:
        """Return the types and floors of the rooms."""
        rooms = []
        for room_type, floor in zip(self.plan.types, self.plan.rooms, strict=True):
            cells = np.zeros(self.plan.walls.shape, bool)
            cells[floor.cells] = True
            rooms.append(Room(room_type, cells))
        return tuple(rooms)

    def _furnish_room(self, room_index: int, rng: np.random.Generator) -> FurnishedRoom | None:
        """Return a usable furnished room, or None if all attempts fail."""
        specs = self.room_specs[room_index]
        for _ in range(MAX_CONTENTS_ATTEMPTS):
            room_contents = sample_contents(specs, rng)
            for _ in range(MAX_FURNISHING_ATTEMPTS):
                room = furnish_room(copy.deepcopy(self.bare_rooms[room_index]), specs, room_contents, rng)
                if room is not None and self.is_usable(room_index, room):
                    return room
        return None

    def _make_bare_room(self, floor: CellRectangle) -> FurnishedRoom:
        """Return a room that holds only its partitions and doors.

        Furniture cannot overlap them or stand right in front of a door.
        """
        # Partitions.
        room = FurnishedRoom(room_shape_from_walls(self.plan.walls[floor.with_ring.cells]))
        for wall in self.plan.partitions:
            low, high = wall.to_box(floor, _FIXTURE_HEIGHT)
            room.add_object(PARTITION, low, high, 0, -1, _PARTITION_SPEC, in_middle=False)

        # Doors in the walls of the room: the box of a door is flat, in the plane of the wall, and faces the room.
        for door in self.plan.doors:
            if not door.is_inside(floor.with_ring):
                continue
            is_at_side = [door.z1 == floor.z0, door.x1 == floor.x0, door.z0 == floor.z1, door.x0 == floor.x1]
            turn = is_at_side.index(True)
            low, high = door.to_box(floor, _FIXTURE_HEIGHT)
            room.add_object(DOORWAY, low, high, turn, -1, _DOORWAY_SPEC, in_middle=False)
        return room

    def _merge_rooms(self, rooms: list[FurnishedRoom]) -> FurnishedRoom:
        """Return the furniture of all rooms in the frame of the home."""
        home = FurnishedRoom(self.bare_rooms[0].shape)
        for floor, room in zip(self.plan.rooms, rooms, strict=True):
            # Fixtures are the first objects of a room; they are omitted.
            num_fixtures = sum(object_type in _FIXTURES for object_type in room.types)
            index_shift = len(home.types) - num_fixtures

            # Parents are indices of objects, which change in the home; -1 stands for no parent.
            for parent_index in room.parents[num_fixtures:]:
                home.parents.append(parent_index if parent_index < 0 else parent_index + index_shift)
            home.types += room.types[num_fixtures:]
            home.turns += room.turns[num_fixtures:]

            # Boxes are relative to the low corner of the room's floor.
            corner = CELL_SIZE * np.array([floor.x0 - 1, 0.0, floor.z0 - 1])
            home.boxes = np.concatenate([home.boxes, room.boxes[num_fixtures:] + corner])
        return home
