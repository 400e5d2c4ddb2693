"""Candidate spots of an object in a room."""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.generate.furnished_room import FORWARD, RIGHT, FurnishedRoom
from jaxnav.scenes.generate.room_rules import FURNITURE_GAP, Rule
from jaxnav.scenes.generate.room_shapes import Shape

CANDIDATES = 48  # spots drawn for an object, of which one is taken


class Spots(NamedTuple):
    """Hold candidate poses of an object.

    Attributes:
      centres: float64 [K, 2], (x, z).
      turns: int [K], quarter turns clockwise from facing +z.
      bottoms: float64 [K], height of the underside.
      owners: int [K], the object that a spot refers to, or -1.
    """

    centres: np.ndarray
    turns: np.ndarray
    bottoms: np.ndarray
    owners: np.ndarray

    def corners(self, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of an object's box at each spot.

        Args:
          size: float [3], its width, height and depth, metres.

        Returns:
          Low and high corners, float64 [K, 3] each.
        """
        half = np.where((self.turns % 2 == 0)[:, None], size, size[::-1]) / 2
        middle = np.stack([self.centres[:, 0], self.bottoms + size[1] / 2, self.centres[:, 1]], axis=1)
        return middle - half, middle + half


def draw_spots(room: FurnishedRoom, size: np.ndarray, place: str, rule: Rule, rng: np.random.Generator) -> Spots:
    """Draw candidate spots of one kind of place.

    Args:
      room: the room; it has objects of the type that the place names.
      size: float [3], width, height and depth of the object, metres.
      place: one of the rule's places, see `Rule`.
      rule: where the object is put.
      rng: source of randomness.
    """
    verb, _, other = place.partition(" ")
    if not other:
        centres, turns = _spots_in_room(room.shape, size, verb, rng)
        return Spots(centres, turns, np.full(len(turns), rule.bottom), np.full(len(turns), -1))

    owners = rng.choice(room.indices(other), CANDIDATES)
    low, high = room.boxes[owners, 0], room.boxes[owners, 1]
    centres, owner_turns = (low + high)[:, [0, 2]] / 2, np.array(room.turns)[owners]
    side = rng.integers(4, size=CANDIDATES) if verb == "around" else 0
    turns = (owner_turns + side) % 4
    extent = np.where((turns % 2 == 0)[:, None], (high - low)[:, [0, 2]], (high - low)[:, [2, 0]])  # across, deep
    across = rng.uniform(-0.5, 0.5, CANDIDATES) * np.maximum(extent[:, 0] - size[0], 0.0)
    deep = rng.uniform(-0.5, 0.5, CANDIDATES) * np.maximum(extent[:, 1] - size[2], 0.0)
    bottoms = np.full(CANDIDATES, rule.bottom)
    if verb == "on":
        bottoms = np.array(room.surfaces)[owners]
    elif verb == "in":
        bottoms = np.array(room.surfaces)[owners] + FURNITURE_GAP - size[1]
    elif verb in ("above", "beside"):  # with its back in line
        deep = (size[2] - extent[:, 1]) / 2
        if verb == "beside":
            across = rng.choice([-1, 1], CANDIDATES) * (extent[:, 0] / 2 + rule.gap + size[0] / 2)
    else:  # before, around: facing it
        deep = extent[:, 1] / 2 + rule.gap + size[2] / 2
    centres = centres + across[:, None] * RIGHT[turns] + deep[:, None] * FORWARD[turns]
    return Spots(centres, turns if verb not in ("before", "around") else (turns + 2) % 4, bottoms, owners)


def _spots_in_room(
    shape: Shape, size: np.ndarray, verb: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw spots at a wall, a corner or the middle.

    Returns:
      Centres [K, 2] and turns [K]; none if no wall is long enough.
    """
    if verb == "middle":
        return rng.uniform(0.0, shape.size, (CANDIDATES, 2)), rng.integers(4, size=CANDIDATES)
    spare = np.maximum(shape.lengths - size[0] - 2 * FURNITURE_GAP, 0.0)
    if not spare.any():
        return np.zeros((0, 2)), np.zeros(0, int)
    wall = rng.choice(len(spare), CANDIDATES, p=spare / spare.sum())
    share = rng.random(CANDIDATES)
    along = (np.round(share) if verb == "corner" else share) * spare[wall] + size[0] / 2 + FURNITURE_GAP
    turns = shape.turns[wall]
    # Facing the room, a wall runs to the right.
    centres = shape.starts[wall] + along[:, None] * RIGHT[turns] + (size[2] / 2 + FURNITURE_GAP) * FORWARD[turns]
    return centres, turns
