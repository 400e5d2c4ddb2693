"""Rectangles of cells."""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import CELL


class Rectangle(NamedTuple):
    """Hold the bounds of cells [z0, z1) x [x0, x1)."""

    z0: int
    x0: int
    z1: int
    x1: int

    @property
    def cells(self) -> tuple[slice, slice]:
        """Return an index into an array [nz, nx]."""
        return slice(self.z0, self.z1), slice(self.x0, self.x1)

    @property
    def area(self) -> int:
        """Return the number of cells."""
        return (self.z1 - self.z0) * (self.x1 - self.x0)

    @property
    def around(self) -> "Rectangle":
        """Return the rectangle with a ring of cells around it."""
        return Rectangle(self.z0 - 1, self.x0 - 1, self.z1 + 1, self.x1 + 1)

    def within(self, other: "Rectangle") -> bool:
        """Return whether all its cells belong to the other."""
        return other.z0 <= self.z0 and self.z1 <= other.z1 and other.x0 <= self.x0 and self.x1 <= other.x1

    def box(self, frame: "Rectangle", height: float) -> np.ndarray:
        """Return its part in `frame` as a box.

        Args:
          frame: the box is clipped to it, and its low corner is the origin.
          height: of the box, metres.

        Returns:
          float64 [2, 3], low and high corner (x, y, z), metres.
        """
        z, x = np.clip([self.z0, self.z1], frame.z0, frame.z1), np.clip([self.x0, self.x1], frame.x0, frame.x1)
        return np.stack([CELL * (x - frame.x0), np.array([0.0, height]), CELL * (z - frame.z0)], axis=-1)
