"""Rooms, walls and doors of ProcTHOR houses."""

import re
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.files.importers import polygons
from jaxnav.scenes.files.importers.assemble import SNAP
from jaxnav.scenes.files.record import Record

_MAX_CORNERS = 1000  # of a room; finding crossings takes the square of it
_DECIMALS = 6  # of metres, so that walls and rooms meet where they are meant to


class FloorPolygon(NamedTuple):
    """Hold the floor of a room.

    Attributes:
      id: of the room.
      type: of the room, for example `living_room`.
      corners: float64 [P, 2], (x, z), metres.
    """

    id: str
    type: str
    corners: np.ndarray


def read_rooms(house: Record) -> list[FloorPolygon]:
    """Read the floors of the rooms.

    Raises:
      InputError: a room is damaged, or there is none.
    """
    rooms = []
    for i, value in enumerate(house.sequence("rooms", house.get("rooms"))):
        room = house.record(f"rooms[{i}]", value)
        points = room.sequence("floorPolygon", room.get("floorPolygon"))
        if not 3 <= len(points) <= _MAX_CORNERS:
            raise room.error("floorPolygon", f"has {len(points)} corners; give 3 to {_MAX_CORNERS}")
        polygon = np.round([room.vector(f"floorPolygon[{k}]", p, "xz") for k, p in enumerate(points)], _DECIMALS)
        if not polygons.is_simple(polygon):
            raise room.error("floorPolygon", "crosses or touches itself; give the corners once around the room")
        kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", room.text("roomType", room.get("roomType"))).lower()
        rooms.append(FloorPolygon(room.text("id", room.get("id")), kind, polygon))
    if not rooms:
        raise house.error("rooms", "is empty; give at least one")
    return rooms


def read_walls(house: Record, rooms: set[str]) -> np.ndarray:
    """Read what passable openings leave of the walls.

    Args:
      house: the house.
      rooms: ids of its rooms.

    Returns:
      float64 [M, 2, 2], low and high corner (x, z) of each piece, metres.

    Raises:
      InputError: a wall or a door is damaged.
    """
    lines, solid = {}, []
    for i, value in enumerate(house.sequence("walls", house.get("walls"))):
        wall = house.record(f"walls[{i}]", value)
        line = lines[wall.text("id", wall.get("id"))] = _wall_line(wall)
        if wall.fields.get("empty") is not True:
            solid.append(line)
    doors = house.sequence("doors", house.get("doors"))
    ends = [_opening(house.record(f"doors[{i}]", door), rooms, lines) for i, door in enumerate(doors)]
    openings = [opening for opening in ends if opening is not None]
    pieces = [piece for line in solid for piece in polygons.without_openings(line, openings)]
    return np.array(pieces, np.float64).reshape(-1, 2, 2)


def _wall_line(wall: Record) -> np.ndarray:
    """Read start and end of a wall.

    They are float64 [2, 2], (x, z). Copies for the outside list the ceiling first, others the floor.
    """
    corners = wall.sequence("polygon", wall.get("polygon"), 4)
    points = np.round([wall.vector(f"polygon[{k}]", corner, "xz") for k, corner in enumerate(corners)], _DECIMALS)
    ends = list(dict.fromkeys(map(tuple, points.tolist())))
    if len(ends) != 2 or np.ptp(ends, axis=0).min() > SNAP:
        raise wall.error("polygon", f"has the corners {ends} (x, z); give an upright rectangle along x or z")
    return np.array(ends)


def _opening(door: Record, rooms: set[str], lines: dict[str, np.ndarray]) -> np.ndarray | None:
    """Read both ends of a door if it is passable.

    They are float64 [2, 2], (x, z).
    """
    room0, room1, wall0, _ = (door.text(field, door.get(field)) for field in ("room0", "room1", "wall0", "wall1"))
    for field, known in (("room0", rooms), ("room1", rooms), ("wall0", lines), ("wall1", lines)):
        if door.get(field) not in known:
            raise door.error(field, f"is {door.get(field)!r}, which the house does not have; give the id of one it has")
    hole = door.sequence("holePolygon", door.get("holePolygon"), 2)
    along = np.array([door.vector(f"holePolygon[{k}]", corner, "x") for k, corner in enumerate(hole)])  # [2, 1]
    start, end = lines[wall0]
    length = np.linalg.norm(end - start)
    if not -SNAP <= along[0, 0] < along[1, 0] <= length + SNAP:
        raise door.error("holePolygon", f"spans x {along.ravel().tolist()}; it must lie in its wall, 0 to {length:g}")
    openness = door.fields.get("openness")
    passable = room0 != room1 and (openness is None or door.number("openness", openness) > 0)
    return start + along * (end - start) / length if passable else None
