"""Scenes from standable points and objects."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.files.record import Record
from jaxnav.scenes.files.walls import derive_walls
from jaxnav.scenes.scene import CELL, MAX_SIDE, Room, Scene

SNAP = 0.02  # metres; a standable point may be this far off the lattice
MARGIN = 3  # cells around the standable ones; what lies beyond is indistinguishable from a wall


class Note(NamedTuple):
    """Say what was done to scenes, to be told once after an import.

    Attributes:
      text: what was done, in words that follow a number.
      number: of what it was done to.
    """

    text: str
    number: int


class Thing(NamedTuple):
    """Describe an object of a scene.

    Attributes:
      type: name of its type.
      box: centre x, y, z and full size sx, sy, sz in metres of its axis-aligned box.
      yaw: degrees.
      parent: index of the object that it rests on or in, or -1.
    """

    type: str
    box: Sequence[float]
    yaw: float = 0.0
    parent: int = -1


def lattice_cells(record: Record, field: str, points: Sequence[Sequence[float]]) -> np.ndarray:
    """Return the lattice indices of points.

    Args:
      record: the scene's record, for errors.
      field: name of the field that holds the points.
      points: (x, z) in metres.

    Returns:
      int [N, 2], (iz, ix).

    Raises:
      InputError: there is no point, one is not on the lattice, or they lie too far apart.
    """
    if not len(points):
        raise record.error(field, "holds no point to stand on; give at least one")
    xz = np.asarray(points, np.float64)
    cells = np.rint(xz / CELL).astype(np.int64)
    off = np.abs(xz - CELL * cells).max(axis=1)
    if (off > SNAP).any():
        worst = xz[off.argmax()].tolist()
        raise record.error(field, f"holds {worst}; x and z must be multiples of {CELL} (within {SNAP})")
    if (np.ptp(cells, axis=0) > MAX_SIDE).any():
        raise record.error(field, f"spans more than {MAX_SIDE * CELL:g} m; give one scene at a time")
    return cells[:, ::-1]


def scene_of_cells(
    name: str, world: str, room_type: str, split: str, cells: np.ndarray, things: Sequence[Thing]
) -> Scene:
    """Build a scene and derive its walls.

    Walls are what can be neither standable nor furniture, see `derive_walls`.

    Args:
      name, world, room_type, split: see `Scene`.
      cells: int [N, 2], standable lattice indices (iz, ix), z = 0.25 iz and x = 0.25 ix.
      things: the objects.
    """
    low = cells.min(axis=0) - MARGIN
    reach = np.zeros(cells.max(axis=0) - low + MARGIN + 1, bool)
    reach[tuple((cells - low).T)] = True
    origin = (CELL * float(low[1]), CELL * float(low[0]))
    boxes = np.array([thing.box for thing in things], np.float64).reshape(-1, 6)
    return scene(name, world, room_type, split, origin, reach, derive_walls(reach, origin, boxes), things)


def scene(
    name: str,
    world: str,
    room_type: str,
    split: str,
    origin: tuple[float, float],
    reach: np.ndarray,
    walls: np.ndarray,
    things: Sequence[Thing],
    rooms: tuple[Room, ...] = (),
) -> Scene:
    """Build a scene of objects from its other attributes."""
    return Scene(
        name=name,
        world=world,
        room_type=room_type,
        split=split,
        origin=origin,
        reach=reach,
        walls=walls,
        types=tuple(thing.type for thing in things),
        boxes=np.array([thing.box for thing in things], np.float64).reshape(-1, 6),
        yaws=np.array([thing.yaw for thing in things], np.float64),
        parents=np.array([thing.parent for thing in things], np.int64),
        rooms=rooms,
    )
