"""One scene as a picture: its plan, where one can stand, and what is detected from one pose."""

import dataclasses
import difflib
import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from rich.console import Console

from jaxnav.cli.telling import Source
from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.detector import PERFECT
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, RowFormat
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Rules, Task
from jaxnav.store.files import write_atomic
from jaxnav.viz.episode import AGENT, ARROW, SEEN
from jaxnav.viz.plan import GOAL, HEIGHTS, INK, PALE, TALL, WALL, draw_room, extent, scene_size, view_cone

DPI = 120
# Inches: the plan is as large as fits between these sides, the panel beside it.
_LARGEST, _NARROWEST = np.array([9.0, 8.0]), 3.0
_PANEL, _MARGIN, _HEAD, _FOOT, _REPORT = 2.9, 0.25, 0.6, 0.35, 3.15
_LINE = 40  # characters in a line of the panel
_LEGEND = {"frameon": False, "borderpad": 0, "borderaxespad": 0, "handlelength": 1.4, "handletextpad": 0.6}


@dataclasses.dataclass(frozen=True)
class ShowConfig(Source):
    """A picture of one scene.

    Attributes:
      scene: name of the scene; default: the first.
      index: its number instead, from 0.
      pose: x and z in metres and heading in degrees of the level camera; default: what detects most categories.
      out: PNG to write; default: the scene's name in the working directory.
    """

    scene: str | None = None
    index: int | None = None
    pose: tuple[float, float, float] | None = None
    out: Path | None = None


class View(NamedTuple):
    """What a detector without errors reports at one pose with a level camera.

    Attributes:
      place: float64 [2], world (x, z).
      yaw: heading, degrees.
      seen: distance in metres, category and world (x, z) of what is detected, the nearest first.
    """

    place: np.ndarray
    yaw: float
    seen: list[tuple[float, str, np.ndarray]]


def show_scene(config: ShowConfig, console: Console) -> None:
    """Draw the scene and write the picture.

    Raises:
      InputError: no such scene, a pose where nobody can stand, or a file that cannot be read or written.
    """
    scene, task = choose(config), dataclasses.replace(config.task, detector=PERFECT)
    out = config.out or Path(re.sub(r"[^\w.-]", "_", scene.name) + ".png")
    if out.suffix != ".png":
        raise InputError(f"--out {out}: give a name that ends in .png")
    picture = io.BytesIO()
    scene_figure(scene, task, view_from(scene, task, config.pose)).savefig(picture, dpi=DPI)
    try:
        write_atomic(out, picture.getvalue())
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror}); give another name") from error
    console.print(f"{scene.name} drawn; written to {out}", markup=False, soft_wrap=True)


def choose(config: ShowConfig) -> Scene:
    """The scene by its name or number, else the first.

    Raises:
      InputError: there is no such scene, or both are given.
    """
    if config.scene is not None and config.index is not None:
        raise InputError("--scene, --index: both are given; give the scene's name or its number")
    if config.scene is None:
        index = config.index or 0
        if index < 0:
            raise InputError(f"--index {index}: give 0 or more")
        scenes = config.scenes(config.task, index + 1)
        if index >= len(scenes):
            raise InputError(f"--index {index}: {config.file} holds {len(scenes)} scenes; give 0 to {len(scenes) - 1}")
        return scenes[index]
    scenes = config.scenes(config.task)
    named = {scene.name: scene for scene in (scenes[i] for i in range(len(scenes)))}
    if config.scene not in named:
        near = difflib.get_close_matches(config.scene, named, n=3)
        mend = f"did you mean {' or '.join(near)}?" if near else f"it holds {', '.join(list(named)[:3])}, ..."
        raise InputError(f"--scene {config.scene!r}: is none of the {len(named)} scenes of {config.file}; {mend}")
    return named[config.scene]


def view_from(scene: Scene, task: Task, pose: tuple[float, float, float] | None) -> View:
    """What is detected from a pose (x, z, heading), else from the first of those that detect most categories.

    Raises:
      InputError: nobody can stand there, or look that way.
    """
    rules, row_format = task.rules, RowFormat(len(task.categories))
    centres = cell_centres(scene, standable_cells(scene.reach))
    rows = compile_scene(scene, task).rows[:: len(rules.horizons)]  # of the level camera
    best = int(row_format.presence(rows).sum(axis=1).argmax()) if pose is None else _pose(centres, rules, *pose)
    cell, heading = divmod(best, rules.headings)
    place, forward = centres[cell], rules.directions()[heading]
    confidence, ahead, right, _ = row_format.detections(rows[best]).astype(np.float64).T
    reported = place + np.outer(ahead / AHEAD_SCALE, forward)
    reported += np.outer((right - 128.0) / RIGHT_SCALE, (forward[1], -forward[0]))
    ids, places = np.array(category_ids(scene.types, task.categories)), scene.boxes[:, [0, 2]]
    seen: list[tuple[float, str, np.ndarray]] = []
    for category in np.flatnonzero(confidence):
        # The row's bytes are rounded to centimetres: the object is the one that is nearest to where they say.
        own = places[ids == category]
        point = own[np.linalg.norm(own - reported[category], axis=1).argmin()]
        seen.append((float(np.linalg.norm(point - place)), task.categories[category], point))
    return View(place, 360.0 / rules.headings * heading, sorted(seen, key=lambda item: item[0]))


def _pose(centres: np.ndarray, rules: Rules, x: float, z: float, yaw: float) -> int:
    """Index of a level pose: cell H + heading."""
    distance = np.linalg.norm(centres - (x, z), axis=1)
    cell, turn = int(np.argmin(distance)), 360.0 / rules.headings
    if not np.abs(centres[cell] - (x, z)).max() <= CELL / 2:
        raise InputError(
            f"--pose {x:g} {z:g} {yaw:g}: nobody can stand there; the nearest place is {centres[cell, 0]:g} "
            f"{centres[cell, 1]:g}"
        )
    if yaw % turn != 0:
        raise InputError(f"--pose {x:g} {z:g} {yaw:g}: give a heading that is a multiple of {turn:g} degrees")
    return cell * rules.headings + int(yaw // turn) % rules.headings


def scene_figure(scene: Scene, task: Task, view: View) -> Figure:
    """The plan of a scene, a view in it, and a panel with its numbers."""
    low, high = extent(scene)
    plan = (high - low) * np.min(_LARGEST / (high - low))
    report = _report(view)
    width = _MARGIN + max(plan[0], _NARROWEST) + _MARGIN + _PANEL
    height = _HEAD + max(plan[1] + _FOOT, _REPORT + 0.2 * len(report.splitlines()))
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
    write(left, _HEAD + _REPORT, report, 9, linespacing=1.5)
    corner = (left / width, 1 - (_HEAD + 1.1) / height)
    figure.legend(handles=marks, loc="upper left", bbox_to_anchor=corner, fontsize=9, labelcolor=INK, **_LEGEND)
    bar = figure.add_axes((left / width, 1 - (_HEAD + 2.7) / height, 2.2 / width, 0.12 / height))
    shades = ScalarMappable(Normalize(0, TALL), HEIGHTS)
    figure.colorbar(shades, bar, orientation="horizontal", ticks=[0, 0.5, 1, 1.5, 2]).outline.set_visible(False)
    bar.set_title("furniture, height of its top in m", fontsize=9, color=INK, loc="left")
    bar.tick_params(labelsize=8, labelcolor=INK, length=0)
    return figure


def _draw_cells(axes: Axes, scene: Scene) -> list[Artist]:
    """A dot on every standable cell, a cross on those that cannot be walked to from the others."""
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
    """The view cone, the agent, and rings around what is detected."""
    outline = view_cone(scene, rules, view.place, view.yaw)
    cone = axes.fill(*outline.T, color=AGENT, alpha=0.16, lw=0, zorder=3, label="in view")
    marker = MarkerStyle(ARROW, transform=Affine2D().rotate_deg(-view.yaw))
    axes.plot(*view.place, marker=marker, color=AGENT, markersize=15, markeredgecolor="white", zorder=8)
    points = np.reshape([point for *_, point in view.seen], (-1, 2))
    rings = axes.scatter(*points.T, s=90, facecolor="none", edgecolor=SEEN, lw=1.6, zorder=6, label="detected")
    return [*cone, rings]


def _draw_scale(axes: Axes) -> None:
    """A bar of one metre below the plan."""
    left, down = axes.get_xlim()[0], -0.15 * axes.figure.dpi / axes.bbox.height
    at = {"transform": axes.get_xaxis_transform(), "clip_on": False, "color": INK}
    axes.plot([left, left + 1.0], [down, down], lw=2, solid_capstyle="butt", **at)
    axes.text(left + 1.0, down, "  1 m", fontsize=8.5, va="center", **at)


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


def _report(view: View) -> str:
    lines = [f"{name}, {distance:.1f} m" for distance, name, _ in view.seen]
    x, z = view.place
    head = f"From x {x:g}, z {z:g}, heading {view.yaw:g}°"
    return "\n".join([head, "is detected:" if lines else "nothing is detected.", *lines])
