"""A room with the objects that were put in it."""

import numpy as np

from jaxnav.scenes.generate.room_rules import Item
from jaxnav.scenes.generate.room_shapes import Shape

ZONE_HEIGHT = 0.8  # the floor that is kept clear in front of furniture is clear up to here, metres

#: (x, z) of forward and right after 0 to 3 quarter turns clockwise from +z.
FORWARD = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])
RIGHT = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])


class FurnishedRoom:
    """Hold a room with axis-aligned boxes of N objects.

    Attributes:
      shape: of the room.
      types: [N] type names.
      turns: [N] quarter turns clockwise from facing +z.
      parents: [N] index of the object that an object rests on or in, or -1.
      surfaces: [N] height in metres of what objects on it rest on.
      boxes: float64 [N, 2, 3], low and high corner (x, y, z), metres.
      zones: float64 [Z, 2, 3], boxes that are kept clear in front of objects.
      zone_owners: [Z] index of the object that each zone belongs to.
    """

    def __init__(self, shape: Shape):
        self.shape = shape
        self.types: list[str] = []
        self.turns: list[int] = []
        self.parents: list[int] = []
        self.surfaces: list[float] = []
        self.boxes = np.zeros((0, 2, 3))
        self.zones = np.zeros((0, 2, 3))
        self.zone_owners: list[int] = []

    def add(
        self, name: str, low: np.ndarray, high: np.ndarray, turn: int, parent: int, item: Item, middle: bool
    ) -> None:
        """Add an object and the zone kept clear around it.

        Args:
          name: its type.
          low, high: float [3], corners of its box.
          turn: quarter turns clockwise from facing +z.
          parent: index of the object that it rests on or in, or -1.
          item: what it is.
          middle: whether it stands in the middle of the room, where all its sides are kept clear.
        """
        self.types.append(name)
        self.turns.append(turn)
        self.parents.append(parent)
        self.surfaces.append(high[1] if item.surface is None else low[1] + item.surface)
        self.boxes = np.concatenate([self.boxes, [[low, high]]])
        if item.clear:
            zone = clear_zone(low[None], high[None], np.array([turn]), item.clear, middle)
            self.zones = np.concatenate([self.zones, zone])
            self.zone_owners.append(len(self.types) - 1)

    def indices(self, name: str) -> np.ndarray:
        """Return the objects of a type, int [N]."""
        return np.array([i for i, other in enumerate(self.types) if other == name], int)


def clear_zone(low: np.ndarray, high: np.ndarray, turns: np.ndarray, clear: float, middle: bool) -> np.ndarray:
    """Return the floor to keep clear around boxes.

    Args:
      low, high: float [K, 3], corners of the boxes, whose floor belongs to the zones.
      turns: int [K], quarter turns of the objects.
      clear: metres in front of them.
      middle: whether all sides are kept clear.

    Returns:
      float64 [K, 2, 3].
    """
    zones = np.stack([low, high], axis=1)
    zones[:, 0, [0, 2]] -= clear * np.maximum(-FORWARD[turns], middle)
    zones[:, 1, [0, 2]] += clear * np.maximum(FORWARD[turns], middle)
    zones[:, 0, 1], zones[:, 1, 1] = 0.0, ZONE_HEIGHT
    return zones
