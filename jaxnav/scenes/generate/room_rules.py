"""Statistics of rooms: what stands there, and where."""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping
from typing import Any

import yaml

FURNITURE_GAP = 0.01  # between a piece of furniture and its wall, metres


@dataclasses.dataclass(frozen=True)
class Rule:
    """Describe where objects of a type are put.

    Attributes:
      at: weight of each place: `wall`, `corner`, `middle`, or one of `on`, `in` (let into its surface), `above`,
        `beside`, `before`, `around` and a type. Places of types that the room does not have are left out.
      near: probability, by type, that of the drawn spots the nearest to an object of that type is taken; else any is.
      bottom: height of the underside in metres, of what is not `on` or `in` another object.
      gap: distance to what it is `beside`, `before` or `around`, metres.
    """

    at: Mapping[str, float]
    near: Mapping[str, float] = dataclasses.field(default_factory=dict)
    bottom: float = 0.0
    gap: float = FURNITURE_GAP


@dataclasses.dataclass(frozen=True)
class Item:
    """Describe the objects of a type in a room.

    Attributes:
      size: width, height and depth in metres; the depth is along where it faces.
      rule: where it is put.
      has: probability that the room has any.
      has_with: the same if the room has an object of another type; the first that applies counts.
      count: how many there are then, each equally likely.
      block: columns and rows of one group of objects that is put as one.
      surface: height above its underside of what objects on it rest on, metres; its top by default.
      clear: how much floor is kept free in front of it, metres, on all sides if it is in the middle.
    """

    size: tuple[float, float, float]
    rule: Rule
    has: float = 1.0
    has_with: Mapping[str, float] = dataclasses.field(default_factory=dict)
    count: tuple[int, ...] = (1,)
    block: tuple[int, int] = (1, 1)
    surface: float | None = None
    clear: float = 0.0


@dataclasses.dataclass(frozen=True)
class RoomStatistics:
    """Hold the statistics of one room type.

    Attributes:
      cells: minimum, quartiles and maximum of the number of standable cells, which is drawn from them.
      fill: standable share of the rectangle around the standable cells.
      margin: how much wider the room is than that rectangle, metres.
      aspect: the longest possible side of that rectangle, relative to the other.
      l_shape: share of L-shaped rooms.
      items: what stands in the room, by type, in the order in which it is put.
    """

    cells: tuple[float, float, float, float, float]
    fill: float
    margin: float
    aspect: float
    l_shape: float
    items: Mapping[str, Item]


@functools.cache
def room_statistics() -> dict[str, RoomStatistics]:
    """Read the statistics of `rooms.yaml` by room type."""
    return {
        room_type: RoomStatistics(**{**entry, "items": _items(entry["items"])})
        for room_type, entry in _read("rooms.yaml").items()
    }


@functools.cache
def home_rules(world: str) -> Mapping[str, Mapping[str, Item]]:
    """Read `apartments.yaml` or `houses.yaml`.

    Returns:
      By room type, what stands there by type, in the order in which it is put.
    """
    return {room_type: _items(items) for room_type, items in _read(f"{world}.yaml").items()}


def _read(file: str) -> dict[str, Any]:
    return yaml.safe_load(pathlib.Path(__file__).with_name(file).read_text())


def _items(entries: dict[str, dict[str, Any]]) -> dict[str, Item]:
    return {name: _item(entry) for name, entry in entries.items()}


def _item(entry: dict[str, Any]) -> Item:
    return Item(**{**entry, "rule": Rule(**entry["rule"])})
