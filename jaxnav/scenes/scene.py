"""Scenes on a 0.25 m lattice: standable cells, walls and boxes of objects.

`Scene` is the common form of generated rooms and homes and of scenes read from files. Coordinates are metres, y up,
x right and z forward; yaw is in degrees clockwise seen from above and yaw 0 looks along +z. The floor is at y = 0.
"""

import dataclasses
import re
from typing import NamedTuple

import numpy as np

#: Lattice spacing in metres; MoveAhead goes to a neighbouring lattice point.
CELL_SIZE = 0.25

#: Largest side of a scene in cells, 500 m; a larger extent is a mistake in the file.
MAX_SIDE_CELLS = 2000

#: Names of the data splits.
SPLITS = ("train", "val", "test")

#: Names of scenes that share their walls with others: apartments, and rooms with their objects moved.
_FURNISHING_NAME = re.compile(
    r"(FloorPlan_.*[^0-9_][0-9]+)_[0-9]+|((?:train|val|test)-apartment-[0-9]+)-[0-9]+|(.+)-replaced-[0-9]+"
)


class Room(NamedTuple):
    """One room of a home.

    Attributes:
      type: `kitchen`, `living_room`, `bedroom`, `bathroom`, ...
      cells: bool [nz, nx], True on its floor.
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


def floor_plan_name(name: str) -> str:
    """Return the name of the floor plan, derived from a scene's name.

    Scenes of one floor plan are alike, and count as one in statistics: `FloorPlan_Train3_1` and `FloorPlan_Train3_5`,
    `FloorPlan_test-dev1_1` and `FloorPlan_test-dev1_2`, `val-apartment-02-0` and `val-apartment-02-4`, `FloorPlan7` and
    `FloorPlan7-replaced-2`. Any other scene has a floor plan of its own with the scene's name.
    """
    # Suffixes can be nested, for example an apartment with its objects moved.
    name_match = _FURNISHING_NAME.fullmatch(name)
    while name_match:
        name = next(filter(None, name_match.groups()))
        name_match = _FURNISHING_NAME.fullmatch(name)
    return name


def box_footprints(boxes: np.ndarray) -> np.ndarray:
    """Return low and high corner (x, z), float64 [N, 2, 2], of boxes [N, 6] with centre and full size."""
    centres = boxes[:, [0, 2]]
    half_sizes = boxes[:, [3, 5]] / 2
    return np.stack([centres - half_sizes, centres + half_sizes], axis=1)


def scene_extent(scene: Scene, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest (x, z) of a scene's cells and objects.

    Args:
      scene: the scene; all its objects are included.
      cells: bool [nz, nx], the cells to include; None for all.

    Returns:
      float64 [2] each, metres.
    """
    if cells is None:
        cells = np.ones_like(scene.reach)

    # Centres of the cells in world coordinates, [C, 2].
    row, column = np.nonzero(cells)
    cell_centres = np.asarray(scene.origin) + CELL_SIZE * np.stack([column, row], axis=-1)

    # The cells are squares around their centres. A scene without objects has the extent of its cells.
    footprints = box_footprints(scene.boxes)
    low = np.minimum(cell_centres.min(axis=0) - CELL_SIZE / 2, footprints.min(axis=(0, 1), initial=np.inf))
    high = np.maximum(cell_centres.max(axis=0) + CELL_SIZE / 2, footprints.max(axis=(0, 1), initial=-np.inf))
    return low, high


def scene_size(scene: Scene) -> np.ndarray:
    """Return width and depth of a scene, float64 [2], metres.

    The rectangle encloses the objects and all cells that are not walls.
    """
    # Cells that are neither standable nor a wall hold furniture, so they count.
    low, high = scene_extent(scene, scene.reach | ~scene.walls)
    return high - low
