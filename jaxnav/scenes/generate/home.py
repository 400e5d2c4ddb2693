"""A floor plan and its furniture, room by room."""

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.generate.floor_plans import FloorPlan, room_shape
from jaxnav.scenes.generate.furnish import draw_contents, furnish
from jaxnav.scenes.generate.furnished_room import FurnishedRoom
from jaxnav.scenes.generate.room_rules import Item, Rule
from jaxnav.scenes.generate.rooms import CONNECTED_SHARE, away_from_boxes, away_from_walls, connected, make_scene
from jaxnav.scenes.scene import CELL, Room, Scene

CONTENTS_ATTEMPTS = 8  # to draw contents that a room has space for
ATTEMPTS = 10  # to furnish a room with its contents

# Types that stand for walls and doors while a room is being furnished; the scene has cells instead.
PARTITION, DOORWAY = "Partition", "Doorway"
_FIXED = Item(size=(0.0, 0.0, 0.0), rule=Rule({}))
_WALL_HEIGHT = 2.5  # metres
_DOOR = dataclasses.replace(_FIXED, clear=0.7)


class GoalRange(NamedTuple):
    """Describe how near a standable cell must be to goals.

    Attributes:
      goals: the categories.
      distance: from a standable cell at most, metres.
      to_footprint: whether to the nearest point of the object rather than to its centre.
    """

    goals: tuple[str, ...]
    distance: float
    to_footprint: bool


class Home:
    """Furnish a floor plan room by room.

    The origin of each room is the low corner of its floor.
    """

    def __init__(self, plan: FloorPlan, rules: Mapping[str, Mapping[str, Item]], goal_range: GoalRange):
        self.plan, self.goal_range = plan, goal_range
        self.clear = away_from_walls(plan.walls)
        self.rules = [rules[room_type] for room_type in plan.types]
        self.bare = [self._bare(k) for k in range(len(plan.rooms))]

    def furnished(self, rng: np.random.Generator) -> list[FurnishedRoom] | None:
        """Furnish the rooms by the rules of the types.

        Returns:
          The rooms, or None if one has no space for its furniture.
        """
        rooms = []
        for k in range(len(self.bare)):
            room = next((room for room in self._attempts(k, rng) if self.usable(k, room)), None)
            if room is None:
                return None
            rooms.append(room)
        return rooms

    def usable(self, k: int, room: FurnishedRoom) -> bool:
        """Return whether room `k` can be walked through.

        All its doors and nearly all its free cells must be connected, and its goals near enough to one of them.
        """
        free = away_from_boxes(self.clear[self.plan.rooms[k].around.cells], _furniture(room))
        reach = connected(free)
        doors = free.copy()
        doors[1:-1, 1:-1] = False
        if (doors & ~reach).any() or reach.sum() < CONNECTED_SHARE * free.sum() or not reach[1:-1, 1:-1].any():
            return False
        goals = room.boxes[[name in self.goal_range.goals for name in room.types]][:, :, [0, 2]]
        low, high = goals.swapaxes(0, 1) if self.goal_range.to_footprint else (goals.mean(axis=1),) * 2
        cells = CELL * (np.argwhere(reach)[:, None, ::-1] - 0.5)
        distances = np.linalg.norm(np.maximum(np.maximum(low - cells, cells - high), 0.0), axis=-1)
        return bool((distances.min(axis=0, initial=np.inf) <= self.goal_range.distance).all())

    def reach(self, rooms: list[FurnishedRoom]) -> np.ndarray:
        """Return the standable cells of the home, bool [nz, nx]."""
        return connected(away_from_boxes(self.clear, self._merged(rooms).boxes))

    def floors(self) -> tuple[Room, ...]:
        """Return the rooms of the scene."""
        floors = np.zeros((len(self.bare), *self.plan.walls.shape), bool)
        for floor, room in zip(floors, self.plan.rooms, strict=True):
            floor[room.cells] = True
        return tuple(Room(name, floor) for name, floor in zip(self.plan.types, floors, strict=True))

    def scene(self, name: str, world: str, room_type: str, split: str, rooms: list[FurnishedRoom]) -> Scene:
        """Return the scene of the furnished rooms."""
        return make_scene(name, world, room_type, split, self.plan.walls, self.reach(rooms), self._merged(rooms))

    def _attempts(self, k: int, rng: np.random.Generator) -> Iterator[FurnishedRoom]:
        for _ in range(CONTENTS_ATTEMPTS):
            contents = draw_contents(self.rules[k], rng)
            for _ in range(ATTEMPTS):
                room = furnish(copy.deepcopy(self.bare[k]), self.rules[k], contents, rng)
                if room:
                    yield room

    def _bare(self, k: int) -> FurnishedRoom:
        """Return room `k` with its partitions and doors alone.

        Nothing can be put into them or right in front of a door.
        """
        floor = self.plan.rooms[k]
        room = FurnishedRoom(room_shape(self.plan.walls[floor.around.cells]))
        for wall in self.plan.partitions:
            low, high = wall.box(floor, _WALL_HEIGHT)
            room.add(PARTITION, low, high, 0, -1, _FIXED, middle=False)
        for door in self.plan.doors:
            if door.within(floor.around):  # its box is flat, in the plane of the wall, and faces the room
                turn = [door.z1 == floor.z0, door.x1 == floor.x0, door.z0 == floor.z1, door.x0 == floor.x1].index(True)
                low, high = door.box(floor, _WALL_HEIGHT)
                room.add(DOORWAY, low, high, turn, -1, _DOOR, middle=False)
        return room

    def _merged(self, rooms: list[FurnishedRoom]) -> FurnishedRoom:
        """Return all furniture in the frame of the home."""
        home = FurnishedRoom(self.bare[0].shape)
        for floor, room in zip(self.plan.rooms, rooms, strict=True):
            fixed = sum(name in (PARTITION, DOORWAY) for name in room.types)
            offset = len(home.types) - fixed
            home.parents += [parent if parent < 0 else parent + offset for parent in room.parents[fixed:]]
            home.types += room.types[fixed:]
            home.turns += room.turns[fixed:]
            corner = CELL * np.array([floor.x0 - 1, 0.0, floor.z0 - 1])
            home.boxes = np.concatenate([home.boxes, room.boxes[fixed:] + corner])
        return home


def _furniture(room: FurnishedRoom) -> np.ndarray:
    """Return the boxes of the furniture alone, [N, 2, 3]."""
    return room.boxes[[name not in (PARTITION, DOORWAY) for name in room.types]]
