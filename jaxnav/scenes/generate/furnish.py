"""Furnishing a room by rules: where each type of object is put, and what it is put on or near."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.generate.room_rules import FURNITURE_GAP, Item, Rule
from jaxnav.scenes.generate.room_shapes import Shape, inside

CANDIDATES = 48  # spots drawn for an object, of which one is taken
SIZE_SPREAD = 0.06  # standard deviation of the logarithm of an object's scale
ZONE_HEIGHT = 0.8  # the floor that is kept clear in front of furniture is clear up to here, metres

#: (x, z) of forward and right after 0 to 3 quarter turns clockwise from +z.
FORWARD = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])
RIGHT = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])


class Spots(NamedTuple):
    """Candidate poses of an object.

    Attributes:
      centres: float64 [K, 2], (x, z).
      turns: int [K], quarter turns clockwise from facing +z.
      bottoms: float64 [K], height of the underside.
      owners: int [K], the object that a spot refers to, or -1.
    """

    centres: np.ndarray
    turns: np.ndarray
    bottoms: np.ndarray
    owners: np.ndarray


class Placed(NamedTuple):
    """One object (or block of objects) that was put in a room.

    Attributes:
      name: its type.
      item: what it is and the rule that it was put by.
      size: width, height and depth [3] of one object, metres.
    """

    name: str
    item: Item
    size: np.ndarray


class Furnishing:
    """A room being furnished: axis-aligned boxes and the floor that is kept clear in front of them."""

    def __init__(self, shape: Shape):
        self.shape = shape
        self.types: list[str] = []
        self.turns: list[int] = []
        self.parents: list[int] = []
        self.surfaces: list[float] = []
        self.boxes = np.zeros((0, 2, 3))  # low and high (x, y, z) corners
        self.zones = np.zeros((0, 2, 3))
        self.zone_owners: list[int] = []
        self.placed: list[Placed] = []

    def add(
        self, name: str, low: np.ndarray, high: np.ndarray, turn: int, parent: int, item: Item, middle: bool
    ) -> None:
        """Puts an object with corners `low`, `high` [3] and the zone that is to stay clear around it."""
        self.types.append(name)
        self.turns.append(turn)
        self.parents.append(parent)
        self.surfaces.append(high[1] if item.surface is None else low[1] + item.surface)
        self.boxes = np.concatenate([self.boxes, [[low, high]]])
        if item.clear:
            zone = clear_zone(low[None], high[None], np.array([turn]), item.clear, middle)
            self.zones = np.concatenate([self.zones, zone])
            self.zone_owners.append(len(self.types) - 1)

    def indices(self, name: str) -> np.ndarray:
        """The objects of a type, int [N]."""
        return np.array([i for i, other in enumerate(self.types) if other == name], int)


def clear_zone(low: np.ndarray, high: np.ndarray, turns: np.ndarray, clear: float, middle: bool) -> np.ndarray:
    """Floor under boxes `low` to `high` [K, 3] and `clear` metres in front of (or all around) them: boxes [K, 2, 3]."""
    zones = np.stack([low, high], axis=1)
    zones[:, 0, [0, 2]] -= clear * np.maximum(-FORWARD[turns], middle)
    zones[:, 1, [0, 2]] += clear * np.maximum(FORWARD[turns], middle)
    zones[:, 0, 1], zones[:, 1, 1] = 0.0, ZONE_HEIGHT
    return zones


def draw_contents(items: Mapping[str, Item], rng: np.random.Generator) -> dict[str, int]:
    """How many objects there are of each type, for the types that a room has at all."""
    contents: dict[str, int] = {}
    for name, item in items.items():
        has = next((p for other, p in item.has_with.items() if other in contents), item.has)
        if rng.random() < has:
            contents[name] = int(rng.choice(item.count))
    return contents


def furnish(
    room: Furnishing, items: Mapping[str, Item], contents: Mapping[str, int], rng: np.random.Generator
) -> Furnishing | None:
    """Furnishes a room; None if a type found no place at all (further objects of a type may be left out).

    Args:
      room: the room to furnish, which is changed.
      items: what the types are and where they are put.
      contents: number of objects by type, in the order in which they are put.
      rng: source of randomness.
    """
    for name, count in contents.items():
        item = items[name]
        placed = [put(room, name, item, draw_size(item, rng), rng) for _ in range(count)]
        if not any(placed):
            return None
    return room


def draw_size(item: Item, rng: np.random.Generator) -> np.ndarray:
    """Width, height and depth [3] of an object, metres."""
    return np.array(item.size) * np.exp(SIZE_SPREAD * rng.standard_normal())


def put(room: Furnishing, name: str, item: Item, size: np.ndarray, rng: np.random.Generator) -> bool:
    """Puts one object (or block of objects) of `size` [3] where its rule says; False if there is no room for it."""
    columns, rows = item.block
    pitch = 1.2 if columns * rows > 1 else 1.0
    whole = size * (columns * pitch, 1.0, rows * pitch)
    rule = item.rule
    places = [place for place in rule.at if " " not in place or place.split()[1] in room.types]
    weights = np.array([rule.at[place] for place in places])
    for k in np.argsort(rng.exponential(size=len(places)) / weights):  # the first is drawn by weight, then the next
        spots = draw_spots(room, whole, places[k], rule, rng)
        rests = places[k].startswith(("on ", "in "))
        middle = places[k] == "middle"
        spots = _free(room, spots, whole, item.clear, middle, rests)
        if not len(spots.turns):
            continue
        best = _choose(room, spots, rule, rng)
        turn, parent = int(spots.turns[best]), int(spots.owners[best]) if rests else -1
        for row in range(rows):
            for column in range(columns):
                across = (column - (columns - 1) / 2) * pitch * size[0]
                deep = (row - (rows - 1) / 2) * pitch * size[2]
                centre = spots.centres[best] + across * RIGHT[turn] + deep * FORWARD[turn]
                low, high = _corners(centre[None], np.array([turn]), spots.bottoms[[best]], size)
                room.add(name, low[0], high[0], turn, parent, item, middle)
        room.placed.append(Placed(name, item, size))
        return True
    return False


def draw_spots(room: Furnishing, size: np.ndarray, place: str, rule: Rule, rng: np.random.Generator) -> Spots:
    """Draws candidate spots of one kind of place for an object of `size` [3] (width, height, depth)."""
    verb, _, other = place.partition(" ")
    if not other:
        centres, turns = _spots_in_room(room.shape, size, verb, rng)
        return Spots(centres, turns, np.full(len(turns), rule.bottom), np.full(len(turns), -1))

    owners = rng.choice(room.indices(other), CANDIDATES)
    low, high = room.boxes[owners, 0], room.boxes[owners, 1]
    centres, owner_turns = (low + high)[:, [0, 2]] / 2, np.array(room.turns)[owners]
    side = rng.integers(4, size=CANDIDATES) if verb == "around" else 0
    turns = (owner_turns + side) % 4
    extent = np.where((turns % 2 == 0)[:, None], (high - low)[:, [0, 2]], (high - low)[:, [2, 0]])  # across, deep
    across = rng.uniform(-0.5, 0.5, CANDIDATES) * np.maximum(extent[:, 0] - size[0], 0.0)
    deep = rng.uniform(-0.5, 0.5, CANDIDATES) * np.maximum(extent[:, 1] - size[2], 0.0)
    bottoms = np.full(CANDIDATES, rule.bottom)
    if verb == "on":
        bottoms = np.array(room.surfaces)[owners]
    elif verb == "in":
        bottoms = np.array(room.surfaces)[owners] + FURNITURE_GAP - size[1]
    elif verb in ("above", "beside"):  # with its back in line
        deep = (size[2] - extent[:, 1]) / 2
        if verb == "beside":
            across = rng.choice([-1, 1], CANDIDATES) * (extent[:, 0] / 2 + rule.gap + size[0] / 2)
    else:  # before, around: facing it
        deep = extent[:, 1] / 2 + rule.gap + size[2] / 2
    centres = centres + across[:, None] * RIGHT[turns] + deep[:, None] * FORWARD[turns]
    return Spots(centres, turns if verb not in ("before", "around") else (turns + 2) % 4, bottoms, owners)


def _spots_in_room(
    shape: Shape, size: np.ndarray, verb: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Centres [K, 2] and turns [K] of spots at a wall, in a corner or in the middle; none if no wall is long enough."""
    if verb == "middle":
        return rng.uniform(0.0, shape.size, (CANDIDATES, 2)), rng.integers(4, size=CANDIDATES)
    spare = np.maximum(shape.lengths - size[0] - 2 * FURNITURE_GAP, 0.0)
    if not spare.any():
        return np.zeros((0, 2)), np.zeros(0, int)
    wall = rng.choice(len(spare), CANDIDATES, p=spare / spare.sum())
    share = rng.random(CANDIDATES)
    along = (np.round(share) if verb == "corner" else share) * spare[wall] + size[0] / 2 + FURNITURE_GAP
    turns = shape.turns[wall]
    # Facing the room, a wall runs to the right.
    centres = shape.starts[wall] + along[:, None] * RIGHT[turns] + (size[2] / 2 + FURNITURE_GAP) * FORWARD[turns]
    return centres, turns


def _corners(
    centres: np.ndarray, turns: np.ndarray, bottoms: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners [K, 3] of an object's box at each spot."""
    half = np.where((turns % 2 == 0)[:, None], size, size[::-1]) / 2
    middle = np.stack([centres[:, 0], bottoms + size[1] / 2, centres[:, 1]], axis=1)
    return middle - half, middle + half


def _free(room: Furnishing, spots: Spots, size: np.ndarray, clear: float, middle: bool, rests: bool) -> Spots:
    """The spots within the room where the object meets no other, nor a zone that is to stay clear."""
    low, high = _corners(spots.centres, spots.turns, spots.bottoms, size)
    free = inside(room.shape, low[:, [0, 2]], high[:, [0, 2]])
    own = spots.owners[:, None] == np.arange(len(room.types))
    # What rests on an object may reach into its box (a sofa's back rest); what stands at it may use its clear zone.
    free &= ~(_meet(low, high, room.boxes) & ~(own & rests)).any(axis=1)
    free &= ~(_meet(low, high, room.zones) & (spots.owners[:, None] != np.array(room.zone_owners, int))).any(axis=1)
    if clear:
        zones = clear_zone(low, high, spots.turns, clear, middle)
        free &= ~(_meet(zones[:, 0], zones[:, 1], room.boxes) & ~own).any(axis=1)
    return Spots(*(values[free] for values in spots))


def _meet(low: np.ndarray, high: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Whether boxes from `low` to `high` [K, 3] overlap `boxes` [N, 2, 3], bool [K, N]."""
    overlap = (low[:, None] < boxes[:, 1] - 1e-6) & (high[:, None] > boxes[:, 0] + 1e-6)
    return np.logical_and.reduce(overlap, axis=-1)


def _choose(room: Furnishing, spots: Spots, rule: Rule, rng: np.random.Generator) -> int:
    """The spot nearest to an object of one of the rule's `near` types, or with the remaining probability the first."""
    draw = rng.random()
    for name, probability in rule.near.items():
        if draw < probability:
            others = room.boxes[room.indices(name)].mean(axis=1)[:, [0, 2]]
            if not len(others):
                return 0
            distances = np.linalg.norm(spots.centres[:, None] - others, axis=-1).min(axis=1)
            return int(distances.argmin())
        draw -= probability
    return 0
