"""The picture of a search: the map of an agent, the block it chose and its way there."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxnav.policies.methods.map_tracker import SIDE, Course
from jaxnav.policies.semantic_map import EXPLORED, FREE, WALL
from jaxnav.scenes.scene import CELL, extent
from jaxnav.viz.labels import Labels
from jaxnav.viz.panel import Episode, status
from jaxnav.viz.plan import AGENT, GOAL, GROUND, PALE, SEEN, draw_agent, draw_outline
from jaxnav.viz.search import Search

NEAR, FAR, BLOCKED, BLOCK = "#bcd9ea", "#e6f0f6", "#55524d", "#CC79A7"
_EDGE = {"markeredgecolor": "white", "markeredgewidth": 0.5}
_SAME_NAME = 1.0  # metres within which marks of one category share a name


class Frame:
    """Lay a map, which goes on at the opposite edge, over a home."""

    def __init__(self, episode: Episode, search: Search) -> None:
        self.size, self._start = len(search.course.cells), episode.places[0]
        middle = np.mean(extent(episode.scene), axis=0)
        self._centre = np.rint((middle - self._start) / CELL).astype(int)[::-1] + self.size // 2

    def unroll(self, cells: np.ndarray) -> np.ndarray:
        """Return the map with the home in its middle."""
        return np.roll(cells, tuple(self.size // 2 - self._centre), axis=(0, 1))

    def world(self, cells: np.ndarray) -> np.ndarray:
        """Return the world (x, z) of map cells (z, x), float64 [..., 2]."""
        away = (cells - self._centre + self.size // 2) % self.size - self.size // 2 + self._centre - self.size // 2
        return self._start + CELL * away[..., ::-1]

    def along(self, cells: np.ndarray) -> np.ndarray:
        """Return the world (x, z) of cells [L, 2] one after the other, each the shorter way from the one before.

        A plan may lead beyond the edge of the map.
        """
        steps = (np.diff(cells, axis=0) + self.size // 2) % self.size - self.size // 2
        ways = np.concatenate([np.zeros((1, 2), int), np.cumsum(steps, axis=0)])
        return self.world(cells[0]) + CELL * ways[:, ::-1]

    @property
    def sides(self) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of the unrolled map, metres."""
        left, bottom = self._start + CELL * (self._centre[::-1] - self.size) - CELL / 2
        return left, left + CELL * self.size, bottom, bottom + CELL * self.size


def draw_search(episode: Episode, search: Search, step: int, path: Path) -> None:
    """Write the picture of the search at a step, a PNG."""
    figure = Figure(figsize=(9.6, 5.4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes, frame = figure.add_axes((0.015, 0.03, 0.7, 0.85)), Frame(episode, search)
    figure.text(0.02, 0.945, episode.title, color=PALE, fontsize=9.5)
    goal = episode.task.categories[episode.goal]
    figure.text(0.02, 0.9, f"Looking for {goal}", color=GOAL, fontsize=14, weight="bold")
    text, colour = status(episode, step)
    figure.text(0.98, 0.935, text, color=colour, fontsize=10.5, ha="right")
    draw_outline(axes, episode.scene)
    _draw_map(axes, search, frame)
    _draw_plan(axes, episode, search, step, frame)
    _draw_marks(axes, episode, search, frame)
    figure.legend(
        handles=_legend(goal, search.searching),
        loc="center left",
        bbox_to_anchor=(0.73, 0.5),
        fontsize=9,
        frameon=False,
    )
    canvas.draw()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_map(axes: Axes, search: Search, frame: Frame) -> None:
    """Draw floor and walls as far as they are known."""
    cells = frame.unroll(np.asarray(search.course.cells))
    image = np.zeros((*cells.shape, 4))
    for flags, colour in ((FREE, FAR), (FREE | EXPLORED, NEAR), (WALL, BLOCKED)):
        image[cells & flags == flags] = to_rgba(colour)
    axes.imshow(image, origin="lower", extent=frame.sides, interpolation="nearest", zorder=2.5)


def _draw_plan(axes: Axes, episode: Episode, search: Search, step: int, frame: Frame) -> None:
    """Draw the ways walked and meant, the agent and, while it searches, the block that was chosen."""
    course, rules = search.course, episode.task.rules
    axes.plot(*episode.places[: step + 1].T, color=AGENT, lw=2, solid_joinstyle="round", zorder=4)
    axes.plot(*episode.places[0], "o", color="white", markeredgecolor=AGENT, markersize=6, zorder=4)
    axes.plot(*frame.along(np.stack([course.place, *search.planned])).T, ":", color=AGENT, lw=2, zorder=4)
    draw_agent(axes, episode.scene, rules, episode.places[step], 360.0 / rules.headings * float(course.heading))
    if search.searching:
        _draw_block(axes, course, frame)
    axes.apply_aspect()


def _draw_block(axes: Axes, course: Course, frame: Frame) -> None:
    """Draw the block that was chosen, which may lie beyond the home."""
    cells, side = frame.size // SIDE, CELL * (frame.size // SIDE)
    corner = frame.along(np.stack([course.place, course.aim + cells // 2]))[1] - CELL * (cells // 2) - CELL / 2
    axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=BLOCK, lw=2.2, zorder=5))
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    axes.set_xlim(min(left, corner[0] - CELL), max(right, corner[0] + side + CELL))
    axes.set_ylim(min(bottom, corner[1] - CELL), max(top, corner[1] + side + CELL))


def _draw_marks(axes: Axes, episode: Episode, search: Search, frame: Frame) -> None:
    """Draw and name the cells in which categories were seen."""
    categories = episode.task.categories
    marks = {k: frame.world(np.argwhere(search.course.cells & np.uint32(1 << k))) for k in range(len(categories))}
    labels = Labels(axes, np.concatenate([*marks.values()]), np.zeros((0, 2, 2)), halo=GROUND)
    for category in sorted(marks, key=lambda k: k != episode.goal):
        sought = category == episode.goal
        marker, size, colour = ("*", 13, GOAL) if sought else ("s", 4, SEEN)
        named: list[np.ndarray] = []
        for place in marks[category]:
            axes.plot(
                *place, marker, color=colour, markersize=size, markeredgecolor="white", markeredgewidth=0.5, zorder=6
            )
            if not any(np.linalg.norm(place - other) < _SAME_NAME for other in named):
                labels.beside(categories[category], place, colour)
            named.append(place)


def _legend(goal: str, searching: bool) -> list[Patch | Line2D]:
    """Return what the colours mean."""
    block = [Patch(fill=False, edgecolor=BLOCK, lw=2, label="block chosen to search in")]
    return [
        Patch(color=NEAR, label="floor seen from nearby"),
        Patch(color=FAR, label="floor seen from afar"),
        Patch(color=BLOCKED, label="walls and furniture as known"),
        Line2D([], [], marker="s", ls="", color=SEEN, label="a category was seen here"),
        Line2D([], [], marker="*", ls="", color=GOAL, markersize=12, label=f"{goal}, as known"),
        *(block if searching else []),
        Line2D([], [], color=AGENT, lw=2, label="way so far"),
        Line2D([], [], color=AGENT, lw=2, ls=":", label="way planned"),
        Patch(facecolor=GROUND, edgecolor=PALE, label="faint: the home as it is"),
    ]
