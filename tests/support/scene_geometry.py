"""Geometry of scenes: world coordinates of cells, connected parts of masks, and checks that a scene is sound."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxnav.scenes.scene import CELL_SIZE, Scene

Points = set[tuple[float, float]]

#: Which cells around a cell are its neighbours, bool [3, 3].
FOUR = ndimage.generate_binary_structure(2, 1)
EIGHT = ndimage.generate_binary_structure(2, 2)
#: Tolerance of lengths in metres: boxes are rounded to 1 mm.
MILLIMETRES = 2e-3


class Parts(NamedTuple):
    """Connected parts of a mask.

    Attributes:
      labels: int [nz, nx], part of each cell from 1; 0 outside of the mask.
      number: number of parts.
    """

    labels: np.ndarray
    number: int


def parts_of(mask: np.ndarray, neighbours: np.ndarray) -> Parts:
    """Return the connected parts of a mask bool [nz, nx], by SciPy."""
    labels = np.zeros(mask.shape, int)
    ndimage.label(mask, neighbours, output=labels)
    return Parts(labels, int(labels.max()))


def cell_centres(scene: Scene, mask: np.ndarray) -> np.ndarray:
    """Return x and z [C, 2] of the cells in a mask bool [nz, nx]."""
    return np.asarray(scene.origin) + CELL_SIZE * np.argwhere(mask)[:, ::-1]


def points_of(scene: Scene, mask: np.ndarray) -> Points:
    """Return the points (x, z) of the cells in a mask bool [nz, nx]."""
    return {(x, z) for x, z in cell_centres(scene, mask).tolist()}


def block(x0: float, x1: float, z0: float, z1: float) -> Points:
    """Return the lattice points (x, z) of a rectangle."""
    points = set()
    for x in np.arange(x0, x1 + 0.1, CELL_SIZE).tolist():
        for z in np.arange(z0, z1 + 0.1, CELL_SIZE).tolist():
            points.add((x, z))
    return points


def corners(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and high corners [N, 3] of boxes [N, 6]."""
    half_sizes = boxes[:, 3:] / 2
    return boxes[:, :3] - half_sizes, boxes[:, :3] + half_sizes


def check_form(scene: Scene) -> None:
    """Check masks, origin, and the shapes of everything that describes objects."""
    # Standable cells and walls are disjoint, and walls enclose the lattice.
    assert scene.reach.shape == scene.walls.shape
    assert scene.reach.dtype == scene.walls.dtype == bool
    assert not (scene.reach & scene.walls).any()
    rim = np.ones_like(scene.walls)
    rim[1:-1, 1:-1] = False
    assert scene.walls[rim].all()
    assert np.remainder(np.asarray(scene.origin), CELL_SIZE).tolist() == [0.0, 0.0]

    # Parents come before their children.
    num_objects = len(scene.types)
    assert scene.boxes.shape == (num_objects, 6)
    assert scene.yaws.shape == scene.parents.shape == (num_objects,)
    assert ((scene.parents >= -1) & (scene.parents < np.arange(num_objects))).all()


def check_nothing_overlaps(scene: Scene) -> None:
    """Check that boxes meet neither walls nor each other, except for an object inside its parent's box."""
    low, high = corners(scene.boxes)

    # Depth of each box in each wall cell, along x and z: [N, C, 2].
    wall_centres = cell_centres(scene, scene.walls)
    wall_low = np.maximum(low[:, None, ::2], wall_centres - CELL_SIZE / 2)
    wall_high = np.minimum(high[:, None, ::2], wall_centres + CELL_SIZE / 2)
    assert not (wall_high - wall_low > MILLIMETRES).all(axis=-1).any(), scene.name

    # Pairs of boxes [N, N], apart from an object with itself or its parent.
    depth = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    overlaps = (depth > MILLIMETRES).all(axis=-1)
    is_parent = scene.parents[:, None] == np.arange(len(low))
    is_same = np.eye(len(low), dtype=bool)
    assert not (overlaps & ~is_parent & ~is_parent.T & ~is_same).any(), scene.name


def check_agent_fits(scene: Scene, radius: float) -> None:
    """Check that obstacles are at least `radius` metres away from standable cells."""
    low, high = corners(scene.boxes)
    is_obstacle = (low[:, 1] < 1.7) & (high[:, 1] > 0.1)
    standable_centres = cell_centres(scene, scene.reach)[:, None]
    nearest_points = np.clip(standable_centres, low[is_obstacle][:, [0, 2]], high[is_obstacle][:, [0, 2]])
    assert np.linalg.norm(standable_centres - nearest_points, axis=-1).min() >= radius - MILLIMETRES, scene.name
