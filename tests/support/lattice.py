"""World coordinates of cells, and the connected parts of masks."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxnav.scenes.scene import CELL_SIZE, Scene

Points = set[tuple[float, float]]

#: Which cells around a cell are its neighbours, bool [3, 3].
FOUR, EIGHT = ndimage.generate_binary_structure(2, 1), ndimage.generate_binary_structure(2, 2)


class Parts(NamedTuple):
    """Describe connected parts: labels from 1, 0 outside; their number."""

    labels: np.ndarray
    number: int


def points_of(scene: Scene, mask: np.ndarray) -> Points:
    """Return the points (x, z) of a mask's cells."""
    return {
        (scene.origin[0] + CELL_SIZE * ix, scene.origin[1] + CELL_SIZE * iz) for iz, ix in np.argwhere(mask).tolist()
    }


def block(x0: float, x1: float, z0: float, z1: float) -> Points:
    """Return the lattice points (x, z) of a rectangle."""
    return {
        (x, z) for x in np.arange(x0, x1 + 0.1, CELL_SIZE).tolist() for z in np.arange(z0, z1 + 0.1, CELL_SIZE).tolist()
    }


def parts_of(mask: np.ndarray, neighbours: np.ndarray) -> Parts:
    """Return the connected parts of a mask, by SciPy."""
    labels = np.zeros(mask.shape, int)
    ndimage.label(mask, neighbours, output=labels)
    return Parts(labels, int(labels.max()))
