"""A ProcTHOR house, and a builder of others."""

import collections
import itertools
from collections.abc import Sequence
from typing import Any

Corner = tuple[float, float]  # x, z


def point(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def wall(owner: object, a: Corner, b: Corner) -> dict[str, Any]:
    """Return a wall drawn from a to b (x, z).

    Copies for the outside list the ceiling first; ids begin with the smaller end.
    """
    low, high = sorted([a, b])
    floor, ceiling = [[point(x, y, z) for x, z in (a, b)] for y in (0, 3)]
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
    """Return a house of rooms (type, corners (x, z)).

    Rooms are numbered from 2; edges of one room alone have a copy for the outside.
    """
    edges = [
        (2 + i, a, b) for i, (_, corners) in enumerate(rooms) for a, b in itertools.pairwise([*corners, corners[0]])
    ]
    count = collections.Counter(frozenset((a, b)) for _, a, b in edges)
    outside = [("exterior", b, a) for _, a, b in edges if count[frozenset((a, b))] == 1]
    return {
        "rooms": [
            {"id": f"room|{2 + i}", "roomType": kind, "floorPolygon": [point(x, 0, z) for x, z in corners]}
            for i, (kind, corners) in enumerate(rooms)
        ],
        "walls": [wall(*edge) for edge in [*edges, *outside]],
        "doors": list(doors),
        "windows": [{"id": "window|2|0", "room0": "room|2", "room1": "room|2", "wall0": "anything"}],
        "objects": list(objects),
        "proceduralParameters": {"skyboxId": "SkySFGarden"},
        "metadata": {"agent": {"position": point(agent[0], 0.95, agent[1]), "horizon": 30}, "schema": "1.0.0"},
    }


def door(wall_name: str, low: float, high: float, rooms: tuple[int, int] = (2, 3), **others: object) -> dict[str, Any]:
    """Return a door in the walls `wall|<room>|<wall_name>`."""
    return {
        "id": f"door|{rooms[0]}|{rooms[1]}",
        "assetId": "Doorway_4",
        **{f"room{i}": f"room|{room}" for i, room in enumerate(rooms)},
        **{f"wall{i}": f"wall|{room}|{wall_name}" for i, room in enumerate(rooms)},
        "holePolygon": [point(low, 0, 0), point(high, 2.1, 0)],
        **others,
    }


def item(name: str, asset: str, x: float, y: float, z: float, yaw: float = 0.0, **others: object) -> dict[str, Any]:
    return {"id": name, "assetId": asset, "position": point(x, y, z), "rotation": point(0, yaw, 0), **others}


# Room 2 spans x 0-3, room 3 x 3-6, both z 0-3. The corners run clockwise, so room 2 draws the wall x = 3 downwards.
BOWL = item("small|3|1", "Bowl_1", 4.5, 0.85, 1.5)
TABLE = item("3|0", "Dining_Table_27_1", 4.5, 0.4, 1.5, 90.0, children=[BOWL])
HOUSE = build(
    ("Kitchen", [(0, 0), (0, 3), (3, 3), (3, 0)]),
    ("LivingRoom", [(3, 0), (3, 3), (6, 3), (6, 0)]),
    doors=(door("3.00|0.00|3.00|3.00", 1.0, 2.0, openable=True, openness=1),),
    objects=(TABLE,),
)
# Asset id to asset, and the same as lists by type.
ASSETS = {
    "Dining_Table_27_1": {"objectType": "DiningTable", "boundingBox": point(1.0, 0.8, 0.6)},
    "Bowl_1": {"objectType": "Bowl", "boundingBox": point(0.2, 0.1, 0.2)},
}
ASSET_LISTS = {asset["objectType"]: [{"assetId": name, **asset}] for name, asset in ASSETS.items()}
