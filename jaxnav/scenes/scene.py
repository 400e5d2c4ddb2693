"""What a scene is: standable cells, walls and boxes of objects, on a 0.25 m lattice.

Coordinates are metres, y up, x right and z forward; yaw is in degrees clockwise seen from above and yaw 0
looks along +z. The floor is at y = 0.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

#: Lattice spacing in metres; MoveAhead goes to a neighbouring lattice point.
CELL = 0.25

#: What scenes are divided into.
SPLITS = ("train", "val", "test")


class Room(NamedTuple):
    """A room of a home.

    Attributes:
      type: `kitchen`, `living_room`, `bedroom`, `bathroom`, ...
      cells: bool [nz, nx], its floor.
    """

    type: str
    cells: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """One room, apartment or house.

    Attributes:
      name: unique name of the scene.
      world: the world it comes from, for example `rooms` or `ithor`.
      room_type: `kitchen`, `living_room`, `bedroom`, `bathroom`, or `apartment`, `house`, ...
      split: `train`, `val` or `test`.
      origin: world (x, z) in metres of the centre of cell [0, 0], a multiple of 0.25.
      reach: bool [nz, nx], True where the agent's centre can stand; row 0 has the smallest z.
      walls: bool [nz, nx], True where a cell blocks every line of sight from floor to ceiling.
      types: [N] object type names.
      boxes: float64 [N, 6], centre x, y, z and full size sx, sy, sz in metres of each axis-aligned box.
      yaws: float64 [N], degrees.
      parents: int [N], index of the object that an object rests on or in, or -1.
      rooms: of a home, where they are known.
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
