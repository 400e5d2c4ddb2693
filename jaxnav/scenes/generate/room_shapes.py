"""Outlines of generated rooms: rectangles of lattice cells, and rectangular or L-shaped rooms with their walls.

`sample_room_shape` samples the outline of a single room and `wall_mask` rasterizes an outline; `CellRectangle` is the
building block of the floor plans of homes.
"""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import CELL_SIZE


class CellRectangle(NamedTuple):
    """Rectangle of the cells [z0, z1) x [x0, x1)."""

    z0: int
    x0: int
    z1: int
    x1: int

    @property
    def cells(self) -> tuple[slice, slice]:
        """Index into an array [nz, nx]."""
        return slice(self.z0, self.z1), slice(self.x0, self.x1)

    @property
    def area(self) -> int:
        """Number of cells."""
        return (self.z1 - self.z0) * (self.x1 - self.x0)

    @property
    def with_ring(self) -> "CellRectangle":
        """The rectangle enlarged by a ring of cells around it."""
        return CellRectangle(self.z0 - 1, self.x0 - 1, self.z1 + 1, self.x1 + 1)

    def is_inside(self, outer: "CellRectangle") -> bool:
        """Return True if all cells belong to `outer`."""
        return outer.z0 <= self.z0 and self.z1 <= outer.z1 and outer.x0 <= self.x0 and self.x1 <= outer.x1

    def to_box(self, frame: "CellRectangle", height: float) -> np.ndarray:
        """Return the part of the rectangle in `frame` as a box.

        Args:
          frame: rectangle to which the box is clipped; its low corner is the origin.
          height: height of the box, metres.

        Returns:
          float64 [2, 3], low and high corner (x, y, z), metres.
        """
        z_range = np.clip([self.z0, self.z1], frame.z0, frame.z1)
        x_range = np.clip([self.x0, self.x1], frame.x0, frame.x1)
        y_range = np.array([0.0, height])
        return np.stack([CELL_SIZE * (x_range - frame.x0), y_range, CELL_SIZE * (z_range - frame.z0)], axis=-1)


class RoomShape(NamedTuple):
    """Outline of a rectangular or L-shaped room.

    The room is the rectangle [0, width] x [0, depth] without a notch, a rectangle at one corner.

    Attributes:
      size: float64 [2], width (x) and depth (z) in metres, multiples of 0.25.
      notch: float64 [2, 2], low and high (x, z) corner of the notch; equal if the room has none.
      wall_starts: float64 [S, 2], (x, z) where each wall begins, counter-clockwise with x to the right and z up.
      wall_turns: int [S], quarter turns (clockwise from +z) of the direction into the room, across each wall.
      wall_lengths: float64 [S], metres.
    """

    size: np.ndarray
    notch: np.ndarray
    wall_starts: np.ndarray
    wall_turns: np.ndarray
    wall_lengths: np.ndarray


def sample_room_shape(
    num_cells: float, fill: float, margin: float, aspect: float, has_notch: bool, rng: np.random.Generator
) -> RoomShape:
    """Sample the shape of a room in which about `num_cells` cells stay free.

    Args:
      num_cells: target number of standable cells.
      fill: standable share of the rectangle around the standable cells.
      margin: metres by which the room is wider and deeper than this rectangle.
      aspect: the longest possible side of this rectangle, relative to the shorter side.
      has_notch: True for an L-shaped room.
      rng: source of randomness.
    """
    # Area of the rectangle around the room, with a notch that takes up a share of each side.
    notch_share = rng.uniform(0.3, 0.45, 2) if has_notch else np.zeros(2)
    area = num_cells * CELL_SIZE**2 / fill / (1.0 - notch_share.prod())

    # Sides of a rectangle with this area, in random order and rounded to the lattice.
    stretch = np.sqrt(rng.uniform(1.0, aspect))
    sides = np.sqrt(area) * np.array([stretch, 1.0 / stretch]) + margin
    size = CELL_SIZE * np.round(rng.permutation(sides) / CELL_SIZE)

    notch_size = CELL_SIZE * np.round(notch_share * size / CELL_SIZE)
    return make_room_shape(size, notch_size, rng.random(2) < 0.5)


def make_room_shape(size: np.ndarray, notch_size: np.ndarray, is_notch_high: np.ndarray) -> RoomShape:
    """Make the shape of a room with a notch.

    Args:
      size: float [2], width and depth of the room, metres.
      notch_size: float [2], width and depth of the notch, metres; 0 for a rectangular room.
      is_notch_high: bool [2], True where the notch is at the high end in x and z.
    """
    width, depth = size
    notch_width, notch_depth = notch_size

    # Corners with the notch at high x and high z; the other three positions are mirror images.
    corners = [(0, 0), (width, 0), (width, depth), (0, depth)]
    if notch_width * notch_depth:
        notch_corners = [
            (width, depth - notch_depth),
            (width - notch_width, depth - notch_depth),
            (width - notch_width, depth),
        ]
        corners = [*corners[:2], *notch_corners, corners[3]]
    corners = np.where(is_notch_high, corners, size - np.array(corners, float))
    if is_notch_high[0] != is_notch_high[1]:  # a single mirroring reverses the order of the corners
        corners = corners[::-1]

    # A wall runs from each corner to the next.
    wall_vectors = np.roll(corners, -1, axis=0) - corners
    wall_lengths = np.abs(wall_vectors).sum(axis=1)
    directions = wall_vectors / wall_lengths[:, None]

    # Left of the wall's direction is inside: (x, z) -> (-z, x). Forward of turn 0..3 is +z, +x, -z, -x.
    along_x = directions[:, 0]
    along_z = directions[:, 1]
    wall_turns = np.argmax(np.stack([along_x, -along_z, -along_x, along_z], axis=1), axis=1)

    notch_low = np.where(is_notch_high, size - notch_size, 0.0)
    return RoomShape(size, np.stack([notch_low, notch_low + notch_size]), corners, wall_turns, wall_lengths)


def is_inside_room(shape: RoomShape, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return where rectangles lie within the room, bool [K].

    Args:
      shape: shape of the room.
      low: float [K, 2], low corners (x, z) of the rectangles.
      high: float [K, 2], high corners.
    """
    in_notch = ((low < shape.notch[1] - 1e-6) & (high > shape.notch[0] + 1e-6)).all(axis=-1)
    return (low >= -1e-6).all(axis=-1) & (high <= shape.size + 1e-6).all(axis=-1) & ~in_notch


def wall_mask(shape: RoomShape) -> np.ndarray:
    """Return the cells that are not floor, bool [nz, nx].

    The mask includes a ring of walls around the room; the room's origin is the low corner of cell [1, 1].
    """
    num_x, num_z = np.round(shape.size / CELL_SIZE).astype(int)
    walls = np.ones((num_z + 2, num_x + 2), bool)
    walls[1:-1, 1:-1] = False
    (x0, z0), (x1, z1) = 1 + np.round(shape.notch / CELL_SIZE).astype(int)
    walls[z0:z1, x0:x1] = True
    return walls
