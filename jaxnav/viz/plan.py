"""The plan of a scene, seen from above."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Polygon, Rectangle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import CELL, Scene, extent
from jaxnav.scenes.tables.detector import MAX_RANGE
from jaxnav.scenes.tables.visibility import opaque, rectangles
from jaxnav.scenes.task import Rules
from jaxnav.viz.labels import Labels

# From Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies.
GOAL, AGENT, SEEN = "#D55E00", "#0072B2", "#009E73"
INK, GROUND, FLOOR, WALL, PALE = "#333333", "#f7f5f1", "#ebe5d8", "#55524d", "#8a8a8a"
TINTS = ("#f3d9b8", "#c9e0ee", "#cbe6dc", "#eed3e2", "#f1ecb9", "#d6d4ee")  # of rooms: pale colours of the palette
TALL = 2.0  # metres; boxes with higher tops are no darker
HEIGHTS = LinearSegmentedColormap.from_list("height", ["#ddd5c5", "#7f7566"])  # box tops at 0 m and at TALL
_ARROW = Path([(0, 1), (-0.75, -0.9), (0, -0.45), (0.75, -0.9), (0, 1)], closed=True)
_EDGE = 0.05  # metres around the plan
_SAME_LABEL = 1.0  # metres within which objects of one category share a label, such as the burners of a stove


def draw_room(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int | None = None) -> None:
    """Draw walls, floor, furniture and the objects of categories.

    Taller boxes are darker. An object of a category is a dot with a name, an object of the category `goal` a star. The
    rooms of a home are tinted by their types and named.
    """
    draw_outline(axes, scene, alpha=1.0)
    labels = _draw_objects(axes, scene, categories, goal)
    for room in scene.rooms:
        iz, ix = np.nonzero(room.cells & scene.reach if (room.cells & scene.reach).any() else room.cells)
        places = np.asarray(scene.origin) + CELL * np.stack([ix, iz], axis=-1)
        labels.among(room.type.replace("_", " "), places, WALL)


def draw_outline(axes: Axes, scene: Scene, alpha: float = 0.3) -> None:
    """Draw walls, floor and furniture without names.

    Args:
      axes: get the limits of the plan.
      scene: to draw.
      alpha: opacity.
    """
    low, high = extent(scene)
    nz, nx = scene.reach.shape
    corner = np.asarray(scene.origin) - CELL / 2
    sides = (corner[0], corner[0] + CELL * nx, corner[1], corner[1] + CELL * nz)
    axes.imshow(_floor(scene), origin="lower", extent=sides, interpolation="nearest", alpha=alpha)
    _draw_boxes(axes, scene, alpha)
    low, high = low - _EDGE, high + _EDGE
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=GROUND)
    axes.spines[:].set_visible(False)
    axes.apply_aspect()


def draw_agent(axes: Axes, scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> tuple[Polygon, Line2D]:
    """Draw the view cone and the agent as an arrow.

    Args:
      axes: of the plan.
      scene: whose walls and tall boxes end the cone.
      rules: field of view and height of the camera.
      place: float [2], world (x, z).
      yaw: heading, degrees.
    """
    (cone,) = axes.fill(*view_cone(scene, rules, place, yaw).T, color=AGENT, alpha=0.16, lw=0, zorder=3)
    marker = MarkerStyle(_ARROW, transform=Affine2D().rotate_deg(-yaw))
    (arrow,) = axes.plot(*place, marker=marker, color=AGENT, markersize=15, markeredgecolor="white", zorder=8)
    return cone, arrow


def view_cone(scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> np.ndarray:
    """Return the outline of the floor in a level view.

    It is 5 m deep and ends at walls and at opaque boxes as high as the camera.

    Returns:
      float64 [N, 2], world (x, z), `place` first.
    """
    angles = np.deg2rad(yaw + rules.field_of_view[0] * np.linspace(-0.5, 0.5, 81))
    distances = np.linspace(0.0, MAX_RANGE, 401)
    points = place + distances[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=-1)[:, None]  # [401, 81, 2]
    cells = np.rint((points - scene.origin) / CELL).astype(int)[..., ::-1]
    last = np.array(scene.walls.shape) - 1
    iz, ix = np.moveaxis(np.clip(cells, 0, last), -1, 0)
    blocked = scene.walls[iz, ix] & (cells == np.stack([iz, ix], axis=-1)).all(axis=-1)
    tall = scene.boxes[opaque(scene.boxes) & (scene.boxes[:, 1] + scene.boxes[:, 4] / 2 >= rules.camera)]
    for box in tall:
        blocked |= (np.abs(points - box[[0, 2]]) < box[[3, 5]] / 2).all(axis=-1)
    depth = np.where(blocked.any(axis=1), blocked.argmax(axis=1), len(distances) - 1)
    return np.concatenate([place[None], points[np.arange(len(angles)), depth]])


def _floor(scene: Scene) -> np.ndarray:
    """Return the colours of the cells, float [nz, nx, 3].

    Where one can stand the floor is darker than elsewhere.
    """
    colours = np.array([to_rgb(FLOOR), to_rgb(GROUND)])[np.where(scene.reach, 0, 1)]
    kinds = sorted({room.type for room in scene.rooms})
    for room in scene.rooms:
        tint = np.array(to_rgb(TINTS[kinds.index(room.type) % len(TINTS)]))
        colours[room.cells & scene.reach] = tint
        colours[room.cells & ~scene.reach] = (tint + to_rgb(GROUND)) / 2
    colours[scene.walls] = to_rgb(WALL)
    return colours


def _draw_boxes(axes: Axes, scene: Scene, alpha: float) -> None:
    """Draw the boxes of all objects, the highest on top."""
    x, y, z, sx, sy, sz = scene.boxes.T
    top = y + sy / 2
    order = np.argsort(top)
    boxes = [Rectangle((x[i] - sx[i] / 2, z[i] - sz[i] / 2), sx[i], sz[i]) for i in order]
    shades = HEIGHTS(np.clip(top[order] / TALL, 0.0, 1.0))
    axes.add_collection(
        PatchCollection(boxes, facecolor=shades, edgecolor="white", linewidth=0.7, alpha=alpha, zorder=2)
    )


def _draw_objects(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int | None) -> Labels:
    """Mark and name objects of categories, those of `goal` first."""
    ids, places = category_ids(scene.types, categories), scene.boxes[:, [0, 2]]
    objects = sorted((i for i, category in enumerate(ids) if category >= 0), key=lambda i: ids[i] != goal)
    corner = np.asarray(scene.origin) - CELL / 2
    walls = corner + CELL * rectangles(scene.walls)[:, [[1, 0], [3, 2]]]
    labels = Labels(axes, places[objects], walls, halo=GROUND)
    named: list[int] = []
    for i in objects:
        marker, size, colour = ("*", 15, GOAL) if ids[i] == goal else ("o", 4, INK)
        edge = {"markeredgecolor": "white", "markeredgewidth": 0.7, "zorder": 6 if ids[i] == goal else 5}
        axes.plot(places[i, 0], places[i, 1], marker, color=colour, markersize=size, **edge)
        if not any(ids[i] == ids[j] and np.linalg.norm(places[i] - places[j]) < _SAME_LABEL for j in named):
            named.append(i)
            labels.beside(categories[ids[i]], places[i], colour)
    return labels
