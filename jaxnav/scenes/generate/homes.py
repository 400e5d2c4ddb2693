"""Procedural homes: apartments with partitions, after RoboTHOR, and houses with rooms, after ProcTHOR and Gibson."""

import copy
import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.categories import GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.floor_plans import FloorPlan, apartment_plan, house_plan, room_shape
from jaxnav.scenes.generate.furnish import Furnishing, draw_contents, furnish
from jaxnav.scenes.generate.room_rules import HomeStatistics, Item, Rule, home_statistics
from jaxnav.scenes.generate.rooms import CONNECTED_SHARE, away_from_boxes, away_from_walls, connected, make_scene
from jaxnav.scenes.generate.shift import check_scene_arguments, derangement, place_anew, settle
from jaxnav.scenes.scene import CELL, SPLITS, Room, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import APARTMENTS

FURNISHINGS = 5  # of each apartment
APARTMENT_CELLS = (155, 340)  # standable cells of an apartment
HOUSE_CELLS = (250, 1500)  # of a house
CELLS_TOLERANCE = 0.15  # of the number of standable cells under a shift
CONTENTS_ATTEMPTS = 8  # at contents that a room has space for
ATTEMPTS = 10  # at furnishing a room with its contents
SHIFT_ATTEMPTS = 30  # at placing all objects of a home anew

# Names of what stands for walls and doors while a room is being furnished; the scene has cells instead.
PARTITION, DOORWAY = "Partition", "Doorway"
_FIXED = Item(size=(0.0, 0.0, 0.0), rule=Rule({}))
_WALL_HEIGHT = 2.5  # metres
_DOOR = dataclasses.replace(_FIXED, clear=0.7)

# One stream of random numbers each: apartments share their walls, and a shifted scene its contents with its twin.
_PLAN, _APARTMENT, _HOUSE, _SHIFT = 2, 3, 4, 5


class Finding(NamedTuple):
    """When a goal can be found.

    Attributes:
      goals: the categories.
      distance: from a standable cell at most, metres.
      to_footprint: whether to the nearest point of the object rather than to its centre.
    """

    goals: tuple[str, ...]
    distance: float
    to_footprint: bool


_APARTMENT_FINDING = Finding(ROBOTHOR_GOALS, 0.85, to_footprint=False)
_HOUSE_FINDING = Finding(GIBSON_GOALS, 0.6, to_footprint=True)


def generate_apartment(split: str, index: int, seed: int, shift: float = 0.0) -> Scene:
    """One furnishing of an apartment with all twelve goals, each of which can be found.

    `index // 5` is the wall layout, shared by five scenes.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0; 60 training and 15 validation scenes are twelve and three layouts.
      seed: at least 0.
      shift: probability in [0, 1] that an object is placed by the rule of another type.

    Returns:
      The scene, named like `train-apartment-03-2`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, negative index or seed, or a shift that is not in [0, 1].
    """
    check_scene_arguments("generate_apartment", split, index, seed, shift)
    layout, furnishing = divmod(index, FURNISHINGS)
    key = (seed, SPLITS.index(split))
    plan = apartment_plan(np.random.default_rng((*key, layout, _PLAN)))
    rng, shift_rng = (np.random.default_rng((*key, index, stream)) for stream in (_APARTMENT, _APARTMENT + _SHIFT))
    low, high = APARTMENT_CELLS
    home = Home(plan, home_statistics("apartments"), _APARTMENT_FINDING)
    name = f"{split}-apartment-{layout:02d}-{furnishing}"

    def made(rooms: list[Furnishing] | None) -> Scene | None:
        """The scene of the furnished rooms, if every goal in it can be seen from near enough."""
        if not rooms:
            return None
        scene = home.scene(name, "apartments", "apartment", split, rooms)
        lengths = compile_scene(scene, APARTMENTS).best_length[:, APARTMENTS.is_goal()]
        return scene if lengths.max(axis=0).all() else None

    while True:
        rooms = home.furnished(rng)
        if rooms and low <= home.reach(rooms).sum() <= high and (scene := made(rooms)):
            if not shift:
                return scene
            for _ in range(ATTEMPTS):
                if scene := made(home.shifted(rooms, shift, shift_rng)):
                    return scene


def generate_house(split: str, index: int, seed: int, shift: float = 0.0) -> Scene:
    """A house of four to ten rooms, whose types and floors are the scene's `rooms`.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0.
      seed: at least 0.
      shift: probability in [0, 1] that an object is placed by the rule of another type, in a room for that type.

    Returns:
      The scene, named like `train-house-00017`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, negative index or seed, or a shift that is not in [0, 1].
    """
    check_scene_arguments("generate_house", split, index, seed, shift)
    statistics = home_statistics("houses")
    key = (seed, SPLITS.index(split), index)
    rng, shift_rng = (np.random.default_rng((*key, stream)) for stream in (_HOUSE, _HOUSE + _SHIFT))
    low, high = HOUSE_CELLS
    while True:
        home = Home(house_plan(rng), statistics, _HOUSE_FINDING)
        rooms = home.furnished(rng)
        if rooms and low <= home.reach(rooms).sum() <= high:
            rooms = home.shifted(rooms, shift, shift_rng) if shift else rooms
            if rooms:
                scene = home.scene(f"{split}-house-{index:05d}", "houses", "house", split, rooms)
                return dataclasses.replace(scene, rooms=home.floors())


class Home:
    """A floor plan to be furnished room by room, each in the frame of the low corner of its floor."""

    def __init__(self, plan: FloorPlan, statistics: HomeStatistics, finding: Finding):
        self.plan, self.statistics, self.finding = plan, statistics, finding
        self.clear = away_from_walls(plan.walls)
        self.rules = [statistics.rooms[room_type] for room_type in plan.types]
        self.bare = [self._bare(k) for k in range(len(plan.rooms))]

    def furnished(self, rng: np.random.Generator) -> list[Furnishing] | None:
        """The rooms, furnished by the types' own rules; None if there is one with no space for its furniture."""
        rooms = []
        for k in range(len(self.bare)):
            room = next((room for room in self._attempts(k, rng) if self.sound(k, room)), None)
            if room is None:
                return None
            rooms.append(room)
        return rooms

    def shifted(self, rooms: list[Furnishing], shift: float, rng: np.random.Generator) -> list[Furnishing] | None:
        """The rooms with the same objects placed anew; None if they could not be walked through."""
        cells = self.reach(rooms).sum()
        partners = derangement(self.statistics.exchange)
        for _ in range(SHIFT_ATTEMPTS):
            moved = place_anew(self.bare, self.rules, rooms, partners, shift, rng)
            moved = moved and settle(self.bare, moved, self.sound, rng)
            if moved and abs(self.reach(moved).sum() / cells - 1.0) < CELLS_TOLERANCE:
                return moved
        return None

    def sound(self, k: int, room: Furnishing) -> bool:
        """Whether one can walk from every door of room `k` through nearly all of it, and can find its goals."""
        free = away_from_boxes(self.clear[self.plan.rooms[k].around.cells], _furniture(room))
        reach = connected(free)
        doors = free.copy()
        doors[1:-1, 1:-1] = False
        if (doors & ~reach).any() or reach.sum() < CONNECTED_SHARE * free.sum() or not reach[1:-1, 1:-1].any():
            return False
        goals = room.boxes[[name in self.finding.goals for name in room.types]][:, :, [0, 2]]
        low, high = goals.swapaxes(0, 1) if self.finding.to_footprint else (goals.mean(axis=1),) * 2
        cells = CELL * (np.argwhere(reach)[:, None, ::-1] - 0.5)
        distances = np.linalg.norm(np.maximum(np.maximum(low - cells, cells - high), 0.0), axis=-1)
        return bool((distances.min(axis=0, initial=np.inf) <= self.finding.distance).all())

    def reach(self, rooms: list[Furnishing]) -> np.ndarray:
        """The standable cells of the furnished home, bool [nz, nx]."""
        return connected(away_from_boxes(self.clear, self._merged(rooms).boxes))

    def floors(self) -> tuple[Room, ...]:
        """The rooms of the scene."""
        floors = np.zeros((len(self.bare), *self.plan.walls.shape), bool)
        for floor, room in zip(floors, self.plan.rooms, strict=True):
            floor[room.cells] = True
        return tuple(Room(name, floor) for name, floor in zip(self.plan.types, floors, strict=True))

    def scene(self, name: str, world: str, room_type: str, split: str, rooms: list[Furnishing]) -> Scene:
        """The scene of the furnished home."""
        return make_scene(name, world, room_type, split, self.plan.walls, self.reach(rooms), self._merged(rooms))

    def _attempts(self, k: int, rng: np.random.Generator) -> Iterator[Furnishing]:
        for _ in range(CONTENTS_ATTEMPTS):
            contents = draw_contents(self.rules[k], rng)
            for _ in range(ATTEMPTS):
                room = furnish(copy.deepcopy(self.bare[k]), self.rules[k], contents, rng)
                if room:
                    yield room

    def _bare(self, k: int) -> Furnishing:
        """Room `k` with partitions and doors that nothing can be put into or right before."""
        floor = self.plan.rooms[k]
        room = Furnishing(room_shape(self.plan.walls[floor.around.cells]))
        for wall in self.plan.partitions:
            low, high = wall.box(floor, _WALL_HEIGHT)
            room.add(PARTITION, low, high, 0, -1, _FIXED, middle=False)
        for door in self.plan.doors:
            if door.within(floor.around):  # it is flat, for it lies in the plane of the wall, and faces the room
                turn = [door.z1 == floor.z0, door.x1 == floor.x0, door.z0 == floor.z1, door.x0 == floor.x1].index(True)
                low, high = door.box(floor, _WALL_HEIGHT)
                room.add(DOORWAY, low, high, turn, -1, _DOOR, middle=False)
        return room

    def _merged(self, rooms: list[Furnishing]) -> Furnishing:
        """All furniture in the frame of the home."""
        home = Furnishing(self.bare[0].shape)
        for floor, room in zip(self.plan.rooms, rooms, strict=True):
            fixed = sum(name in (PARTITION, DOORWAY) for name in room.types)
            offset = len(home.types) - fixed
            home.parents += [parent if parent < 0 else parent + offset for parent in room.parents[fixed:]]
            home.types += room.types[fixed:]
            home.turns += room.turns[fixed:]
            corner = CELL * np.array([floor.x0 - 1, 0.0, floor.z0 - 1])
            home.boxes = np.concatenate([home.boxes, room.boxes[fixed:] + corner])
        return home


def _furniture(room: Furnishing) -> np.ndarray:
    """Boxes [N, 2, 3] of what is neither wall nor door."""
    return room.boxes[[name not in (PARTITION, DOORWAY) for name in room.types]]
