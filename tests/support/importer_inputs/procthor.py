"""A ProcTHOR house, and a builder of houses."""

import collections
import itertools
from collections.abc import Sequence
from typing import Any

Corner = tuple[float, float]  # x, z


def point(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def wall(owner: object, start: Corner, end: Corner) -> dict[str, Any]:
    """Return a wall of a room, or of the exterior, that is drawn from `start` to `end`.

    Walls of the exterior list the ceiling first; ids begin with the smaller end.
    """
    low, high = sorted([start, end])
    floor = [point(x, 0, z) for x, z in (start, end)]
    ceiling = [point(x, 3, z) for x, z in (start, end)]
    return {
        "id": f"wall|{owner}|{low[0]:.2f}|{low[1]:.2f}|{high[0]:.2f}|{high[1]:.2f}",
        "roomId": "exterior" if owner == "exterior" else f"room|{owner}",
        "polygon": ceiling + floor if owner == "exterior" else floor + ceiling,
    }


def build(
    *rooms: tuple[str, Sequence[Corner]],
    doors: Sequence[dict[str, Any]] = (),
    objects: Sequence[dict[str, Any]] = (),
    agent: Corner = (5.0, 0.5),
) -> dict[str, Any]:
    """Return a house of rooms, each a type with its corners (x, z).

    Rooms are numbered from 2. A wall that belongs to only one room has a copy that belongs to the exterior.
    """
    # The rooms, and their walls as (room, start, end).
    room_records = []
    inner_walls: list[tuple[int, Corner, Corner]] = []
    for room, (room_type, corners) in enumerate(rooms, start=2):
        polygon = [point(x, 0, z) for x, z in corners]
        room_records.append({"id": f"room|{room}", "roomType": room_type, "floorPolygon": polygon})
        for start, end in itertools.pairwise([*corners, corners[0]]):
            inner_walls.append((room, start, end))

    # Walls of the exterior are drawn in the opposite direction.
    num_rooms = collections.Counter(frozenset((start, end)) for _, start, end in inner_walls)
    outer_walls: list[tuple[str, Corner, Corner]] = []
    for _, start, end in inner_walls:
        if num_rooms[frozenset((start, end))] == 1:
            outer_walls.append(("exterior", end, start))

    return {
        "rooms": room_records,
        "walls": [wall(owner, start, end) for owner, start, end in (*inner_walls, *outer_walls)],
        "doors": list(doors),
        "windows": [{"id": "window|2|0", "room0": "room|2", "room1": "room|2", "wall0": "anything"}],
        "objects": list(objects),
        "proceduralParameters": {"skyboxId": "SkySFGarden"},
        "metadata": {"agent": {"position": point(agent[0], 0.95, agent[1]), "horizon": 30}, "schema": "1.0.0"},
    }


def door(wall_name: str, low: float, high: float, rooms: tuple[int, int] = (2, 3), **fields: object) -> dict[str, Any]:
    """Return a door from `low` to `high` along the walls `wall|<room>|<wall_name>`, with additional fields."""
    first_room, second_room = rooms
    return {
        "id": f"door|{first_room}|{second_room}",
        "assetId": "Doorway_4",
        "room0": f"room|{first_room}",
        "room1": f"room|{second_room}",
        "wall0": f"wall|{first_room}|{wall_name}",
        "wall1": f"wall|{second_room}|{wall_name}",
        "holePolygon": [point(low, 0, 0), point(high, 2.1, 0)],
        **fields,
    }


def item(name: str, asset: str, x: float, y: float, z: float, yaw: float = 0.0, **fields: object) -> dict[str, Any]:
    """Return an object at a position, with additional fields such as `children`."""
    return {"id": name, "assetId": asset, "position": point(x, y, z), "rotation": point(0, yaw, 0), **fields}


# Room 2 spans x 0-3, room 3 x 3-6, both z 0-3. The corners run clockwise, so room 2 draws the wall x = 3 downwards.
BOWL = item("small|3|1", "Bowl_1", 4.5, 0.85, 1.5)
TABLE = item("3|0", "Dining_Table_27_1", 4.5, 0.4, 1.5, 90.0, children=[BOWL])
HOUSE = build(
    ("Kitchen", [(0, 0), (0, 3), (3, 3), (3, 0)]),
    ("LivingRoom", [(3, 0), (3, 3), (6, 3), (6, 0)]),
    doors=(door("3.00|0.00|3.00|3.00", 1.0, 2.0, openable=True, openness=1),),
    objects=(TABLE,),
)
# The asset database as a dict of assets by id, and as a dict of lists of assets by type.
ASSETS = {
    "Dining_Table_27_1": {"objectType": "DiningTable", "boundingBox": point(1.0, 0.8, 0.6)},
    "Bowl_1": {"objectType": "Bowl", "boundingBox": point(0.2, 0.1, 0.2)},
}
ASSET_LISTS = {asset["objectType"]: [{"assetId": name, **asset}] for name, asset in ASSETS.items()}
