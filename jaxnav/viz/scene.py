"""The picture of one scene, with a view."""

import dataclasses
import io
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene, extent, scene_size
from jaxnav.scenes.tables.detector import PERFECT
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Rules, Task
from jaxnav.store.files import write_atomic
from jaxnav.viz.plan import GOAL, HEIGHTS, INK, PALE, SEEN, TALL, WALL, draw_agent, draw_room
from jaxnav.viz.view import View, view_from

DPI = 120
# Inches: the plan is as large as fits between these sides, the panel beside it.
_LARGEST, _NARROWEST = np.array([9.0, 8.0]), 3.0
_PANEL, _MARGIN, _HEAD, _FOOT, _DETECTIONS = 2.9, 0.25, 0.6, 0.35, 3.15
_LINE = 40  # characters in a line of the panel
_LEGEND = {"frameon": False, "borderpad": 0, "borderaxespad": 0, "handlelength": 1.4, "handletextpad": 0.6}


def draw_scene(scene: Scene, task: Task, path: Path, pose: tuple[float, float, float] | None = None) -> None:
    """Write the picture of a scene as a PNG.

    Args:
      scene: what to draw.
      task: categories and rules; the view is that of a detector without errors.
      path: the file.
      pose: x and z in metres and heading in degrees of the level camera; None for what detects most categories.

    Raises:
      InputError: nobody can stand at the pose, or look that way.
      OSError: the file cannot be written.
    """
    task = dataclasses.replace(task, detector=PERFECT)
    picture = io.BytesIO()
    scene_figure(scene, task, view_from(scene, task, pose)).savefig(picture, dpi=DPI)
    write_atomic(path, picture.getvalue())


def scene_figure(scene: Scene, task: Task, view: View) -> Figure:
    """Draw a plan, a view and a panel with numbers."""
    low, high = extent(scene)
    plan = (high - low) * np.min(_LARGEST / (high - low))
    detections = _detections(view)
    width = _MARGIN + max(plan[0], _NARROWEST) + _MARGIN + _PANEL
    height = _HEAD + max(plan[1] + _FOOT, _DETECTIONS + 0.2 * len(detections.splitlines()))
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    box = (_MARGIN / width, 1 - (_HEAD + plan[1]) / height, max(plan[0], _NARROWEST) / width, plan[1] / height)
    axes = figure.add_axes(box, anchor="NW")
    draw_room(axes, scene, task.categories)
    marks = [*_draw_cells(axes, scene), Patch(color=WALL, label="wall"), *_draw_view(axes, scene, task.rules, view)]
    _draw_scale(axes)

    def write(x: float, down: float, text: str, size: float, **more) -> None:
        figure.text(x / width, 1 - down / height, text, fontsize=size, color=INK, va="top", parse_math=False, **more)

    left = width - _PANEL
    write(_MARGIN, 0.2, scene.name, min(14.0, 100 * (width - 2 * _MARGIN) / len(scene.name)), weight="bold")
    write(left, _HEAD, _facts(scene, task), 9, linespacing=1.6)
    write(left, _HEAD + _DETECTIONS, detections, 9, linespacing=1.5)
    corner = (left / width, 1 - (_HEAD + 1.1) / height)
    figure.legend(handles=marks, loc="upper left", bbox_to_anchor=corner, fontsize=9, labelcolor=INK, **_LEGEND)
    _draw_heights(figure, (left / width, 1 - (_HEAD + 2.7) / height, 2.2 / width, 0.12 / height))
    return figure


def _draw_cells(axes: Axes, scene: Scene) -> list[Artist]:
    """Draw standable cells as dots and unreachable ones as crosses.

    Unreachable are the cells outside the largest connected part.
    """
    cells = standable_cells(scene.reach)
    apart = scene.reach.copy()
    apart[tuple(cells.T)] = False
    marks: list[Artist] = [
        axes.scatter(*cell_centres(scene, cells).T, s=2.5, color=PALE, lw=0, zorder=3, label="standable cell")
    ]
    if apart.any():
        crosses = cell_centres(scene, np.argwhere(apart)).T
        marks.append(axes.scatter(*crosses, s=12, color=GOAL, marker="x", lw=0.9, zorder=3, label="cut off from those"))
    return marks


def _draw_view(axes: Axes, scene: Scene, rules: Rules, view: View) -> list[Artist]:
    """Draw the view cone, the agent and detected objects."""
    cone, _ = draw_agent(axes, scene, rules, view.place, view.yaw)
    cone.set_label("in view")
    points = np.reshape([point for *_, point in view.seen], (-1, 2))
    rings = axes.scatter(*points.T, s=90, facecolor="none", edgecolor=SEEN, lw=1.6, zorder=6, label="detected")
    return [cone, rings]


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of one metre below the plan."""
    left, down = axes.get_xlim()[0], -0.15 * axes.figure.dpi / axes.bbox.height
    at = {"transform": axes.get_xaxis_transform(), "clip_on": False, "color": INK}
    axes.plot([left, left + 1.0], [down, down], lw=2, solid_capstyle="butt", **at)
    axes.text(left + 1.0, down, "  1 m", fontsize=8.5, va="center", **at)


def _draw_heights(figure: Figure, box: tuple[float, float, float, float]) -> None:
    """Draw the scale of the furniture's shades."""
    bar = figure.add_axes(box)
    shades = ScalarMappable(Normalize(0, TALL), HEIGHTS)
    figure.colorbar(shades, bar, orientation="horizontal", ticks=[0, 0.5, 1, 1.5, 2]).outline.set_visible(False)
    bar.set_title("furniture, height of its top in m", fontsize=9, color=INK, loc="left")
    bar.tick_params(labelsize=8, labelcolor=INK, length=0)


def _facts(scene: Scene, task: Task) -> str:
    width, depth = scene_size(scene)
    standable, cells = len(standable_cells(scene.reach)), scene.reach.sum()
    ids = [category for category in category_ids(scene.types, task.categories) if category >= 0]
    lines = [
        f"{scene.world}: {scene.room_type.replace('_', ' ')}, {scene.split}",
        f"{width:.1f} x {depth:.1f} m" + (f", {len(scene.rooms)} rooms" if scene.rooms else ""),
        f"{standable} standable cells" + (f", {cells - standable} cut off" if cells > standable else ""),
        f"{len(scene.types)} objects, {len(ids)} of {len(set(ids))} categories",
    ]
    return "\n".join(line if len(line) <= _LINE else line[: _LINE - 1] + "…" for line in lines)


def _detections(view: View) -> str:
    lines = [f"{name}, {distance:.1f} m" for distance, name, _ in view.seen]
    x, z = view.place
    head = f"From x {x:g}, z {z:g}, heading {view.yaw:g}°"
    return "\n".join([head, "is detected:" if lines else "nothing is detected.", *lines])
