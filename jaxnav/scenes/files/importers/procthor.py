"""ProcTHOR houses (schema 1.0.0): rooms, walls with doors, and a tree of objects, without reachable positions."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers import polygons
from jaxnav.scenes.files.importers.assemble import MAX_SIDE, SNAP, Thing, lattice_cells, scene
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.generate.rooms import AGENT_RADIUS, OBSTACLE_HEIGHTS
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.scene import CELL, Room, Scene

_MAX_CORNERS = 1000  # of a room; finding crossings takes the square of it
_DECIMALS = 6  # of metres, so that walls and rooms meet where they are meant to


class _Asset(NamedTuple):
    """What the asset database says of an asset: its type, and its width, height and depth at yaw 0 in metres."""

    type: str | None = None
    size: list[float] | None = None


def read_procthor(path: Path, split: str, assets: Path | None = None) -> Iterator[Scene | InputError]:
    """Reads ProcTHOR houses.

    The agent can stand on the lattice points of the rooms that are at least 0.2 m from walls and from objects whose
    boxes reach into 0.1-1.7 m above the floor, as far as they are connected with its place in the file
    (`metadata.agent`). Walls that are marked empty and inner doors that are not shut let it, and its sight, through.

    Args:
      path: one house per line (`*.jsonl`), or a house or a list of houses (`*.json`); both also with gzip.
      split: `train`, `val` or `test`.
      assets: asset database (JSON), by asset id or as lists by type. Objects that it does not hold have the type that
        their names say, and typical sizes.

    Yields:
      A scene `<file>-<index>` for each house, or the error that says why there is none.

    Raises:
      InputError: a file is missing or damaged, or holds no house.
    """
    known = _read_assets(assets) if assets else {}
    stem = re.sub(r"\.jsonl?(\.gz)?$", "", path.name)
    index = -1
    for index, (where, value) in enumerate(_houses(path)):
        name = f"{stem}-{index}"
        try:
            if isinstance(value, InputError):
                raise value
            result = _scene(Record(where, {}).record(f"house {name!r}", value), name, split, known)
        except InputError as error:
            result = error
        yield result
    if index < 0:
        raise InputError(f"{path}: holds no house; write one JSON object per line")


def _houses(path: Path) -> Iterator[tuple[str, Any]]:
    """Where each house of a file stands, and its JSON or the error of a line that is none."""
    content = read_bytes(path)
    by_line = _by_line(path, content)
    for number, text in enumerate(io.BytesIO(content) if by_line else [content], start=1):
        where = f"{path}, line {number}" if by_line else str(path)
        if text.strip() or not by_line:
            try:
                value = parse_json(where, text)
            except InputError as error:
                if not by_line:
                    raise
                value = error
            yield from ((where, house) for house in (value if isinstance(value, list) else [value]))


def _by_line(path: Path, content: bytes) -> bool:
    """Whether the lines are JSON by themselves; of damaged files the name tells."""
    try:
        parse_json(str(path), next((line for line in io.BytesIO(content) if line.strip()), b""))
    except InputError:
        return ".jsonl" in path.name
    return True


def _read_assets(path: Path) -> dict[str, _Asset]:
    """The asset database, `{asset id: asset}` or `{type: [asset, ...]}`."""
    database = Record(str(path), {}).record("asset database", parse_json(str(path), read_bytes(path)))
    assets = {}
    for key, value in database.fields.items():
        for entry in value if isinstance(value, list) else [value]:
            asset = database.record(key, entry)
            asset_id = asset.get("assetId") if isinstance(value, list) else key
            kind, box = asset.fields.get("objectType"), asset.fields.get("boundingBox")
            kind = None if kind is None else asset.text("objectType", kind)
            size = None if box is None else asset.vector("boundingBox", box)
            if size and min(size) < 0:
                raise asset.error("boundingBox", f"is {size}; a size is at least 0")
            assets[asset.text("assetId", asset_id)] = _Asset(kind, size)
    return assets


def _scene(house: Record, name: str, split: str, assets: dict[str, _Asset]) -> Scene:
    floors = _rooms(house)
    corners = np.concatenate([polygon for _, _, polygon in floors])
    # One more cell all around holds the outer walls.
    low, high = np.floor(corners.min(axis=0) / CELL) - 1, np.ceil(corners.max(axis=0) / CELL) + 1
    if (high - low > MAX_SIDE).any():
        raise house.error("rooms", f"span more than {MAX_SIDE * CELL:g} m; give one house at a time")
    x, z = (CELL * np.arange(first, last + 1) for first, last in zip(low, high, strict=True))

    rooms = tuple(Room(kind, polygons.inside(polygon, x, z)) for _, kind, polygon in floors)
    walls = _walls(house, {room_id for room_id, _, _ in floors})
    things = _things(house, assets)
    centre, size = np.split(np.array([thing.box for thing in things]), 2, axis=1)
    boxes = np.stack([centre - size / 2, centre + size / 2], axis=1)  # [N, 2, 3]
    in_way = boxes[(boxes[:, 0, 1] < OBSTACLE_HEIGHTS[1]) & (boxes[:, 1, 1] > OBSTACLE_HEIGHTS[0])][:, :, [0, 2]]
    floor = np.any([room.cells for room in rooms], axis=0)
    free = floor & ~polygons.nearer(np.concatenate([walls, in_way]), x, z, AGENT_RADIUS)
    return scene(
        *(name, "procthor", "house", split),
        origin=(float(x[0]), float(z[0])),
        reach=polygons.connected_part(free, _start(house, free, low)),
        # A wall on the border of two cells takes both. Where walls meet they share a cell, so that no sight slips
        # through; the square of a standable cell, at most 0.18 m from its centre, touches none.
        walls=polygons.touched(walls, x, z),
        things=things,
        rooms=rooms,
    )


def _rooms(house: Record) -> list[tuple[str, str, np.ndarray]]:
    """Id, type and floor polygon [P, 2] (x, z) of each room."""
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
        rooms.append((room.text("id", room.get("id")), kind, polygon))
    if not rooms:
        raise house.error("rooms", "is empty; give at least one")
    return rooms


def _walls(house: Record, rooms: set[str]) -> np.ndarray:
    """What is left of the walls outside passable openings, float64 [M, 2, 2]: low and high corner (x, z)."""
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
    """Start and end (x, z) of a wall [2, 2]. Copies for the outside list the ceiling first, others the floor."""
    corners = wall.sequence("polygon", wall.get("polygon"), 4)
    points = np.round([wall.vector(f"polygon[{k}]", corner, "xz") for k, corner in enumerate(corners)], _DECIMALS)
    ends = list(dict.fromkeys(map(tuple, points.tolist())))
    if len(ends) != 2 or np.ptp(ends, axis=0).min() > SNAP:
        raise wall.error("polygon", f"has the corners {ends} (x, z); give an upright rectangle along x or z")
    return np.array(ends)


def _opening(door: Record, rooms: set[str], lines: dict[str, np.ndarray]) -> np.ndarray | None:
    """Both ends (x, z) of a door [2, 2] if the agent can pass it."""
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


def _start(house: Record, free: np.ndarray, low: np.ndarray) -> np.ndarray:
    """The free cell (iz, ix) at the agent's place or else next to it; `low` (x, z) is cell [0, 0] on the lattice."""
    metadata = house.record("metadata", house.get("metadata"))
    agent = metadata.record("agent", metadata.get("agent"))
    place = agent.vector("position", agent.get("position"), "xz")
    cell = lattice_cells(agent, "position", [place])[0] - low[::-1].astype(int)
    offsets = np.argwhere(free) - cell
    offsets = offsets[np.abs(offsets).max(axis=1) <= 1]
    if not len(offsets):
        raise agent.error("position", f"is {place} (x, z), where the agent cannot stand; put it on free floor")
    return cell + offsets[np.abs(offsets).sum(axis=1).argmin()]


def _things(house: Record, assets: dict[str, _Asset]) -> list[Thing]:
    """The objects, each before what it holds. Positions in the file are in the world, also those of children."""
    objects = house.sequence("objects", house.get("objects"))
    if not objects:
        raise house.error("objects", "is empty; give at least one object to look for")
    things: list[Thing] = []
    left = [(f"objects[{i}]", value, -1) for i, value in enumerate(objects)][::-1]
    while left:
        field, value, parent = left.pop()
        item = house.record(field, value)
        children = item.sequence("children", item.fields.get("children") or [])
        left += [(f"{field}.children[{i}]", child, len(things)) for i, child in enumerate(children)][::-1]
        things.append(_thing(item, assets, parent))
    return things


def _thing(item: Record, assets: dict[str, _Asset], parent: int) -> Thing:
    asset = assets.get(str(item.fields.get("assetId")), _Asset())
    kind = _type(item, asset)
    position = item.vector("position", item.get("position"))
    (yaw,) = item.vector("rotation", item.get("rotation"), "y")
    if asset.size is None:
        size = typical_box(kind)[:3]  # of boxes in the world, whatever the yaw
    else:
        cos, sin = abs(np.cos(np.deg2rad(yaw))), abs(np.sin(np.deg2rad(yaw)))
        sx, sy, sz = asset.size
        size = (cos * sx + sin * sz, sy, sin * sx + cos * sz)
    return Thing(kind, (*position, *size), yaw, parent)


def _type(item: Record, asset: _Asset) -> str:
    if item.fields.get("objectType") is not None:
        return item.text("objectType", item.get("objectType"))
    if asset.type:
        return asset.type
    prefix, bar, _ = item.text("id", item.get("id")).partition("|")
    if bar and prefix and prefix != "small" and not prefix.isdigit():
        return prefix
    name = item.text("assetId", item.get("assetId"))
    return re.sub(r"(_\d+)+$", "", name).replace("_", "") or name  # Alarm_Clock_12 is an AlarmClock
