"""Controller metadata of a room of nine places."""

from typing import Any

from support.mutations import changed

NO_RENDERER = {"center": {"x": 0.0, "y": 0.0, "z": 0.0}, "size": {"x": 0.0, "y": 0.0, "z": 0.0}, "cornerPoints": []}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def thing(
    kind: str,
    x: float,
    y: float,
    z: float,
    size: tuple[float, float, float] | None,
    yaw: float = 0.0,
    parents: list[str] | None = None,
) -> dict[str, Any]:
    """Return the metadata of an object around (x, y, z)."""
    box = {"center": vector(x, y, z), "size": vector(*size), "cornerPoints": [[0.0] * 3] * 8} if size else None
    return {
        "objectId": f"{kind}|{x:+06.2f}|{y:+06.2f}|{z:+06.2f}",
        "objectType": kind,
        "position": vector(x, y, z),
        "rotation": vector(0.0, yaw, 0.0),
        "axisAlignedBoundingBox": box,
        "parentReceptacles": parents,
        "visible": False,
    }


# Nine places at x 0 to 0.5 and z -0.25 to 0.25. The agent is at y 1.15, so the floor is at y 1.15 - 0.9 = 0.25.
PLACES = [vector(0.25 * i, 1.15, 0.25 * j) for i in range(3) for j in (-1, 0, 1)]
TABLE = thing("DiningTable", 1.5, 0.65, 0.0, (1.0, 0.8, 1.2), 90.0, ["Floor|+00.00|+00.00|+00.00"])
DRAWER = thing("Drawer", 1.5, 0.75, 0.0, (0.4, 0.1, 0.4), 90.0, [TABLE["objectId"]])
BOOK = thing("Book", 1.5, 0.76, 0.1, None, 10.0, [DRAWER["objectId"], TABLE["objectId"], "Lamp|gone"])
FRIDGE = changed(thing("Fridge", 0.0, 0.25, 1.5, None), "axisAlignedBoundingBox", NO_RENDERER)
METADATA: dict[str, Any] = {
    "sceneName": "FloorPlan201_physics",
    "lastAction": "GetReachablePositions",
    "lastActionSuccess": True,
    "errorMessage": "",
    "agent": {"position": vector(0.0, 1.15, 0.0), "rotation": vector(0.0, 270.0, 0.0), "cameraHorizon": 30.0},
    "objects": [thing("Floor", 0.0, 0.0, 0.0, (4.0, 1.0, 4.0)), TABLE, DRAWER, BOOK, FRIDGE],
    "actionReturn": PLACES,
}
