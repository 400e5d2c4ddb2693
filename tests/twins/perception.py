"""The perception of an agent in plain NumPy: features, the belief about the layout, the map of visited cells.

The twin follows docs/environment.md and docs/specification.md, and computes in float64 with no arithmetic of the
package.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import digamma, gammaln
from twins.scene import NOT_STANDABLE, STANDABLE, Cell

#: State of a cell on the map; the larger number replaces the smaller one.
UNKNOWN, BLOCKED, FREE, VISITED = range(4)
#: Factor on the gap of a view that shows nothing new: gamma of docs/specification.md.
GAP_DECAY = 0.8


class TwinFeatures(NamedTuple):
    """A view as the input of the networks.

    Attributes:
      view: float64 [242], flags of standable cells, then of those that are not standable.
      visible: float64 [K], 1 where a category is detected.
      table: float64 [K, 9], the detections and the flag of the goal.
      goal: float64 [K], one-hot.
    """

    view: np.ndarray
    visible: np.ndarray
    table: np.ndarray
    goal: np.ndarray


def unpack_cells(row: np.ndarray, num_categories: int) -> list[int]:
    """Return the 121 cells of the view, two bits each."""
    packed = row[4 * num_categories : 4 * num_categories + 31].tolist()
    cells = []
    for byte in packed:
        for shift in (0, 2, 4, 6):
            cells.append(byte >> shift & 3)
    return cells[:121]


def unpack_row(row: np.ndarray, goal: int, num_categories: int) -> TwinFeatures:
    """Unpack a row of bytes."""
    cells = np.array(unpack_cells(row, num_categories))
    view = np.concatenate([cells == STANDABLE, cells == NOT_STANDABLE]).astype(float)

    table = np.zeros((num_categories, 9))
    for category, entry in enumerate(row[: 4 * num_categories].reshape(-1, 4).tolist()):
        confidence_byte, ahead_byte, right_byte, size_byte = entry
        if confidence_byte:
            # Metres from the bytes, and the bearing as sine and cosine.
            ahead = ahead_byte / 51
            right = (right_byte - 128) / 25.4
            distance = math.hypot(ahead, right)
            safe_distance = max(distance, 0.05)
            offsets = (ahead / 5, right / 5, distance / 5)
            bearing = (right / safe_distance, ahead / safe_distance)
            table[category, :8] = (1, confidence_byte / 255, *offsets, *bearing, size_byte / 127.5)

    table[goal, 8] = 1
    return TwinFeatures(view, table[:, 0].copy(), table, table[:, 8].copy())


class TwinBelief:
    """The belief of the estimator `calibrated`, for any strength of its prior."""

    def __init__(self, prior: np.ndarray):
        self.alpha = prior.astype(float)
        self.last_visible = np.zeros(len(prior), bool)
        self.gap = 0.0

    def update(self, visible: np.ndarray) -> None:
        """Update with the categories that are visible, bool [K]."""
        # Fewer than two, or unchanged, categories shut the gate, and the gap decays.
        if visible.sum() < 2 or (visible == self.last_visible).all():
            self.gap *= GAP_DECAY
            return

        # Eq. 5: the mean divergence of the rows of visible categories, each without its own entry.
        divergences = []
        for i in np.flatnonzero(visible):
            other_columns = np.arange(len(visible)) != i
            prior_row = self.alpha[i, other_columns]
            counts = visible[other_columns].astype(float)
            divergences.append(_dirichlet_kl(prior_row + counts, prior_row))
            self.alpha[i, other_columns] += counts
        self.gap = math.tanh(np.mean(divergences))
        self.last_visible = visible.copy()

    def weights(self, goal: int) -> np.ndarray:
        """Return the goal's column of w, [K]: the expected probability to see the goal with each category."""
        weights = self.alpha[:, goal] / self.alpha.sum(axis=1)
        weights[goal] = 1.0
        return weights


class TwinPaperBelief(TwinBelief):
    """The belief by equations 3 to 6 of the paper as printed: every view adds its instance counts to every row."""

    def update(self, visible: np.ndarray) -> None:
        """Update with the number of visible instances of each category, [K]."""
        divergences = []
        for i in range(len(visible)):
            other_columns = np.arange(len(visible)) != i  # n_{-i}, and the row without its own entry
            prior_row = self.alpha[i, other_columns]
            divergences.append(_dirichlet_kl(prior_row + visible[other_columns], prior_row))
            self.alpha[i, other_columns] += visible[other_columns]
        self.gap = math.tanh(sum(divergences) / len(visible))


def unpack_counts(row: np.ndarray, num_categories: int) -> np.ndarray:
    """Return the instance counts of a row that holds them, float64 [K]; their bytes follow the view."""
    first_byte = 4 * num_categories + 31
    return row[first_byte : first_byte + num_categories].astype(float)


def _dirichlet_kl(b: np.ndarray, a: np.ndarray) -> float:
    """Return KL(Dir(b) || Dir(a)) in nats."""
    return float(
        gammaln(b.sum()) - gammaln(b).sum() - gammaln(a.sum()) + gammaln(a).sum()
        + ((b - a) * (digamma(b) - digamma(b.sum()))).sum()
    )  # fmt: skip


class TwinMap:
    """State of the cells around an episode's start, for eight headings.

    The scenes must be smaller than the toroidal map of the package.
    """

    def __init__(self) -> None:
        self.cell_states: dict[Cell, int] = {}
        self.position = (0, 0)
        self.heading = 0

    def update(self, cells: list[int], heading: int, moved: bool) -> None:
        """Update with a view of 121 cells; row 0 is nearest, column 0 leftmost."""
        self.heading = heading
        if moved:
            self.position = self._cell_at(ahead=1, right=0)

        for index, view_cell in enumerate(cells):
            state = {STANDABLE: FREE, NOT_STANDABLE: BLOCKED}.get(view_cell, UNKNOWN)
            map_cell = self._cell_at(ahead=index // 11, right=index % 11 - 5)
            self.cell_states[map_cell] = max(self.cell_states.get(map_cell, UNKNOWN), state)
        self.cell_states[self.position] = VISITED

    def inputs(self) -> np.ndarray:
        """Return flags of 11 x 11 cells, every second one: blocked, then free, then visited."""
        offsets = range(-10, 11, 2)
        states = []
        for ahead in offsets:
            for right in offsets:
                states.append(self.cell_states.get(self._cell_at(ahead, right), UNKNOWN))
        return np.concatenate([np.array(states) == state for state in (BLOCKED, FREE, VISITED)]).astype(float)

    def _cell_at(self, ahead: int, right: int) -> Cell:
        """Return the cell at an offset from the agent, in cells."""
        angle = math.radians(45 * self.heading)
        dz = ahead * math.cos(angle) - right * math.sin(angle)
        dx = ahead * math.sin(angle) + right * math.cos(angle)
        return self.position[0] + round(round(dz, 9)), self.position[1] + round(round(dx, 9))
