"""Boxes and segments of the plain-Python twin."""

import math
from collections.abc import Sequence

SHRINK = TOLERANCE = 1e-6


def meets(start: Sequence[float], end: Sequence[float], centre: Sequence[float], half: Sequence[float]) -> bool:
    """Check whether a segment meets the inside of a box.

    The box has the half sides `half`, in two or three dimensions. They meet unless one of the candidate axes separates
    the two: those of the box, and their cross products with the segment, one for each pair of coordinates.
    """
    middle = [(a + b) / 2 - c for a, b, c in zip(start, end, centre, strict=True)]
    along = [(b - a) / 2 for a, b in zip(start, end, strict=True)]
    for i in range(len(half)):
        if abs(middle[i]) >= half[i] + abs(along[i]):
            return False
        for j in range(i):
            radius = half[i] * abs(along[j]) + half[j] * abs(along[i])
            # A radius of 0 belongs to no axis at all: the segment is parallel to the third one.
            if 0 < radius <= abs(middle[i] * along[j] - middle[j] * along[i]):
                return False
    return True


def contains(point: Sequence[float], centre: Sequence[float], half: Sequence[float], margin: float = TOLERANCE) -> bool:
    return all(abs(p - c) <= h + margin for p, c, h in zip(point, centre, half, strict=True))


class Box:
    """Describe an object: centre, half sides, and what they imply."""

    def __init__(self, values: Sequence[float], category: int | None):
        x, y, z, sx, sy, sz = (float(value) for value in values)
        self.centre = (x, y, z)
        self.half = (sx / 2, sy / 2, sz / 2)
        self.category = category
        self.top = y + sy / 2
        limits = (sx - 0.3, sz - 0.3, 0.3 - (y - sy / 2), self.top - 0.85)
        self.opaque = min(limits) >= -1e-9
        sides = sorted((sx, sy, sz))
        self.size = math.sqrt(sides[1] * sides[2])
        self.range = min(max(self.size / 0.12, 1.5), 5.0)

    def nearest(self, x: float, z: float) -> tuple[float, float]:
        """Return the point of the footprint nearest to (x, z)."""
        (cx, _, cz), (hx, _, hz) = self.centre, self.half
        return min(max(x, cx - hx), cx + hx), min(max(z, cz - hz), cz + hz)
