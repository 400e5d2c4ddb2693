"""The builder of tiny scenes: drawn by hand, as a corridor, or at random.

Scenes are drawn with row 0 (the smallest z) first; the origin is (0, 0), so cell [iz, ix] is at x = ix / 4, z = iz / 4.
`support.tiny_world` compiles two of them into a world with policies.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules

#: Type, centre x, y, z and full size sx, sy, sz in metres.
DrawnObject = tuple[str, float, float, float, float, float, float]

CATEGORIES = ("Book", "Chair", "Fridge")
BOOK, CHAIR, FRIDGE = range(3)
SMALL = (0.6, 0.6, 0.05)  # size 0.6, so detected up to 5 m; not opaque, for it is too thin

#: The table of docs/environment.md.
ROOMS = Rules(
    headings=8,
    horizons=(0.0, 30.0),
    field_of_view=(100.0, 100.0),
    camera=1.5,
    success="seen",
    success_distance=1.5,
)
APARTMENTS = Rules(
    headings=12,
    horizons=(0.0, 30.0),
    field_of_view=(79.0, 63.5),
    camera=1.5,
    front_cell="move",
    success="seen",
    success_distance=1.0,
)
HOUSES = Rules(
    headings=12,
    horizons=(0.0,),
    field_of_view=(79.0, 63.5),
    camera=0.88,
    front_cell="move",
    success="near",
    success_distance=1.0,
)


def draw(
    rows: Sequence[str | Sequence[str]],
    *objects: DrawnObject,
    walls: Iterable[tuple[int, int]] = (),
    origin: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """Return a kitchen of the training split.

    Args:
      rows: nz rows of nx marks, `.` for a standable cell.
      *objects: objects without a parent.
      walls: wall cells [iz, ix].
      origin: x and z of cell [0, 0] in metres.
    """
    standable = np.array([list(row) for row in rows]) == "."
    wall_mask = np.zeros_like(standable)
    for cell in walls:
        wall_mask[cell] = True
    types = [drawn_object[0] for drawn_object in objects]
    boxes = np.array([drawn_object[1:] for drawn_object in objects], dtype=np.float64).reshape(-1, 6)
    return _build_scene("drawn", standable, wall_mask, types, boxes, origin)


def corridor_scene(num_cells: int) -> Scene:
    """Return a corridor along z, one cell wide, with a book in its last cell."""
    return draw(["."] * num_cells, ("Book", 0.0, 0.8, (num_cells - 1) / 4, *SMALL))


def coarse_scene(seed: int) -> Scene:
    """Draw random cells, walls and boxes on coarse steps, so that lengths are often exactly equal to limits."""
    rng = np.random.default_rng(seed)
    standable = rng.random((7, 8)) < 0.6
    walls = rng.random((7, 8)) < 0.1  # some of them under standable cells
    types, boxes = _coarse_boxes(rng, count=24, extent=18)
    return _build_scene(f"coarse-{seed}", standable, walls, types, boxes, (0.5, -0.25))


def maze_scene(seed: int) -> Scene:
    """Draw nine chambers with boxes; the walls between them are one cell wide, and most have a door."""
    rng = np.random.default_rng(seed)
    wall_lines = (3, 7)
    walls = np.zeros((11, 11), bool)
    for line in wall_lines:
        walls[line] = True
        walls[:, line] = True

    # A door in most walls between two chambers, which begin at lines 0, 4 and 8.
    for line in wall_lines:
        for chamber in (0, 4, 8):
            if rng.random() < 0.8:
                walls[line, chamber + rng.integers(3)] = False
            if rng.random() < 0.8:
                walls[chamber + rng.integers(3), line] = False

    types, boxes = _coarse_boxes(rng, count=24, extent=22)
    return _build_scene(f"maze-{seed}", ~walls, walls, types, boxes, (-1.0, 0.75))


def _coarse_boxes(rng: np.random.Generator, count: int, extent: int) -> tuple[list[str], np.ndarray]:
    """Draw types and boxes [count, 6] whose centres are on steps of an eighth, up to `extent` steps."""
    centres = rng.integers(-2, extent, (count, 3)) / 8
    sizes = rng.choice([0.05, 0.09, 0.25, 0.3, 0.5], (count, 3))
    boxes = np.concatenate([centres, sizes], axis=1)

    # Furniture, most of it on the floor, some of it just opaque.
    is_tall = rng.random(count) < 0.4
    boxes[is_tall, 4] = rng.choice([0.8, 0.85, 0.88, 1.2, 1.8], is_tall.sum())
    clearance = rng.choice([0.0, 0.3, 0.35], is_tall.sum(), p=[0.8, 0.1, 0.1])
    boxes[is_tall, 1] = boxes[is_tall, 4] / 2 + clearance
    return rng.choice((*ITHOR_CATEGORIES[:12], "Stool", "Vase"), count).tolist(), boxes


def _build_scene(
    name: str,
    standable: np.ndarray,
    walls: np.ndarray,
    types: Sequence[str],
    boxes: np.ndarray,
    origin: tuple[float, float],
) -> Scene:
    return Scene(
        name=name,
        world="drawn",
        room_type="kitchen",
        split="train",
        origin=origin,
        reach=standable,
        walls=walls,
        types=tuple(types),
        boxes=boxes,
        yaws=np.zeros(len(boxes)),
        parents=np.full(len(boxes), -1),
    )
