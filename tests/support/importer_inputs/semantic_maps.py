"""Semantic floor maps of a home."""

import bz2
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.scenes.categories import GIBSON_CATEGORIES

CHAIR, BED = (1 + GIBSON_CATEGORIES.index(name) for name in ("Chair", "Bed"))


def l_shaped_floor(height: float = 0.0, **changes: object) -> dict[str, Any]:
    """Return a map of a floor with a chair.

    It is 3 x 3 m: Habitat's x is from 2 to 5 m and z from -1 to 2 m; the quarter of large x and z is no floor.
    """
    layers = np.zeros((16, 60, 60))
    layers[0] = 1
    layers[0, 30:, 30:] = 0
    layers[0, 36:54, :18] = 0  # around the chair
    layers[CHAIR, 40:50, 4:14] = 1
    return {"floor_height": height, "sem_map": layers, "origin": np.array([-100, 200])} | changes


def bedroom(height: float = 2.9) -> dict[str, Any]:
    """Return the same walls with a bed, without the chair."""
    floor = l_shaped_floor(height)
    floor["sem_map"][CHAIR] = 0
    floor["sem_map"][BED, 38:52, 2:16] = 1
    return floor


def write_maps(path: Path, maps: object, protocol: int = 4) -> Path:
    path.write_bytes(bz2.compress(pickle.dumps(maps, protocol)))
    return path
