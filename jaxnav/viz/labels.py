"""Names on a plan, placed so that they cover little."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.text import Text


class Labels:
    """Place names where they cover the least.

    Names, dots and walls that are already there count, walls half as much as the others. Of equally good places the
    first is taken.
    """

    def __init__(self, axes: Axes, dots: np.ndarray, walls: np.ndarray, halo: str) -> None:
        """Take dots and walls into account.

        Args:
          axes: of the plan, with its final limits and position.
          dots: float [N, 2], world (x, z) of the dots.
          walls: float [M, 2, 2], low and high corner (x, z) of each wall.
          halo: colour around the letters.
        """
        self._axes, self._halo = axes, withStroke(linewidth=1.6, foreground=halo)
        self._point = axes.figure.dpi / 72  # pixels
        centres, walls = (axes.transData.transform(part.reshape(-1, 2)) for part in (dots, walls))
        around = centres[:, None] + 3 * self._point * np.array([[-1, -1], [1, 1]])
        self._taken = np.concatenate([around, walls.reshape(-1, 2, 2)])  # pixels, [N, (low, high), (x, y)]
        self._badness = np.repeat([1.0, 0.5], [len(around), len(walls) // 2])

    def beside(self, name: str, place: np.ndarray, colour: str) -> None:
        """Write a name beside the dot at `place` [2]."""
        text = self._text(name, colour, fontsize=7)
        width, height = size = np.array(text.get_window_extent().size)
        dot = self._axes.transData.transform(place)
        spots = []
        for gap in self._point * np.array([5, 9, 14]):  # the nearest spots first
            sides, levels = (gap, -gap - width), (-height / 2, gap / 3, -gap / 3 - height)
            spots += [(side, level) for level in levels[:1] for side in sides]
            spots += [(-width / 2, gap), (-width / 2, -gap - height)]
            spots += [(side, level) for level in levels[1:] for side in sides]
        self._put(text, dot + np.array(spots), size)

    def among(self, name: str, places: np.ndarray, colour: str) -> None:
        """Write an area's name on one of its places.

        The name is centred on the place; `places` is float [N, 2], world (x, z).

        Places near the middle of the area are preferred.
        """
        text = self._text(name, colour, fontsize=9, style="italic", parse_math=False)
        places = places[np.argsort(np.linalg.norm(places - places.mean(axis=0), axis=1), kind="stable")]
        size = np.array(text.get_window_extent().size)
        self._put(text, self._axes.transData.transform(places) - size / 2, size)

    def _text(self, name: str, colour: str, **font) -> Text:
        return self._axes.text(0, 0, name, color=colour, va="bottom", path_effects=[self._halo], zorder=7, **font)

    def _put(self, text: Text, corners: np.ndarray, size: np.ndarray) -> None:
        """Move a text to the best of corners [N, 2]."""
        boxes = np.stack([corners, corners + size], axis=1)
        low = np.maximum(boxes[:, None, 0], self._taken[:, 0])
        high = np.minimum(boxes[:, None, 1], self._taken[:, 1])
        covered = np.prod(np.maximum(high - low, 0.0), axis=-1) @ self._badness
        frame = self._axes.bbox
        inside = np.minimum(boxes[:, 1], frame.max) - np.maximum(boxes[:, 0], frame.min)
        covered += 2 * (np.prod(size) - np.prod(np.maximum(inside, 0.0), axis=-1))
        best = int(np.argmin(np.round(covered)))
        x, y = self._axes.transData.inverted().transform(corners[best])
        text.set_position((x, y))
        self._taken = np.concatenate([self._taken, boxes[best : best + 1]])
        self._badness = np.append(self._badness, 1.0)
