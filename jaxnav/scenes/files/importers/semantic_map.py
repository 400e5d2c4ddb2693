"""Semantic floor maps of SemExp (`*_info.pbz2`), and their scenes.

A map has what episode files lack, the free floor, in layers of 0 and 1 at 5 cm. Its pixel [i, j] covers Habitat's x
from `origin[1] + 5 i` to `+ 5` cm, and Habitat's z from `origin[0] + 5 j` to `+ 5` cm.
"""

import dataclasses
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import GIBSON_CATEGORIES
from jaxnav.scenes.files.importers.assemble import Thing, scene_of_cells
from jaxnav.scenes.files.importers.pickled_arrays import PickledArray, read_pickle
from jaxnav.scenes.files.record import Record
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import connected_parts
from jaxnav.scenes.scene import Scene

_LAYERS = 1 + len(GIBSON_CATEGORIES)  # navigable floor, then the categories in this order
_MAX_SIDE = 2000  # pixels, 100 m
_PIXEL, _CELL = 5, 25  # centimetres
_FAR = 10**7  # centimetres of an origin, or pixels; a greater number is a mistake
_MIN_PIXELS = 3  # of an object; less is noise

_MIN_FREE = 8  # of the 25 pixels of a cell, for it to be standable; narrow doors have few

# A strip this wide (pixels) between floor on both sides, and this long (cells), is a wall. The floor of a map ends 0.1
# to 0.2 m before an obstacle, so the obstacle is at most 0.4 m thick, yet 1 m long, unlike usual furniture. The cells
# on both sides of a narrow strip may have enough free pixels to be standable, and would be neighbours.
_STRIP_WIDTH = (4, 12)
_NARROW_STRIP = (4, 6)
_STRIP_LENGTH = 4
_NARROW_ROWS = 3  # of the 5 of a cell that a narrow strip crosses; with fewer there is room for a door


class FloorMap(NamedTuple):
    """Hold the map of one floor.

    Attributes:
      height: of the floor, metres, Habitat's y.
      origin: Habitat's (x, z) of the low corner of pixel [0, 0], whole centimetres.
      layers: bool [16, nx, nz], the navigable floor and then `GIBSON_CATEGORIES`.
    """

    height: float
    origin: tuple[int, int]
    layers: np.ndarray


def read_maps(path: Path) -> dict[str, dict[int, Record]]:
    """Read the floors of every scene by their numbers.

    Each is to be checked by `floor_map`.

    Raises:
      InputError: the file cannot be read (`read_pickle`) or holds something else.
    """
    scenes = read_pickle(path)
    if not isinstance(scenes, dict) or not scenes or not all(isinstance(name, str) and name for name in scenes):
        raise InputError(f"{path}: holds no maps by name of scene; give a file like val_info.pbz2")
    maps: dict[str, dict[int, Record]] = {}
    for name, floors in scenes.items():
        where = f"{path}, scene {reprlib.repr(name)}"
        if not isinstance(floors, dict) or not floors or not all(type(k) is int and 0 <= k < 1000 for k in floors):
            raise InputError(f"{where}: has no floors by number; give 0, 1, ...")
        maps[name] = {
            k: Record(f"{where}: floor {k}", floor if isinstance(floor, dict) else {}) for k, floor in floors.items()
        }
    return maps


def floor_map(record: Record) -> FloorMap:
    """Check the map of a floor.

    Raises:
      InputError: a field is missing or wrong.
    """
    height, origin, layers = (record.get(field) for field in ("floor_height", "origin", "sem_map"))
    if type(height) not in (int, float) or not abs(height) < _FAR:
        raise record.error("floor_height", "is no finite number; give metres")
    corner = origin.values.astype(float) if isinstance(origin, PickledArray) else np.zeros(0)
    if corner.shape != (2,) or not (np.abs(corner) < _FAR).all():
        raise record.error("origin", "is no array of two finite numbers; give (z, x) in centimetres")
    shape = layers.values.shape if isinstance(layers, PickledArray) else ()
    if len(shape) != 3 or shape[0] != _LAYERS or not 0 < min(shape) <= max(shape) <= _MAX_SIDE:
        expected = f"[{_LAYERS}, H, W] with sides up to {_MAX_SIDE}"
        raise record.error("sem_map", f"is no array {expected}; give the floor and {_LAYERS - 1} categories")
    if not ((layers.values == 0) | (layers.values == 1)).all():
        raise record.error("sem_map", "holds other values than 0 and 1; give layers of 0 and 1")
    z, x = np.rint(corner).astype(int).tolist()
    return FloorMap(float(height), (x, z), layers.values == 1)


def scene_of_map(record: Record, name: str, split: str, floor: FloorMap) -> Scene:
    """Build the scene of one floor.

    Its x is Habitat's, its z is minus Habitat's. A cell is standable if at least 8 of its 25 pixels are navigable: the
    agent's radius is clear of obstacles there already. An object is a connected part of a category's layer, at the
    typical height. Walls are the cells far from everything (`derive_walls`) and thin strips that divide the floor.

    Raises:
      InputError: the floor has no standable cell or no object.
    """
    free = _per_cell(floor, floor.layers[0]) >= _MIN_FREE
    reach = free & ~_long_parts(_strips(floor, _NARROW_STRIP, _NARROW_ROWS))
    cells, things = _cells(floor, reach), list(_things(floor))
    if not len(cells):
        raise record.error("sem_map", f"has no cell with {_MIN_FREE} pixels of layer 0; leave the floor out")
    if not things:
        raise record.error("sem_map", "has no object in layers 1 and up; leave the floor out")
    scene = scene_of_cells(name, "gibson", "house", split, cells, things)
    thin = _cells(floor, _long_parts(_strips(floor, _STRIP_WIDTH, 1) & ~reach))
    index = thin - np.rint(np.divide(scene.origin[::-1], _CELL / 100)).astype(int)
    walls = scene.walls.copy()
    walls[tuple(index[((index >= 0) & (index < walls.shape)).all(axis=1)].T)] = True
    return dataclasses.replace(scene, walls=walls)


def _lattice(low: int, count: int) -> np.ndarray:
    """Return the lattice index nearest to each pixel along an axis."""
    return (2 * (low + _PIXEL * np.arange(count)) + _PIXEL + _CELL) // (2 * _CELL)


def _per_cell(floor: FloorMap, mask: np.ndarray) -> np.ndarray:
    """Count the pixels of a mask [nx, nz] in each cell.

    Returns:
      int [cells along x, cells along Habitat's z]; a whole cell has 25 pixels.
    """
    x, z = (_lattice(low, count) for low, count in zip(floor.origin, mask.shape, strict=True))
    counts = np.zeros((np.ptp(x) + 1, np.ptp(z) + 1), np.int64)
    np.add.at(counts, np.ix_(x - x[0], z - z[0]), mask)
    return counts


def _cells(floor: FloorMap, mask: np.ndarray) -> np.ndarray:
    """Return the lattice indices (iz, ix) of a mask, int [N, 2].

    Its first cell is that of the first pixel.
    """
    x, z = (np.argwhere(mask) + [_lattice(low, 1)[0] for low in floor.origin]).T
    return np.stack([-z, x], axis=1)


def _things(floor: FloorMap) -> Iterator[Thing]:
    for name, layer in zip(GIBSON_CATEGORIES, floor.layers[1:], strict=True):
        _, height, _, y = typical_box(name)
        for part in connected_parts(layer):
            if len(part) >= _MIN_PIXELS:
                low, high = part.min(axis=0), part.max(axis=0) + 1
                x, z = ((floor.origin + _PIXEL * (low + high) / 2) / 100).tolist()
                size_x, size_z = (_PIXEL * (high - low) / 100).tolist()
                yield Thing(name, (x, y, 0.0 - z, size_x, height, size_z))


def _strips(floor: FloorMap, widths: tuple[int, int], rows: int) -> np.ndarray:
    """Return the cells in the middle of thin strips between floor.

    Args:
      floor: the map.
      widths: least and greatest, pixels.
      rows: least number of rows of pixels of a cell that a strip crosses.

    Returns:
      bool [cells along x, cells along Habitat's z].
    """
    free, objects = floor.layers[0], floor.layers[1:].any(axis=0)
    across = (_strip_middles(free, widths), _strip_middles(free.T, widths).T)
    return np.any([_per_cell(floor, middles & ~objects) >= rows for middles in across], axis=0)


def _long_parts(strips: np.ndarray) -> np.ndarray:
    """Return the parts that are long enough for a wall."""
    walls = np.zeros_like(strips)
    for part in connected_parts(strips):
        walls[tuple(part.T)] = len(part) >= _STRIP_LENGTH
    return walls


def _strip_middles(free: np.ndarray, widths: tuple[int, int]) -> np.ndarray:
    """Return the pixels in the middle of a thin gap.

    The gap lies between free pixels of their row, and has one such pixel. bool, of the shape of `free` [H, W].
    """
    column = np.arange(free.shape[1])
    before = np.maximum.accumulate(np.where(free, column, -_FAR), axis=1)
    after = np.minimum.accumulate(np.where(free, column, _FAR)[:, ::-1], axis=1)[:, ::-1]
    width = after - before - 1
    return (width >= widths[0]) & (width <= widths[1]) & (column == (before + after) // 2)
