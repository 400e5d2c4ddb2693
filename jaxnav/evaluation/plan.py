"""Plan of a room from above: walls, floor, furniture, the objects that can be sought, and what a camera overlooks."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.sight import opaque
from jaxnav.scenes.task import Rules

# From Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies.
GOAL = "#D55E00"
INK, GROUND, FLOOR, WALL = "#333333", "#f7f5f1", "#ebe5d8", "#55524d"
HEIGHTS = LinearSegmentedColormap.from_list("height", ["#d3cab9", "#978d7d"])  # box tops at 0 m and at 2 m


def draw_room(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int) -> None:
    """Draw what stands still: taller boxes darker, a dot per object that can be sought, a star for those of `goal`."""
    low = np.asarray(scene.origin) - CELL / 2
    high = low + CELL * np.array(scene.reach.shape[::-1])
    cells = np.select([scene.walls, scene.reach], [0, 1], 2)
    colours = np.array([to_rgb(WALL), to_rgb(FLOOR), to_rgb(GROUND)])[cells]
    axes.imshow(colours, origin="lower", extent=(low[0], high[0], low[1], high[1]), interpolation="nearest")

    x, y, z, sx, sy, sz = scene.boxes.T
    top = y + sy / 2
    order = np.argsort(top)
    boxes = [Rectangle((x[i] - sx[i] / 2, z[i] - sz[i] / 2), sx[i], sz[i]) for i in order]
    shades = HEIGHTS(np.clip(top[order] / 2.0, 0.0, 1.0))
    axes.add_collection(PatchCollection(boxes, facecolor=shades, edgecolor="white", linewidth=0.7, zorder=2))

    low = np.minimum(low, np.min([x - sx / 2, z - sz / 2], axis=1)) - 0.05
    high = np.maximum(high, np.max([x + sx / 2, z + sz / 2], axis=1)) + 0.05
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=GROUND)
    axes.spines[:].set_visible(False)
    axes.apply_aspect()

    ids = category_ids(scene.types, categories)
    objects = sorted((i for i, category in enumerate(ids) if category >= 0), key=lambda i: ids[i] != goal)
    places = scene.boxes[:, [0, 2]]
    taken = [_box(axes.transData.transform(places[i]) - 4, 8, 8) for i in objects]
    named: list[int] = []
    for i in objects:
        marker, size, colour = ("*", 15, GOAL) if ids[i] == goal else ("o", 4, INK)
        edge = {"markeredgecolor": "white", "markeredgewidth": 0.7, "zorder": 6 if ids[i] == goal else 5}
        axes.plot(places[i, 0], places[i, 1], marker, color=colour, markersize=size, **edge)
        # One name for objects of a kind that stand together, such as the burners of a stove.
        if not any(ids[i] == ids[j] and np.linalg.norm(places[i] - places[j]) < 1.0 for j in named):
            named.append(i)
            taken.append(_name(axes, categories[ids[i]], places[i], colour, taken))


def _name(axes: Axes, name: str, place: np.ndarray, colour: str, taken: list[Bbox]) -> Bbox:
    """Write a name beside a dot, where it meets the fewest of the `taken` boxes; returns its own box, in pixels."""
    halo = [withStroke(linewidth=1.6, foreground=GROUND)]
    text = axes.text(place[0], place[1], name, fontsize=7, color=colour, va="bottom", path_effects=halo, zorder=7)
    width, height = text.get_window_extent().size
    near, left, middle, above, below = 9, -9 - width, -height / 2, 3, -8 - height
    spots = [(near, middle), (left, middle), (-width / 2, 8), (-width / 2, below)]
    spots += [(near, above), (left, above), (near, below), (left, below)]
    boxes = [_box(axes.transData.transform(place) + spot, width, height) for spot in spots]

    def clashes(box: Bbox) -> int:
        inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 and axes.bbox.y0 <= box.y0 and box.y1 <= axes.bbox.y1
        return sum(box.overlaps(other) for other in taken) + 2 * (not inside)

    best = min(boxes, key=clashes)
    x, y = axes.transData.inverted().transform((best.x0, best.y0))
    text.set_position((x, y))
    return best


def _box(corner: np.ndarray, width: float, height: float) -> Bbox:
    return Bbox([corner, np.add(corner, (width, height))])


def view_cone(scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> np.ndarray:
    """Outline [N, 2] of the floor in the field of view, 4 m deep, cut by walls and boxes of the camera's height."""
    angles = np.deg2rad(yaw + rules.field_of_view[0] * np.linspace(-0.5, 0.5, 81))
    reach = np.linspace(0.0, 4.0, 81)
    points = place + reach[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=-1)[:, None]  # [81, 81, 2]
    cells = np.rint((points - scene.origin) / CELL).astype(int)[..., ::-1]
    last = np.array(scene.walls.shape) - 1
    iz, ix = np.moveaxis(np.clip(cells, 0, last), -1, 0)
    blocked = scene.walls[iz, ix] & (cells == np.stack([iz, ix], axis=-1)).all(axis=-1)
    tall = scene.boxes[opaque(scene.boxes) & (scene.boxes[:, 1] + scene.boxes[:, 4] / 2 >= rules.camera)]
    for box in tall:
        blocked |= (np.abs(points - box[[0, 2]]) < box[[3, 5]] / 2).all(axis=-1)
    depth = np.where(blocked.any(axis=1), blocked.argmax(axis=1), len(reach) - 1)
    return np.concatenate([place[None], points[np.arange(len(angles)), depth]])
