"""What an agent makes of its views, in plain NumPy: features, the belief about the layout, the map of where it was.

From docs/environment.md and docs/methods.md; float64 throughout, and no arithmetic of the package.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import digamma, gammaln

from support.twin_scene import NOT_STANDABLE, STANDABLE, Cell

#: What is known of a cell on the map; the larger number stays.
UNKNOWN, BLOCKED, FREE, VISITED = range(4)


class Seen(NamedTuple):
    """Hold what the networks get of a view.

    Attributes:
      view: float64 [242], which cells are standable, then which are not.
      visible: float64 [K], 1 where a category is detected.
      table: float64 [K, 9], the detections and the flag of the goal.
      goal: float64 [K], one-hot.
    """

    view: np.ndarray
    visible: np.ndarray
    table: np.ndarray
    goal: np.ndarray


def cells_of(row: np.ndarray, num_categories: int) -> list[int]:
    """Return the 121 cells of the view, two bits each."""
    packed = row[4 * num_categories : 4 * num_categories + 31].tolist()
    return [byte >> shift & 3 for byte in packed for shift in (0, 2, 4, 6)][:121]


def look(row: np.ndarray, goal: int, num_categories: int) -> Seen:
    """Take a row of bytes apart."""
    cells = np.array(cells_of(row, num_categories))
    table = np.zeros((num_categories, 9))
    for category, entry in enumerate(row[: 4 * num_categories].reshape(-1, 4).tolist()):
        if entry[0]:
            ahead, right, apparent = entry[1] / 51, (entry[2] - 128) / 25.4, entry[3] / 127.5  # metres
            away = max(math.hypot(ahead, right), 0.05)
            scaled = ahead / 5, right / 5, math.hypot(ahead, right) / 5
            table[category, :8] = 1, entry[0] / 255, *scaled, right / away, ahead / away, apparent
    table[goal, 8] = 1
    view = np.concatenate([cells == STANDABLE, cells == NOT_STANDABLE]).astype(float)
    return Seen(view, table[:, 0].copy(), table, table[:, 8].copy())


class TwinBelief:
    """Hold the belief of the setting `calibrated`, whatever the strength of its prior."""

    def __init__(self, prior: np.ndarray):
        self.alpha, self.last, self.gap = prior.astype(float), np.zeros(len(prior), bool), 0.0

    def update(self, visible: np.ndarray) -> None:
        """Take in which categories are visible, bool [K]."""
        if visible.sum() < 2 or (visible == self.last).all():
            self.gap *= 0.8
            return
        divergences = []
        for i in np.flatnonzero(visible):
            others = np.arange(len(visible)) != i
            before, counts = self.alpha[i, others], visible[others].astype(float)
            divergences.append(_kl(before + counts, before))
            self.alpha[i, others] += counts
        self.gap, self.last = math.tanh(np.mean(divergences)), visible.copy()

    def weights(self, goal: int) -> np.ndarray:
        """Return w x g, [K]: how likely the goal is where each category is seen."""
        return np.array([1.0 if i == goal else row[goal] / row.sum() for i, row in enumerate(self.alpha)])


def _kl(b: np.ndarray, a: np.ndarray) -> float:
    """Return KL(Dir(b) || Dir(a)) in nats."""
    return float(
        gammaln(b.sum()) - gammaln(b).sum() - gammaln(a.sum()) + gammaln(a).sum()
        + ((b - a) * (digamma(b) - digamma(b.sum()))).sum()
    )  # fmt: skip


class TwinMap:
    """Hold what is known of the cells around an episode's start, for eight headings.

    The scenes must be smaller than the map of the package, which goes on at its opposite edge.
    """

    def __init__(self) -> None:
        self.known: dict[Cell, int] = {}
        self.place, self.heading = (0, 0), 0

    def update(self, cells: list[int], heading: int, moved: bool) -> None:
        """Take in a view of 121 cells; row 0 is nearest, column 0 leftmost."""
        self.heading = heading
        if moved:
            angle = math.radians(45 * heading)
            self.place = (self.place[0] + round(math.cos(angle)), self.place[1] + round(math.sin(angle)))
        for number, cell in enumerate(cells):
            code = {STANDABLE: FREE, NOT_STANDABLE: BLOCKED}.get(cell, UNKNOWN)
            at = self._at(number // 11, number % 11 - 5)
            self.known[at] = max(self.known.get(at, UNKNOWN), code)
        self.known[self.place] = VISITED

    def inputs(self) -> np.ndarray:
        """Return which of 11 x 11 cells, every second one, are blocked, free and visited."""
        along = range(-10, 11, 2)
        codes = np.array([self.known.get(self._at(ahead, right), UNKNOWN) for ahead in along for right in along])
        return np.concatenate([codes == code for code in (BLOCKED, FREE, VISITED)]).astype(float)

    def _at(self, ahead: int, right: int) -> Cell:
        cosine, sine = math.cos(math.radians(45 * self.heading)), math.sin(math.radians(45 * self.heading))
        dz, dx = ahead * cosine - right * sine, ahead * sine + right * cosine
        return self.place[0] + round(round(dz, 9)), self.place[1] + round(round(dx, 9))
