"""Procedural single rooms by the measured statistics of AI2-THOR."""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.generate.arguments import check_scene_arguments
from jaxnav.scenes.generate.furnish import draw_contents, furnish
from jaxnav.scenes.generate.furnished_room import FurnishedRoom
from jaxnav.scenes.generate.room_rules import room_statistics
from jaxnav.scenes.generate.room_shapes import draw_shape, wall_mask
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, SPLITS, Scene

AGENT_RADIUS = 0.2  # metres
OBSTACLE_HEIGHTS = (0.1, 1.7)  # boxes that reach into this range are in the agent's way, metres
FIND_DISTANCE = 1.2  # from every target to the nearest standable cell, at most, metres
CELLS_TOLERANCE = 0.15  # of the number of standable cells that was drawn for a room
CONNECTED_SHARE = 0.9  # of the free cells must be connected
ATTEMPTS = 40  # to furnish a room with the drawn contents

TARGETS = frozenset(ITHOR_CATEGORIES)


def generate_rooms(num_train: int = 80, num_val: int = 20, num_test: int = 20, seed: int = 0) -> list[Scene]:
    """Generate single rooms.

    A scene depends on the seed, its split and its index alone.

    Args:
      num_train: number of training scenes, at least 0; room types take turns.
      num_val: number of validation scenes.
      num_test: number of test scenes.
      seed: at least 0.

    Returns:
      The scenes, split by split, named like `train-kitchen-003`.

    Raises:
      InputError: a count or the seed is negative, or there is no scene at all.
    """
    counts = dict(zip(SPLITS, (num_train, num_val, num_test), strict=True))
    for split, count in counts.items():
        if count < 0:
            raise InputError(f"generate_rooms: num_{split} is {count}; give a number of at least 0")
        check_scene_arguments("generate_rooms", split, count, seed)
    if not sum(counts.values()):
        raise InputError("generate_rooms: num_train, num_val and num_test are all 0; ask for at least one scene")
    return [generate_room_at(split, i, seed) for split, count in counts.items() for i in range(count)]


def generate_room_at(split: str, index: int, seed: int) -> Scene:
    """Generate the scene of one split and index.

    It is that of `generate_rooms`; indices begin at 0, and room types take turns.

    Raises:
      InputError: unknown split, or a negative index or seed.
    """
    check_scene_arguments("generate_room_at", split, index, seed)
    room_type = ROOM_TYPES[index % len(ROOM_TYPES)]
    drawn = _draw_room(room_type, np.random.default_rng((seed, SPLITS.index(split), index)))
    walls, furniture = wall_mask(drawn.furniture.shape), drawn.furniture
    return make_scene(f"{split}-{room_type}-{index:03d}", "rooms", room_type, split, walls, drawn.reach, furniture)


class DrawnRoom(NamedTuple):
    """Hold a furnished room.

    Attributes:
      furniture: the room.
      reach: bool [nz, nx], its standable cells.
    """

    furniture: FurnishedRoom
    reach: np.ndarray


def _draw_room(room_type: str, rng: np.random.Generator) -> DrawnRoom:
    """Draw a room of a type.

    It can be walked through, and a standable cell is near every target.
    """
    statistics = room_statistics()[room_type]
    while True:
        # Between the measured quartiles the logarithm of the number of cells is uniform.
        cells = np.exp(np.interp(rng.random(), np.linspace(0.0, 1.0, 5), np.log(statistics.cells)))
        contents = draw_contents(statistics.items, rng)
        size = cells  # that the room is drawn for: corrected by how many the furniture leaves
        for _ in range(ATTEMPTS):
            notched = rng.random() < statistics.l_shape
            shape = draw_shape(size, statistics.fill, statistics.margin, statistics.aspect, notched, rng)
            room = furnish(FurnishedRoom(shape), statistics.items, contents, rng)
            if room is None:
                size *= 1.05
                continue
            reach, whole = _standable(room)
            ratio = reach.sum() / cells
            if abs(ratio - 1.0) < CELLS_TOLERANCE and whole and _all_near(reach, room):
                return DrawnRoom(room, reach)
            size *= np.clip(ratio, 0.7, 1.4) ** -0.7


def _standable(room: FurnishedRoom) -> tuple[np.ndarray, bool]:
    """Return the standable cells, bool [nz, nx].

    Also return whether they are nearly all free cells.
    """
    free = free_cells(wall_mask(room.shape), room.boxes)
    reach = connected(free)
    return reach, bool(reach.sum() >= CONNECTED_SHARE * free.sum())


def connected(free: np.ndarray) -> np.ndarray:
    """Return the largest connected part of cells, bool [nz, nx]."""
    reach = np.zeros_like(free)
    reach[tuple(standable_cells(free).T)] = True
    return reach


def free_cells(walls: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the cells where the agent can stand.

    There is room for a disc of its radius.

    Args:
      walls: bool [nz, nx].
      boxes: float64 [N, 2, 3], low and high corners (x, y, z) from the low corner of cell [1, 1].

    Returns:
      bool [nz, nx].
    """
    return away_from_boxes(away_from_walls(walls), boxes)


def away_from_walls(walls: np.ndarray) -> np.ndarray:
    """Return the cells far enough from walls, bool [nz, nx].

    Everything outside is wall.
    """
    # Cell centres are 0.125 m from a neighbouring wall, 0.177 m from a diagonal one and 0.375 m from the next.
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(walls, 1, constant_values=True), (3, 3))
    return np.logical_not(windows.any(axis=(2, 3)))


def away_from_boxes(free: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the free cells far enough from boxes.

    Args:
      free: bool [nz, nx].
      boxes: float64 [N, 2, 3], see `free_cells`.

    Returns:
      bool [nz, nx].
    """
    free = free.copy()
    iz, ix = np.nonzero(free)
    centres = CELL * (np.stack([ix, iz], axis=-1) - 0.5)
    low_height, high_height = OBSTACLE_HEIGHTS
    boxes = boxes[(boxes[:, 0, 1] < high_height) & (boxes[:, 1, 1] > low_height)][:, :, [0, 2]]
    away = np.maximum(np.maximum(boxes[:, 0] - centres[:, None], centres[:, None] - boxes[:, 1]), 0.0)
    free[iz, ix] = (np.linalg.norm(away, axis=-1) >= AGENT_RADIUS).all(axis=1)
    return free


def _all_near(reach: np.ndarray, room: FurnishedRoom) -> bool:
    """Return whether a standable cell is near every target."""
    targets = room.boxes[[name in TARGETS for name in room.types]].mean(axis=1)[:, [0, 2]]
    centres = CELL * (np.argwhere(reach)[:, ::-1] - 0.5)
    distances = np.linalg.norm(targets[:, None] - centres, axis=-1)
    return bool((distances.min(axis=1, initial=np.inf) <= FIND_DISTANCE).all())


def make_scene(
    name: str, world: str, room_type: str, split: str, walls: np.ndarray, reach: np.ndarray, furniture: FurnishedRoom
) -> Scene:
    """Build the scene of a furnished room.

    The world's origin is at a cell in its middle.
    """
    nz, nx = walls.shape
    origin = (-CELL * (nx // 2), -CELL * (nz // 2))
    low, high = furniture.boxes[:, 0], furniture.boxes[:, 1]
    shift = (origin[0] + CELL / 2, 0.0, origin[1] + CELL / 2)
    boxes = np.round(np.concatenate([(low + high) / 2 + shift, high - low], axis=1), 3)
    return Scene(
        name=name,
        world=world,
        room_type=room_type,
        split=split,
        origin=origin,
        reach=reach,
        walls=walls,
        types=tuple(furniture.types),
        boxes=boxes,
        yaws=90.0 * np.array(furniture.turns),
        parents=np.array(furniture.parents),
    )
