"""The agents whose episodes are replayed side by side."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxnav.evaluation.report import Variant
from jaxnav.evaluation.variants import Row
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld

#: Roles side by side, by what differs between them.
COMPARISONS = {
    "Removal": ("layout", "stde"),
    "Experience": ("layout", "without"),
    "Layout weights": ("layout", "baseline"),
}


class Player(NamedTuple):
    """Hold an agent, and how it fared in the evaluation.

    Attributes:
      role: the variant of its row, or `without` for agents without experience.
      name: the row, as tables name it.
      policies: of its run.
      world: its scenes, the same for all players.
      row: of the evaluation, with best actions.
      success: bool [E], of the first seed.
      length: int [E], actions.
    """

    role: Variant | Literal["without"]
    name: str
    policies: Policies
    world: CompiledWorld
    row: Row
    success: np.ndarray
    length: np.ndarray

    def differs(self, other: "Player") -> np.ndarray:
        """Return which episodes end otherwise, or at another step, bool [E]."""
        return (self.success != other.success) | (self.length != other.length)


def compare(players: Sequence[Player]) -> dict[str, tuple[int, int]]:
    """Return pairs of players by what one is with and the other without."""
    places = {player.role: i for i, player in enumerate(players)}
    return {name: (places[a], places[b]) for name, (a, b) in COMPARISONS.items() if a in places and b in places}


def choose(players: Sequence[Player], count: int) -> np.ndarray:
    """Choose the episodes to replay, indices in order.

    Those in which most pairs of players differ come first, then those that come first in the list.

    Args:
      players: at least one.
      count: of episodes, or as many as there are.
    """
    pairs = sum((a.differs(b).astype(int) for a in players for b in players), start=np.zeros_like(players[0].length))
    return np.argsort(-pairs, kind="stable")[:count]
