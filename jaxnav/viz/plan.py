"""Plan of a room from above: walls, floor, furniture, the objects that can be sought, and what a camera overlooks."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.detector import MAX_RANGE
from jaxnav.scenes.tables.visibility import opaque, rectangles
from jaxnav.scenes.task import Rules

# From Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies.
GOAL = "#D55E00"
INK, GROUND, FLOOR, WALL, PALE = "#333333", "#f7f5f1", "#ebe5d8", "#55524d", "#8a8a8a"
TINTS = ("#f3d9b8", "#c9e0ee", "#cbe6dc", "#eed3e2", "#f1ecb9", "#d6d4ee")  # of rooms, the same palette made pale
TALL = 2.0  # metres; boxes with higher tops are as dark
HEIGHTS = LinearSegmentedColormap.from_list("height", ["#ddd5c5", "#7f7566"])  # box tops at 0 m and at TALL
_EDGE = 0.05  # metres around the plan


def draw_room(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int | None = None) -> None:
    """Draw what stands still: taller boxes darker, a dot per object that can be sought, a star for those of `goal`.

    The rooms of a home are tinted by their types and named.
    """
    low, high = extent(scene)
    nz, nx = scene.reach.shape
    corner = np.asarray(scene.origin) - CELL / 2
    sides = (corner[0], corner[0] + CELL * nx, corner[1], corner[1] + CELL * nz)
    axes.imshow(_floor(scene), origin="lower", extent=sides, interpolation="nearest")

    x, y, z, sx, sy, sz = scene.boxes.T
    top = y + sy / 2
    order = np.argsort(top)
    boxes = [Rectangle((x[i] - sx[i] / 2, z[i] - sz[i] / 2), sx[i], sz[i]) for i in order]
    shades = HEIGHTS(np.clip(top[order] / TALL, 0.0, 1.0))
    axes.add_collection(PatchCollection(boxes, facecolor=shades, edgecolor="white", linewidth=0.7, zorder=2))

    low, high = low - _EDGE, high + _EDGE
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=GROUND)
    axes.spines[:].set_visible(False)
    axes.apply_aspect()

    ids = category_ids(scene.types, categories)
    objects = sorted((i for i, category in enumerate(ids) if category >= 0), key=lambda i: ids[i] != goal)
    places = scene.boxes[:, [0, 2]]
    labels = _Labels(axes, places[objects], corner + CELL * rectangles(scene.walls)[:, [[1, 0], [3, 2]]])
    named: list[int] = []
    for i in objects:
        marker, size, colour = ("*", 15, GOAL) if ids[i] == goal else ("o", 4, INK)
        edge = {"markeredgecolor": "white", "markeredgewidth": 0.7, "zorder": 6 if ids[i] == goal else 5}
        axes.plot(places[i, 0], places[i, 1], marker, color=colour, markersize=size, **edge)
        # One name for objects of a kind that stand together, such as the burners of a stove.
        if not any(ids[i] == ids[j] and np.linalg.norm(places[i] - places[j]) < 1.0 for j in named):
            named.append(i)
            labels.beside(categories[ids[i]], places[i], colour)
    for room in scene.rooms:
        iz, ix = np.nonzero(room.cells & scene.reach if (room.cells & scene.reach).any() else room.cells)
        labels.among(room.type.replace("_", " "), np.asarray(scene.origin) + CELL * np.stack([ix, iz], axis=-1))


def extent(scene: Scene, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest (x, z) in metres, float64 [2] each, of the objects and of cells bool [nz, nx], else of all."""
    iz, ix = np.nonzero(np.ones_like(scene.reach) if cells is None else cells)
    points = np.asarray(scene.origin) + CELL * np.stack([ix, iz], axis=-1)
    centre, half = scene.boxes[:, [0, 2]], scene.boxes[:, [3, 5]] / 2
    low = np.minimum(points.min(axis=0) - CELL / 2, (centre - half).min(axis=0, initial=np.inf))
    high = np.maximum(points.max(axis=0) + CELL / 2, (centre + half).max(axis=0, initial=-np.inf))
    return low, high


def scene_size(scene: Scene) -> np.ndarray:
    """Width and depth in metres of the rectangle around the objects and the cells that are no wall, float64 [2]."""
    low, high = extent(scene, scene.reach | ~scene.walls)
    return high - low


def _floor(scene: Scene) -> np.ndarray:
    """Colours of the cells, float [nz, nx, 3]: where one can stand darker than the rest of the floor."""
    colours = np.array([to_rgb(FLOOR), to_rgb(GROUND)])[np.where(scene.reach, 0, 1)]
    kinds = sorted({room.type for room in scene.rooms})
    for room in scene.rooms:
        tint = np.array(to_rgb(TINTS[kinds.index(room.type) % len(TINTS)]))
        colours[room.cells & scene.reach] = tint
        colours[room.cells & ~scene.reach] = (tint + to_rgb(GROUND)) / 2
    colours[scene.walls] = to_rgb(WALL)
    return colours


class _Labels:
    """Names on a plan, each where it covers the least of other names, of dots and, half as bad, of walls."""

    def __init__(self, axes: Axes, dots: np.ndarray, walls: np.ndarray) -> None:
        """Take dots at [N, 2] and walls [M, (low, high), 2] into account, both world (x, z)."""
        self._axes = axes
        self._point = axes.figure.dpi / 72  # pixels
        centres, walls = (axes.transData.transform(part.reshape(-1, 2)) for part in (dots, walls))
        around = centres[:, None] + 3 * self._point * np.array([[-1, -1], [1, 1]])
        self._taken = np.concatenate([around, walls.reshape(-1, 2, 2)])  # pixels, [N, (low, high), (x, y)]
        self._badness = np.repeat([1.0, 0.5], [len(around), len(walls) // 2])

    def beside(self, name: str, place: np.ndarray, colour: str) -> None:
        """Write a name right beside a dot, if need be a little farther off."""
        text = self._text(name, colour, fontsize=7)
        width, height = size = np.array(text.get_window_extent().size)
        dot = self._axes.transData.transform(place)
        spots = []
        for gap in self._point * np.array([5, 9, 14]):
            sides, levels = (gap, -gap - width), (-height / 2, gap / 3, -gap / 3 - height)
            spots += [(side, level) for level in levels[:1] for side in sides]
            spots += [(-width / 2, gap), (-width / 2, -gap - height)]
            spots += [(side, level) for level in levels[1:] for side in sides]
        self._put(text, dot + np.array(spots), size)

    def among(self, name: str, places: np.ndarray) -> None:
        """Write the name of an area, centred on one of its places [N, 2], in its middle if possible."""
        text = self._text(name, WALL, fontsize=9, style="italic", parse_math=False)
        places = places[np.argsort(np.linalg.norm(places - places.mean(axis=0), axis=1), kind="stable")]
        size = np.array(text.get_window_extent().size)
        self._put(text, self._axes.transData.transform(places) - size / 2, size)

    def _text(self, name: str, colour: str, **font) -> Text:
        halo = [withStroke(linewidth=1.6, foreground=GROUND)]
        return self._axes.text(0, 0, name, color=colour, va="bottom", path_effects=halo, zorder=7, **font)

    def _put(self, text: Text, corners: np.ndarray, size: np.ndarray) -> None:
        """Move a text to the best, then the first, of the low corners [N, 2]."""
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


def view_cone(scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> np.ndarray:
    """Outline [N, 2] of the floor in a level view, 5 m deep, cut by walls and boxes of the camera's height."""
    angles = np.deg2rad(yaw + rules.field_of_view[0] * np.linspace(-0.5, 0.5, 81))
    reach = np.linspace(0.0, MAX_RANGE, 401)
    points = place + reach[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=-1)[:, None]  # [401, 81, 2]
    cells = np.rint((points - scene.origin) / CELL).astype(int)[..., ::-1]
    last = np.array(scene.walls.shape) - 1
    iz, ix = np.moveaxis(np.clip(cells, 0, last), -1, 0)
    blocked = scene.walls[iz, ix] & (cells == np.stack([iz, ix], axis=-1)).all(axis=-1)
    tall = scene.boxes[opaque(scene.boxes) & (scene.boxes[:, 1] + scene.boxes[:, 4] / 2 >= rules.camera)]
    for box in tall:
        blocked |= (np.abs(points - box[[0, 2]]) < box[[3, 5]] / 2).all(axis=-1)
    depth = np.where(blocked.any(axis=1), blocked.argmax(axis=1), len(reach) - 1)
    return np.concatenate([place[None], points[np.arange(len(angles)), depth]])
