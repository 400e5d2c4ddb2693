"""Shapes of single rooms: rectangles and L-shapes on the lattice."""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import CELL


class Shape(NamedTuple):
    """Describe a rectangular or L-shaped room.

    It is the rectangle [0, width] x [0, depth] without a notch, a rectangle at one corner.

    Attributes:
      size: float64 [2], width (x) and depth (z) in metres, multiples of 0.25.
      notch: float64 [2, 2], low and high (x, z) corner of the notch; equal where there is none.
      starts: float64 [S, 2], (x, z) where each wall begins, counter-clockwise with x to the right and z up.
      turns: int [S], quarter turns (clockwise from +z) of the direction into the room, across each wall.
      lengths: float64 [S], metres.
    """

    size: np.ndarray
    notch: np.ndarray
    starts: np.ndarray
    turns: np.ndarray
    lengths: np.ndarray


def make_shape(size: np.ndarray, notch: np.ndarray, high: np.ndarray) -> Shape:
    """Make the shape of a room with a notch.

    Args:
      size: float [2], width and depth of the room, metres.
      notch: float [2], width and depth of the notch, metres; 0 for a rectangular room.
      high: bool [2], whether the notch is at the high end in x and z.
    """
    (w, d), (a, b) = size, notch
    # Corners with the notch at high x, high z; the other three are mirror images.
    corners = (
        [(0, 0), (w, 0), (w, d - b), (w - a, d - b), (w - a, d), (0, d)] if a * b else [(0, 0), (w, 0), (w, d), (0, d)]
    )
    corners = np.where(high, corners, size - np.array(corners, float))
    if high[0] != high[1]:  # one mirroring turns the order of the corners around
        corners = corners[::-1]
    step = np.roll(corners, -1, axis=0) - corners
    lengths = np.abs(step).sum(axis=1)
    along = step / lengths[:, None]
    # Left of the wall's direction is inside: (x, z) -> (-z, x). Forward of turn 0..3 is +z, +x, -z, -x.
    turns = np.argmax(np.stack([along[:, 0], -along[:, 1], -along[:, 0], along[:, 1]], axis=1), axis=1)
    low = np.where(high, size - notch, 0.0)
    return Shape(size, np.stack([low, low + notch]), corners, turns, lengths)


def draw_shape(
    cells: float, fill: float, margin: float, aspect: float, notched: bool, rng: np.random.Generator
) -> Shape:
    """Draw a room in which about `cells` cells stay free.

    Args:
      cells: wanted number of standable cells.
      fill: standable share of the rectangle around the standable cells.
      margin: how much wider (and deeper) the room is than that rectangle, metres.
      aspect: the longest possible side of that rectangle, relative to the other.
      notched: whether the room has a notch.
      rng: source of randomness.
    """
    notch_share = rng.uniform(0.3, 0.45, 2) if notched else np.zeros(2)
    area = cells * CELL**2 / fill / (1.0 - notch_share.prod())
    stretch = np.sqrt(rng.uniform(1.0, aspect))
    sides = np.sqrt(area) * np.array([stretch, 1.0 / stretch]) + margin
    size = CELL * np.round(rng.permutation(sides) / CELL)
    return make_shape(size, CELL * np.round(notch_share * size / CELL), rng.random(2) < 0.5)


def inside(shape: Shape, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return whether rectangles lie within the room, bool [K].

    `low` and `high` [K, 2] are their corners (x, z).
    """
    in_notch = ((low < shape.notch[1] - 1e-6) & (high > shape.notch[0] + 1e-6)).all(axis=-1)
    return (low >= -1e-6).all(axis=-1) & (high <= shape.size + 1e-6).all(axis=-1) & ~in_notch


def wall_mask(shape: Shape) -> np.ndarray:
    """Return the cells that are not floor, bool [nz, nx].

    There is a ring of walls around the room, whose origin is the low corner of cell [1, 1].
    """
    nx, nz = np.round(shape.size / CELL).astype(int)
    walls = np.ones((nz + 2, nx + 2), bool)
    walls[1:-1, 1:-1] = False
    (x0, z0), (x1, z1) = 1 + np.round(shape.notch / CELL).astype(int)
    walls[z0:z1, x0:x1] = True
    return walls
