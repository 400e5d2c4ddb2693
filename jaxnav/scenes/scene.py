"""Scenes on a 0.25 m lattice.

A scene has standable cells, walls and boxes of objects.
Coordinates are metres, y up, x right and z forward; yaw is in degrees clockwise seen from above and yaw 0
looks along +z. The floor is at y = 0.
"""

import dataclasses
import re
from typing import NamedTuple

import numpy as np

#: Lattice spacing in metres; MoveAhead goes to a neighbouring lattice point.
CELL = 0.25

#: Cells of a scene's side at most, 500 m; a larger extent is a mistake.
MAX_SIDE = 2000

#: What scenes are divided into.
SPLITS = ("train", "val", "test")

#: Names of scenes that share their walls with others: apartments, and rooms with their objects moved.
_FURNISHED = re.compile(
    r"(FloorPlan_[A-Za-z]+[0-9]+)_[0-9]+|((?:train|val|test)-apartment-[0-9]+)-[0-9]+|(.+)-replaced-[0-9]+"
)


class Room(NamedTuple):
    """Hold a room of a home.

    Attributes:
      type: `kitchen`, `living_room`, `bedroom`, `bathroom`, ...
      cells: bool [nz, nx], True on its floor.
    """

    type: str
    cells: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """Hold one room, apartment or house.

    Attributes:
      name: unique name of the scene.
      world: the world it comes from, for example `rooms` or `ithor`.
      room_type: `kitchen`, `living_room`, `bedroom`, `bathroom`, or `apartment`, `house`, ...
      split: `train`, `val` or `test`.
      origin: world (x, z) in metres of the centre of cell [0, 0], a multiple of 0.25.
      reach: bool [nz, nx], True where the agent's centre can stand; row 0 has the smallest z.
      walls: bool [nz, nx], True where a cell blocks every line of sight, from floor to ceiling.
      types: [N] object type names.
      boxes: float64 [N, 6], centre x, y, z and full size sx, sy, sz in metres of each axis-aligned box.
      yaws: float64 [N], degrees.
      parents: int [N], index of the object that an object rests on or in, or -1.
      rooms: the rooms of a home, where they are known.
    """

    name: str
    world: str
    room_type: str
    split: str
    origin: tuple[float, float]
    reach: np.ndarray
    walls: np.ndarray
    types: tuple[str, ...]
    boxes: np.ndarray
    yaws: np.ndarray
    parents: np.ndarray
    rooms: tuple[Room, ...] = ()


def floor_plan(name: str) -> str:
    """Return the floor plan that a scene's name tells.

    Scenes of one floor plan are alike, and count as one in statistics: `FloorPlan_Train3_1` and `FloorPlan_Train3_5`,
    `val-apartment-02-0` and `val-apartment-02-4`, `FloorPlan7` and `FloorPlan7-replaced-2`. Any other scene has a floor
    plan of its own, which has its name.
    """
    while match := _FURNISHED.fullmatch(name):
        name = next(filter(None, match.groups()))
    return name


def extent(scene: Scene, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest (x, z) of a scene.

    Args:
      scene: whose objects count.
      cells: bool [nz, nx], the cells that count; None for all.

    Returns:
      float64 [2] each, metres.
    """
    iz, ix = np.nonzero(np.ones_like(scene.reach) if cells is None else cells)
    points = np.asarray(scene.origin) + CELL * np.stack([ix, iz], axis=-1)
    centre, half = scene.boxes[:, [0, 2]], scene.boxes[:, [3, 5]] / 2
    low = np.minimum(points.min(axis=0) - CELL / 2, (centre - half).min(axis=0, initial=np.inf))
    high = np.maximum(points.max(axis=0) + CELL / 2, (centre + half).max(axis=0, initial=-np.inf))
    return low, high


def scene_size(scene: Scene) -> np.ndarray:
    """Return width and depth of a scene, float64 [2], metres.

    They are those of the rectangle around the objects and the cells that are no wall.
    """
    low, high = extent(scene, scene.reach | ~scene.walls)
    return high - low
