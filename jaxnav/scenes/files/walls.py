"""Walls of scenes whose files have none."""

import numpy as np

from jaxnav.scenes.scene import CELL

_WALL_DISTANCE = 3  # cells
_BOX_DISTANCE = 0.25 + 1e-9  # metres


def derive_walls(reach: np.ndarray, origin: tuple[float, float], boxes: np.ndarray) -> np.ndarray:
    """Return the cells that can be neither floor nor furniture.

    Args:
      reach: bool [nz, nx], standable cells.
      origin: world (x, z) in metres of the centre of cell [0, 0].
      boxes: float [N, 6], centre and full size of the objects in metres.

    Returns:
      bool [nz, nx], True where every standable cell is three or more cells away in x or in z, and every box more than
      0.25 m (horizontally) from the cell's centre.
    """
    reachable = _WALL_DISTANCE - 1
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(reach, reachable), (2 * reachable + 1,) * 2)
    walls = np.logical_not(windows.any(axis=(2, 3)))
    x = origin[0] + CELL * np.arange(reach.shape[1])
    z = origin[1] + CELL * np.arange(reach.shape[0])
    for box in boxes:
        dx = np.maximum(np.abs(x - box[0]) - box[3] / 2, 0.0)
        dz = np.maximum(np.abs(z - box[2]) - box[5] / 2, 0.0)
        near = np.ix_(dz <= _BOX_DISTANCE, dx <= _BOX_DISTANCE)
        walls[near] &= np.hypot(dz[near[0]], dx[near[1]]) > _BOX_DISTANCE
    return walls
