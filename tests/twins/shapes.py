"""Boxes and segments of the plain-Python twin."""

import math
from collections.abc import Sequence

SHRINK = TOLERANCE = 1e-6


def meets(start: Sequence[float], end: Sequence[float], centre: Sequence[float], half: Sequence[float]) -> bool:
    """Check whether a segment meets the inside of a box.

    The box has the half sides `half`, in two or three dimensions. Segment and box meet unless a candidate axis
    separates them. The candidates are the axes of the box, and their cross products with the segment, one for each pair
    of coordinates.
    """
    # The segment relative to the centre of the box: its midpoint, and half of its length along each axis.
    midpoint = [(a + b) / 2 - c for a, b, c in zip(start, end, centre, strict=True)]
    extent = [(b - a) / 2 for a, b in zip(start, end, strict=True)]
    for i in range(len(half)):
        if abs(midpoint[i]) >= half[i] + abs(extent[i]):
            return False

        # A radius of 0 belongs to no axis: the segment is parallel to the third axis of the box.
        for j in range(i):
            radius = half[i] * abs(extent[j]) + half[j] * abs(extent[i])
            if 0 < radius <= abs(midpoint[i] * extent[j] - midpoint[j] * extent[i]):
                return False
    return True


def contains(point: Sequence[float], centre: Sequence[float], half: Sequence[float], margin: float = TOLERANCE) -> bool:
    return all(abs(p - c) <= h + margin for p, c, h in zip(point, centre, half, strict=True))


class Box:
    """An object: centre, half sides, and the properties that follow from them.

    Attributes:
      centre: x, y and z in metres.
      half: half sides.
      category: index of the category; None for an object without one.
      top: height of the upper face.
      opaque: whether the object hides objects behind it: at least 0.3 m wide and deep, from at most 0.3 m above the
        floor to at least 0.85 m.
      size: geometric mean of the two largest sides.
      range: distance up to which the object can be detected.
    """

    def __init__(self, values: Sequence[float], category: int | None):
        x, y, z, sx, sy, sz = (float(value) for value in values)
        self.centre = (x, y, z)
        self.half = (sx / 2, sy / 2, sz / 2)
        self.category = category
        self.top = y + sy / 2
        margins = (sx - 0.3, sz - 0.3, 0.3 - (y - sy / 2), self.top - 0.85)
        self.opaque = min(margins) >= -1e-9

        sides = sorted((sx, sy, sz))
        self.size = math.sqrt(sides[1] * sides[2])
        self.range = min(max(self.size / 0.12, 1.5), 5.0)

    def nearest(self, x: float, z: float) -> tuple[float, float]:
        """Return the point of the footprint nearest to (x, z)."""
        centre_x, _, centre_z = self.centre
        half_x, _, half_z = self.half
        nearest_x = min(max(x, centre_x - half_x), centre_x + half_x)
        nearest_z = min(max(z, centre_z - half_z), centre_z + half_z)
        return nearest_x, nearest_z
