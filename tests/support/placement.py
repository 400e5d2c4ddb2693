"""Checks that a generated scene is physically sound."""

import numpy as np

from jaxnav.scenes.scene import CELL_SIZE, Scene

MILLIMETRES = 2e-3  # boxes are rounded to 1 mm


def corners(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and high corners [N, 3] of boxes."""
    return boxes[:, :3] - boxes[:, 3:] / 2, boxes[:, :3] + boxes[:, 3:] / 2


def cell_centres(scene: Scene, mask: np.ndarray) -> np.ndarray:
    """Return x, z [C, 2] of a mask's cells."""
    return np.asarray(scene.origin) + CELL_SIZE * np.argwhere(mask)[:, ::-1]


def check_form(scene: Scene) -> None:
    """Check masks, origin, and shapes of what describes objects."""
    assert scene.reach.shape == scene.walls.shape
    assert scene.reach.dtype == scene.walls.dtype == bool
    assert not (scene.reach & scene.walls).any()
    rim = np.ones_like(scene.walls)
    rim[1:-1, 1:-1] = False
    assert scene.walls[rim].all()
    assert np.remainder(np.asarray(scene.origin), CELL_SIZE).tolist() == [0.0, 0.0]
    n = len(scene.types)
    assert scene.boxes.shape == (n, 6)
    assert scene.yaws.shape == scene.parents.shape == (n,)
    assert ((scene.parents >= -1) & (scene.parents < np.arange(n))).all()


def check_nothing_overlaps(scene: Scene) -> None:
    """Check that boxes meet neither walls nor each other.

    What lies on a sofa or a shelf is inside its box.
    """
    low, high = corners(scene.boxes)
    walls = cell_centres(scene, scene.walls)
    depth = np.minimum(high[:, None, ::2], walls + CELL_SIZE / 2) - np.maximum(low[:, None, ::2], walls - CELL_SIZE / 2)
    assert not (depth > MILLIMETRES).all(axis=-1).any(), scene.name
    overlap = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low) > MILLIMETRES).all(axis=-1)
    related = scene.parents[:, None] == np.arange(len(low))
    assert not (overlap & ~related & ~related.T & ~np.eye(len(low), dtype=bool)).any(), scene.name


def check_agent_fits(scene: Scene, radius: float) -> None:
    """Check that obstacles are `radius` metres away from standable cells."""
    low, high = corners(scene.boxes)
    obstacle = (low[:, 1] < 1.7) & (high[:, 1] > 0.1)
    cells = cell_centres(scene, scene.reach)[:, None]
    nearest = np.clip(cells, low[obstacle][:, [0, 2]], high[obstacle][:, [0, 2]])
    assert np.linalg.norm(cells - nearest, axis=-1).min() >= radius - MILLIMETRES, scene.name
