"""Polygons and boxes on the lattice."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxnav.scenes.files.importers.assemble import SNAP
from jaxnav.scenes.lattice import connected_parts
from jaxnav.scenes.scene import CELL
from jaxnav.scenes.tables.visibility import TOLERANCE


def is_simple(corners: np.ndarray) -> bool:
    """Return whether a polygon neither crosses nor touches itself.

    Its corners are [P, 2], P >= 3.
    """
    edges = np.roll(corners, -1, axis=0) - corners
    folds = (_cross(edges, np.roll(edges, -1, axis=0)) == 0) & ((edges * np.roll(edges, -1, axis=0)).sum(axis=1) <= 0)
    side = np.sign(_cross(edges[:, None], corners - corners[:, None]))  # of edge i, on which corner j lies
    straddled = side * np.roll(side, -1, axis=1) <= 0  # edge j does not lie on one side of the line of edge i
    low = np.minimum(corners, corners + edges)
    high = np.maximum(corners, corners + edges)
    overlap = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=-1)  # decides where edges are on one line
    apart = np.subtract.outer(np.arange(len(corners)), np.arange(len(corners))) % len(corners)
    follows = (apart <= 1) | (apart == len(corners) - 1)
    return not (folds.any() or (straddled & straddled.T & overlap & ~follows).any())


def inside(corners: np.ndarray, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return which lattice points a polygon encloses.

    A point on an edge that two polygons share is in exactly one of them: in the one beyond it in x, or else in z.

    Args:
      corners: float64 [P, 2], (x, z) in metres.
      x, z: float64 [nx] and [nz], ascending.

    Returns:
      bool [nz, nx].
    """
    (ax, az), (bx, bz) = corners.T, np.roll(corners, -1, axis=0).T
    rows, edges = np.nonzero((az <= z[:, None]) != (bz <= z[:, None]))  # the edges that cross the line through a row
    share = (z[rows] - az[edges]) / (bz - az)[edges]
    crossings = ax[edges] + share * (bx - ax)[edges]
    toggles = np.zeros((len(z), len(x) + 1), np.int64)
    np.add.at(toggles, (rows, np.searchsorted(x, crossings)), 1)
    return toggles.cumsum(axis=1)[:, :-1] % 2 == 1


def without_openings(line: np.ndarray, openings: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the pieces of a wall between openings.

    Args:
      line: float64 [2, 2], both ends (x, z) of the wall, along x or z, metres.
      openings: both ends of each, also of those in other walls.

    Returns:
      Low and high corner [2, 2] of each piece.
    """
    low, high = line.min(axis=0), line.max(axis=0)
    along = int(np.argmax(high - low))
    across = 1 - along
    spans = sorted(sorted(ends[:, along]) for ends in openings if np.abs(ends[:, across] - low[across]).max() <= SNAP)
    pieces = []
    for first, last in [*spans, (high[along], high[along])]:
        piece = np.stack([low, high])
        piece[1, along] = min(first, high[along])
        if piece[0, along] < piece[1, along]:
            pieces.append(piece)
        low[along] = max(low[along], last)
    return pieces


def touched(boxes: np.ndarray, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the cells that any box touches, bool [nz, nx].

    A cell is a closed square of 0.25 m.

    Args:
      boxes: float64 [M, 2, 2], low and high corner (x, z), metres.
      x, z: float64 [nx] and [nz], centres of the cells.
    """
    mask = np.zeros((len(z), len(x)), bool)
    for _, window in _windows(boxes, x, z, CELL / 2 + TOLERANCE):
        mask[window] = True
    return mask


def nearer(boxes: np.ndarray, x: np.ndarray, z: np.ndarray, distance: float) -> np.ndarray:
    """Return the cells nearer than `distance` to any box.

    Args:
      boxes: float64 [M, 2, 2], low and high corner (x, z), metres.
      x, z: float64 [nx] and [nz], centres of the cells.
      distance: of a cell's centre, metres.

    Returns:
      bool [nz, nx].
    """
    mask = np.zeros((len(z), len(x)), bool)
    for (low, high), (rows, columns) in _windows(boxes, x, z, distance):
        dx = np.maximum(np.maximum(low[0] - x[columns], x[columns] - high[0]), 0.0)
        dz = np.maximum(np.maximum(low[1] - z[rows], z[rows] - high[1]), 0.0)
        mask[rows, columns] |= np.hypot(dz[:, None], dx[None]) < distance - TOLERANCE
    return mask


def connected_part(free: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the 8-connected part of a cell, bool [nz, nx].

    It is the part of `free`, bool [nz, nx], with its cell `start` (iz, ix).
    """
    part = next(part for part in connected_parts(free) if (part == start).all(axis=1).any())
    mask = np.zeros_like(free)
    mask[tuple(part.T)] = True
    return mask


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _windows(
    boxes: np.ndarray, x: np.ndarray, z: np.ndarray, margin: float
) -> Iterator[tuple[np.ndarray, tuple[slice, slice]]]:
    """Yield each box with the rows and columns near it.

    Their coordinates are at most `margin` from the box.
    """
    low, high = boxes[:, 0] - margin, boxes[:, 1] + margin
    columns = zip(np.searchsorted(x, low[:, 0]), np.searchsorted(x, high[:, 0], "right"), strict=True)
    rows = zip(np.searchsorted(z, low[:, 1]), np.searchsorted(z, high[:, 1], "right"), strict=True)
    for box, row, column in zip(boxes, rows, columns, strict=True):
        yield box, (slice(*row), slice(*column))
