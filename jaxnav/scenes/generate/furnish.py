"""Furnishing of rooms by rules."""

from collections.abc import Mapping

import numpy as np

from jaxnav.scenes.generate.furnished_room import FORWARD, RIGHT, FurnishedRoom, clear_zone
from jaxnav.scenes.generate.room_rules import Item, Rule
from jaxnav.scenes.generate.room_shapes import inside
from jaxnav.scenes.generate.spots import Spots, draw_spots

SIZE_SPREAD = 0.06  # standard deviation of the logarithm of an object's scale


def draw_contents(items: Mapping[str, Item], rng: np.random.Generator) -> dict[str, int]:
    """Draw the number of objects of each type.

    Types that the room does not have are left out.
    """
    contents: dict[str, int] = {}
    for name, item in items.items():
        has = next((p for other, p in item.has_with.items() if other in contents), item.has)
        if rng.random() < has:
            contents[name] = int(rng.choice(item.count))
    return contents


def furnish(
    room: FurnishedRoom, items: Mapping[str, Item], contents: Mapping[str, int], rng: np.random.Generator
) -> FurnishedRoom | None:
    """Furnish a room.

    Args:
      room: the room to furnish, which is changed.
      items: what the types are and where they are put.
      contents: number of objects by type, in the order in which they are put.
      rng: source of randomness.

    Returns:
      The room, or None if no object of a type fits; further objects of a type may be left out.
    """
    for name, count in contents.items():
        item = items[name]
        placed = [put(room, name, item, draw_size(item, rng), rng) for _ in range(count)]
        if not any(placed):
            return None
    return room


def draw_size(item: Item, rng: np.random.Generator) -> np.ndarray:
    """Draw width, height and depth [3] of an object, metres."""
    return np.array(item.size) * np.exp(SIZE_SPREAD * rng.standard_normal())


def put(room: FurnishedRoom, name: str, item: Item, size: np.ndarray, rng: np.random.Generator) -> bool:
    """Put an object or a block where its rule says.

    Args:
      room: the room, which is changed.
      name: type of the object.
      item: what it is, and its rule.
      size: float [3], width, height and depth of one object, metres.
      rng: source of randomness.

    Returns:
      Whether there is space for it.
    """
    columns, rows = item.block
    pitch = 1.2 if columns * rows > 1 else 1.0
    whole = size * (columns * pitch, 1.0, rows * pitch)
    rule = item.rule
    places = [place for place in rule.at if " " not in place or place.split()[1] in room.types]
    weights = np.array([rule.at[place] for place in places])
    for k in np.argsort(rng.exponential(size=len(places)) / weights):  # the first is drawn by weight, then the next
        rests, middle = places[k].startswith(("on ", "in ")), places[k] == "middle"
        spots = _free(room, draw_spots(room, whole, places[k], rule, rng), whole, item.clear, middle, rests)
        if len(spots.turns):
            best = _choose(room, spots, rule, rng)
            _add_block(room, name, item, size, pitch, Spots(*(field[[best]] for field in spots)), rests, middle)
            return True
    return False


def _add_block(
    room: FurnishedRoom, name: str, item: Item, size: np.ndarray, pitch: float, spot: Spots, rests: bool, middle: bool
) -> None:
    """Add the objects of a block around one spot."""
    columns, rows = item.block
    turn, parent = int(spot.turns[0]), int(spot.owners[0]) if rests else -1
    for row in range(rows):
        for column in range(columns):
            across = (column - (columns - 1) / 2) * pitch * size[0]
            deep = (row - (rows - 1) / 2) * pitch * size[2]
            centre = spot.centres[0] + across * RIGHT[turn] + deep * FORWARD[turn]
            low, high = spot._replace(centres=centre[None]).corners(size)
            room.add(name, low[0], high[0], turn, parent, item, middle)


def _free(room: FurnishedRoom, spots: Spots, size: np.ndarray, clear: float, middle: bool, rests: bool) -> Spots:
    """Return the spots where the object meets nothing.

    It must lie in the room and meet no other object and no zone that is kept clear.
    """
    low, high = spots.corners(size)
    free = inside(room.shape, low[:, [0, 2]], high[:, [0, 2]])
    owner = spots.owners[:, None] == np.arange(len(room.types))
    # What rests on an object may reach into its box (a sofa's back rest); what stands at it may use its clear zone.
    free &= ~(_meet(low, high, room.boxes) & ~(owner & rests)).any(axis=1)
    free &= ~(_meet(low, high, room.zones) & (spots.owners[:, None] != np.array(room.zone_owners, int))).any(axis=1)
    if clear:
        zones = clear_zone(low, high, spots.turns, clear, middle)
        free &= ~(_meet(zones[:, 0], zones[:, 1], room.boxes) & ~owner).any(axis=1)
    return Spots(*(values[free] for values in spots))


def _meet(low: np.ndarray, high: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return whether boxes overlap others, bool [K, N].

    The former are given by their corners [K, 3], the latter are [N, 2, 3].
    """
    overlap = (low[:, None] < boxes[:, 1] - 1e-6) & (high[:, None] > boxes[:, 0] + 1e-6)
    return np.logical_and.reduce(overlap, axis=-1)


def _choose(room: FurnishedRoom, spots: Spots, rule: Rule, rng: np.random.Generator) -> int:
    """Choose the index of a spot.

    Each of the rule's `near` types has its probability; the spot nearest to an object of that type is taken, with the
    remaining probability the first spot.
    """
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
