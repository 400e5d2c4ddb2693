"""Scenes drawn by hand or at random, and their twins.

Scenes are drawn with row 0 (the smallest z) first; the origin is (0, 0), so cell [iz, ix] is at x = ix / 4, z = iz / 4.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Rules
from support.twin import Twin

#: Type, centre x, y, z and full size sx, sy, sz in metres.
Object = tuple[str, float, float, float, float, float, float]

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
    success="seen",
    success_distance=1.0,
)
HOUSES = Rules(
    headings=12,
    horizons=(0.0,),
    field_of_view=(79.0, 63.5),
    camera=0.88,
    success="near",
    success_distance=1.0,
)


def draw(
    rows: Sequence[str | Sequence[str]],
    *objects: Object,
    walls: Iterable[tuple[int, int]] = (),
    origin: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """Return a scene with objects and wall cells (iz, ix)."""
    reach = np.array([[mark == "." for mark in row] for row in rows])
    solid = np.zeros_like(reach)
    for cell in walls:
        solid[cell] = True
    boxes = np.array([item[1:] for item in objects], dtype=np.float64).reshape(-1, 6)
    return _scene("drawn", reach, solid, [item[0] for item in objects], boxes, origin)


def coarse_scene(seed: int) -> Scene:
    """Draw cells, walls and boxes at random on coarse steps.

    Lengths often lie exactly on their limits.
    """
    draws = np.random.default_rng(seed)
    reach = draws.random((7, 8)) < 0.6
    walls = draws.random((7, 8)) < 0.1  # some of them under standable cells
    return _scene(f"coarse-{seed}", reach, walls, *_coarse_boxes(draws, 24, 18), (0.5, -0.25))


def maze_scene(seed: int) -> Scene:
    """Draw nine chambers with thin walls, and boxes.

    Walls are one cell wide, and most have a door.
    """
    draws = np.random.default_rng(seed)
    walls = np.zeros((11, 11), bool)
    for line in (3, 7):
        walls[line], walls[:, line] = True, True
    for line in (3, 7):
        for chamber in (0, 4, 8):
            if draws.random() < 0.8:
                walls[line, chamber + draws.integers(3)] = False
            if draws.random() < 0.8:
                walls[chamber + draws.integers(3), line] = False
    return _scene(f"maze-{seed}", ~walls, walls, *_coarse_boxes(draws, 24, 22), (-1.0, 0.75))


def _coarse_boxes(draws: np.random.Generator, count: int, extent: int) -> tuple[list[str], np.ndarray]:
    centres, sides = draws.integers(-2, extent, (count, 3)) / 8, draws.choice([0.05, 0.09, 0.25, 0.3, 0.5], (count, 3))
    boxes = np.concatenate([centres, sides], axis=1)
    tall = draws.random(count) < 0.4  # furniture on the floor, some of it just opaque
    boxes[tall, 4] = draws.choice([0.8, 0.85, 0.88, 1.2, 1.8], tall.sum())
    boxes[tall, 1] = boxes[tall, 4] / 2 + draws.choice([0.0, 0.3, 0.35], tall.sum(), p=[0.8, 0.1, 0.1])
    return draws.choice((*ITHOR_CATEGORIES[:12], "Stool", "Vase"), count).tolist(), boxes


def _scene(
    name: str,
    reach: np.ndarray,
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
        reach=reach,
        walls=walls,
        types=tuple(types),
        boxes=boxes,
        yaws=np.zeros(len(boxes)),
        parents=np.full(len(boxes), -1),
    )


def twin(
    scene: Scene,
    goal: int = BOOK,
    cell: tuple[int, int] = (0, 0),
    heading: int = 0,
    horizon: int = 0,
    step_limit: int = 100,
    rules: Rules = ROOMS,
) -> Twin:
    return Twin(scene, CATEGORIES, rules, goal, cell, heading, horizon, step_limit)


def single(*objects: Object, walls: Iterable[tuple[int, int]] = (), **start: Any) -> Twin:
    """Return the twin in a lattice with one cell.

    The standable cell is [0, 0] of 16 x 4.
    """
    return twin(draw([".###"] + ["####"] * 15, *objects, walls=walls), **start)


def detected(episode: Twin) -> set[int]:
    """Return the categories that are detected."""
    return {category for category, row in enumerate(episode.detections()) if row}
