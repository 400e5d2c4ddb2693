"""Tiny scenes drawn by hand, and the plain-Python twin in them.

Scenes are drawn with row 0 (the smallest z) first; the origin is (0, 0), so cell [iz, ix] is at x = ix / 4, z = iz / 4.
"""

import numpy as np
from twin import Twin

from jaxnav.scenes.scene import Scene

CATEGORIES = ("Book", "Chair", "Fridge")
BOOK, CHAIR, FRIDGE = range(3)
SMALL = (0.6, 0.6, 0.05)  # size 0.6, so detected up to 5 m; not opaque, for it is too thin


def draw(rows, *objects, walls=(), origin=(0.0, 0.0)):
    """A scene of objects (type, x, y, z, sx, sy, sz) with wall cells (iz, ix)."""
    reach = np.array([[mark == "." for mark in row] for row in rows])
    solid = np.zeros_like(reach)
    for cell in walls:
        solid[cell] = True
    return Scene(
        name="drawn",
        world="drawn",
        room_type="kitchen",
        split="train",
        origin=origin,
        reach=reach,
        walls=solid,
        types=tuple(item[0] for item in objects),
        boxes=np.array([item[1:] for item in objects], dtype=np.float64).reshape(-1, 6),
        yaws=np.zeros(len(objects)),
        parents=np.full(len(objects), -1),
    )


def twin(scene, goal=BOOK, cell=(0, 0), heading=0, horizon=0, step_limit=100):
    return Twin(scene, CATEGORIES, goal, cell, heading, horizon, step_limit)


def single(*objects, walls=(), **start):
    """The twin at the one standable cell [0, 0] of a lattice of 16 x 4 cells."""
    return twin(draw([".###"] + ["####"] * 15, *objects, walls=walls), **start)


def detected(episode):
    return {category for category, row in enumerate(episode.detections()) if row}
