"""Pictures of scenes: the plan from above, the view from a pose, and both with a panel of numbers.

`draw_scene` writes the picture of a scene, which `scene_figure` composes. `draw_plan`, `draw_plan_background` and
`draw_agent` draw into any axes and serve the pictures of episodes and searches, too. `LabelPlacer` writes names where
they cover little else.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.transforms import Affine2D

from jaxnav.env.render import (
    AGENT_COLOR,
    BACKGROUND_COLOR,
    CONE_OPACITY,
    FULL_SHADE_HEIGHT,
    GOAL_COLOR,
    HEIGHT_COLORS,
    SEEN_COLOR,
    WALL_COLOR,
    floor_colors,
    view_cone,
)
from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene, scene_extent, scene_size
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, RowFormat, detected_positions
from jaxnav.scenes.tables.visibility import cell_centres, wall_boxes
from jaxnav.scenes.task import Rules, Task
from jaxnav.viz.style import (
    MUTED_COLOR,
    TEXT_COLOR,
    default_style,
    save_figure,
)

SCENE_DPI = 120

HEIGHT_COLORMAP = LinearSegmentedColormap.from_list("height", list(HEIGHT_COLORS))

_ARROW = Outline([(0, 1), (-0.75, -0.9), (0, -0.45), (0.75, -0.9), (0, 1)], closed=True)
_PLAN_MARGIN = 0.05  # metres around the plan
_SHARED_LABEL_DISTANCE = 1.0  # metres within which marks of one category share a label, such as burners of a stove

# Composition of the picture of a scene, in inches. The plan is as large as fits, the panel stands on its right.
_LARGEST_PLAN = np.array([9.0, 8.0])
_NARROWEST_PLAN = 3.0
_PANEL_WIDTH = 2.9
_MARGIN = 0.25
_HEADER_HEIGHT = 0.6
_FOOTER_HEIGHT = 0.35
_DETECTIONS_OFFSET = 3.15  # from the header to the list of detections
_MAX_LINE_LENGTH = 40  # characters in a line of the panel
_LEGEND_STYLE = {"frameon": False, "borderpad": 0, "borderaxespad": 0, "handlelength": 1.4, "handletextpad": 0.6}


class PoseView(NamedTuple):
    """Detections at one pose with a level camera.

    Attributes:
      place: float64 [2], world (x, z).
      yaw: heading, degrees.
      detections: distance in metres, category and world (x, z) of each detected object, the nearest first.
    """

    place: np.ndarray
    yaw: float
    detections: list[tuple[float, str, np.ndarray]]


# The picture of a scene


def draw_scene(
    scene: Scene, task: Task, path: Path, pose: tuple[float, float, float] | None = None, shift: float = 0.0
) -> None:
    """Write the picture of a scene as a PNG.

    Args:
      scene: scene to draw.
      task: categories and rules; the view has the detections of a detector without errors.
      path: file to write.
      pose: x and z in metres and heading in degrees of the level camera; None for the pose that detects most
        categories.
      shift: layout shift of the scene, for the title.

    Raises:
      InputError: the agent cannot stand at the pose, or cannot face that way.
      OSError: the file cannot be written.
    """
    task = dataclasses.replace(task, detector=PERFECT_DETECTOR)
    save_figure(scene_figure(scene, task, view_from_pose(scene, task, pose), shift), path, dpi=SCENE_DPI)


@default_style
def scene_figure(scene: Scene, task: Task, view: PoseView, shift: float = 0.0) -> Figure:
    """Compose the plan of a scene, a view and a panel with numbers.

    Args:
      scene: scene to draw.
      task: categories and rules.
      view: pose to draw, with its detections.
      shift: layout shift of the scene, for the title.
    """
    # The figure is as large as the plan, the panel and the list of detections require.
    low_corner, high_corner = scene_extent(scene)
    plan_size = (high_corner - low_corner) * np.min(_LARGEST_PLAN / (high_corner - low_corner))
    plan_width = max(plan_size[0], _NARROWEST_PLAN)
    detections_text = _describe_detections(view)
    detections_bottom = _DETECTIONS_OFFSET + 0.2 * len(detections_text.splitlines())
    width = _MARGIN + plan_width + _MARGIN + _PANEL_WIDTH
    height = _HEADER_HEIGHT + max(plan_size[1] + _FOOTER_HEIGHT, detections_bottom)
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)

    # The plan with the view in it.
    plan_bottom = 1 - (_HEADER_HEIGHT + plan_size[1]) / height
    axes = figure.add_axes((_MARGIN / width, plan_bottom, plan_width / width, plan_size[1] / height), anchor="NW")
    draw_plan(axes, scene, task.categories)
    legend_handles = [
        *_draw_cells(axes, scene),
        Patch(color=WALL_COLOR, label="wall"),
        *_draw_view(axes, scene, task.rules, view),
    ]
    _draw_scale(axes)

    # The name above the plan, and the texts of the panel; places are in inches from the upper left corner.
    def write(x: float, y: float, text: str, size: float, **style) -> None:
        position = (x / width, 1 - y / height)
        figure.text(*position, text, fontsize=size, color=TEXT_COLOR, va="top", parse_math=False, **style)

    panel_left = width - _PANEL_WIDTH
    title = f"{scene.name}, layout shift {shift:g}" if shift else scene.name
    title_size = min(14.0, 100 * (width - 2 * _MARGIN) / len(title))
    write(_MARGIN, 0.2, title, title_size, weight="bold")
    write(panel_left, _HEADER_HEIGHT, _describe_scene(scene, task), 9, linespacing=1.6)
    write(panel_left, _HEADER_HEIGHT + _DETECTIONS_OFFSET, detections_text, 9, linespacing=1.5)

    # The legend and the scale of heights between these texts.
    figure.legend(
        handles=legend_handles,
        loc="upper left",
        bbox_to_anchor=(panel_left / width, 1 - (_HEADER_HEIGHT + 1.1) / height),
        fontsize=9,
        labelcolor=TEXT_COLOR,
        **_LEGEND_STYLE,
    )
    _draw_height_scale(figure, (panel_left / width, 1 - (_HEADER_HEIGHT + 2.7) / height, 2.2 / width, 0.12 / height))
    return figure


def _draw_cells(axes: Axes, scene: Scene) -> list[Artist]:
    """Draw standable cells as dots and unreachable ones as crosses.

    Cells outside the largest connected part are unreachable.
    """
    cells = standable_cells(scene.reach)
    dots = cell_centres(scene, cells).T
    cell_marks: list[Artist] = [
        axes.scatter(*dots, s=2.5, color=MUTED_COLOR, lw=0, zorder=3, label="standable cell"),
    ]
    is_unreachable = scene.reach.copy()
    is_unreachable[tuple(cells.T)] = False
    if is_unreachable.any():
        crosses = cell_centres(scene, np.argwhere(is_unreachable)).T
        artist_style = {"s": 12, "color": GOAL_COLOR, "marker": "x", "lw": 0.9, "zorder": 3}
        cell_marks.append(axes.scatter(*crosses, label="unreachable cell", **artist_style))
    return cell_marks


def _draw_view(axes: Axes, scene: Scene, rules: Rules, view: PoseView) -> list[Artist]:
    """Draw the view cone, the agent and detected objects."""
    cone, _ = draw_agent(axes, scene, rules, view.place, view.yaw)
    cone.set_label("in view")

    # A view without detections has places of shape [0, 2].
    points = np.reshape([object_place for _, _, object_place in view.detections], (-1, 2))
    artist_style = {"s": 90, "facecolor": "none", "edgecolor": SEEN_COLOR, "lw": 1.6, "zorder": 6}
    rings = axes.scatter(*points.T, label="detected", **artist_style)
    return [cone, rings]


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of one metre below the plan."""
    # x is in metres, y a share of the height of the axes.
    bar_start = axes.get_xlim()[0]
    bar_y = -0.15 * axes.figure.dpi / axes.bbox.height
    artist_style = {"transform": axes.get_xaxis_transform(), "clip_on": False, "color": TEXT_COLOR}
    axes.plot([bar_start, bar_start + 1.0], [bar_y, bar_y], lw=2, solid_capstyle="butt", **artist_style)
    axes.text(bar_start + 1.0, bar_y, "  1 m", fontsize=8.5, va="center", **artist_style)


def _draw_height_scale(figure: Figure, box: tuple[float, float, float, float]) -> None:
    """Draw the scale of the furniture's shades."""
    axes = figure.add_axes(box)
    shades = ScalarMappable(Normalize(0, FULL_SHADE_HEIGHT), HEIGHT_COLORMAP)
    figure.colorbar(shades, axes, orientation="horizontal", ticks=[0, 0.5, 1, 1.5, 2]).outline.set_visible(False)
    axes.set_title("furniture, height of its top in m", fontsize=9, color=TEXT_COLOR, loc="left")
    axes.tick_params(labelsize=8, labelcolor=TEXT_COLOR, length=0)


def _describe_scene(scene: Scene, task: Task) -> str:
    """Return name of the world, size, cells and objects of a scene, a line each."""
    # Size and cells.
    width, depth = scene_size(scene)
    num_standable = len(standable_cells(scene.reach))
    num_free = scene.reach.sum()

    # Categories of the objects that have one.
    object_categories = np.array(category_ids(scene.types, task.categories), int)
    object_categories = object_categories[object_categories >= 0]

    # Homes have rooms, and some scenes have cells that the agent cannot reach.
    rooms_text = f", {len(scene.rooms)} rooms" if scene.rooms else ""
    unreachable_text = f", {num_free - num_standable} cut off" if num_free > num_standable else ""
    text_lines = [
        f"{scene.world}: {scene.room_type.replace('_', ' ')}, {scene.split}",
        f"{width:.1f} x {depth:.1f} m{rooms_text}",
        f"{num_standable} standable cells{unreachable_text}",
        f"{len(scene.types)} objects ({len(object_categories)} in {len(np.unique(object_categories))} categories)",
    ]
    return "\n".join(map(_shorten, text_lines))


def _shorten(line: str) -> str:
    return line if len(line) <= _MAX_LINE_LENGTH else line[: _MAX_LINE_LENGTH - 1] + "…"


def _describe_detections(view: PoseView) -> str:
    """Return the pose of a view and its detections, a line each."""
    x, z = view.place
    lines = [f"Pose: x {x:g}, z {z:g}, heading {view.yaw:g}°"]
    lines.append("Detected from there:" if view.detections else "Nothing is detected from there.")
    for distance, name, _ in view.detections:
        lines.append(f"{name}, {distance:.1f} m")
    return "\n".join(lines)


# The view from a pose


def view_from_pose(scene: Scene, task: Task, pose: tuple[float, float, float] | None = None) -> PoseView:
    """Return the detections at a pose of a scene.

    Args:
      scene: scene to look at.
      task: categories, rules and detector; a detector without errors reports every visible category.
      pose: x and z in metres and heading in degrees; None for the first of the poses that detect most categories.

    Raises:
      InputError: the agent cannot stand at the pose, or cannot face that way.
    """
    rules = task.rules
    row_format = RowFormat(len(task.categories))
    centres = cell_centres(scene, standable_cells(scene.reach))
    rows = compile_scene(scene, task).rows[:: len(rules.horizons)]  # of the level camera

    # Level poses are numbered cell * H + heading.
    if pose is None:
        level_pose = int(row_format.presence(rows).sum(axis=1).argmax())
    else:
        level_pose = _find_level_pose(centres, rules, *pose)
    cell, heading = divmod(level_pose, rules.headings)
    place = centres[cell]
    detections = row_format.detections(rows[level_pose])
    reported_places = detected_positions(detections, place, rules.heading_directions()[heading])

    # A detection is rounded to bytes, so its object is the nearest to the reported place.
    object_categories = np.array(category_ids(scene.types, task.categories))
    object_places = scene.boxes[:, [0, 2]]
    detection_list: list[tuple[float, str, np.ndarray]] = []
    for category in np.flatnonzero(detections[:, 0]):
        candidates = object_places[object_categories == category]
        nearest_index = np.linalg.norm(candidates - reported_places[category], axis=1).argmin()
        point = candidates[nearest_index]
        distance = float(np.linalg.norm(point - place))
        detection_list.append((distance, task.categories[category], point))
    yaw = 360.0 / rules.headings * heading
    return PoseView(place, yaw, sorted(detection_list, key=lambda detection: detection[0]))


def _find_level_pose(centres: np.ndarray, rules: Rules, x: float, z: float, yaw: float) -> int:
    """Return the number of a level pose, cell * H + heading."""
    distance = np.linalg.norm(centres - (x, z), axis=1)
    cell = int(np.argmin(distance))
    if not np.abs(centres[cell] - (x, z)).max() <= CELL_SIZE / 2:
        raise InputError(
            f"--pose {x:g} {z:g} {yaw:g}: no agent can stand there; the nearest place is {centres[cell, 0]:g} "
            f"{centres[cell, 1]:g}"
        )
    turn_angle = 360.0 / rules.headings
    if yaw % turn_angle != 0:
        raise InputError(f"--pose {x:g} {z:g} {yaw:g}: give a heading that is a multiple of {turn_angle:g} degrees")
    return cell * rules.headings + int(yaw // turn_angle) % rules.headings


# The plan


def draw_plan(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int | None = None) -> None:
    """Draw walls, floor, furniture and the objects of categories.

    Taller boxes are darker. An object of a category is a dot with a name, an object of the category `goal` a star. The
    rooms of a home are tinted by their types and named.
    """
    draw_plan_background(axes, scene, alpha=1.0)
    labels = _draw_objects(axes, scene, categories, goal)
    for room in scene.rooms:
        # The name of a room stands on free floor, if there is any.
        free_cells = room.cells & scene.reach
        iz, ix = np.nonzero(free_cells if free_cells.any() else room.cells)
        places = np.asarray(scene.origin) + CELL_SIZE * np.stack([ix, iz], axis=-1)
        labels.label_area(room.type.replace("_", " "), places, WALL_COLOR)


def draw_plan_background(axes: Axes, scene: Scene, alpha: float = 0.3) -> None:
    """Draw walls, floor and furniture without names.

    Args:
      axes: axes to draw in, which get the limits of the plan.
      scene: scene to draw.
      alpha: opacity.
    """
    # Floor and walls are an image of the cells, under the boxes of the furniture.
    low_corner, high_corner = scene_extent(scene)
    nz, nx = scene.reach.shape
    corner = np.asarray(scene.origin) - CELL_SIZE / 2
    sides = (corner[0], corner[0] + CELL_SIZE * nx, corner[1], corner[1] + CELL_SIZE * nz)
    axes.imshow(floor_colors(scene), origin="lower", extent=sides, interpolation="nearest", alpha=alpha)
    _draw_boxes(axes, scene, alpha)

    # Limits of the plan, without ticks and spines.
    low_corner = low_corner - _PLAN_MARGIN
    high_corner = high_corner + _PLAN_MARGIN
    axes.set(
        xlim=(low_corner[0], high_corner[0]),
        ylim=(low_corner[1], high_corner[1]),
        aspect="equal",
        xticks=[],
        yticks=[],
        facecolor=BACKGROUND_COLOR,
    )
    axes.spines[:].set_visible(False)
    axes.apply_aspect()


def draw_agent(axes: Axes, scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> tuple[Polygon, Line2D]:
    """Draw the view cone, and the agent as an arrow.

    Args:
      axes: axes of the plan.
      scene: scene whose walls and tall boxes end the cone.
      rules: field of view and height of the camera.
      place: float [2], world (x, z).
      yaw: heading, degrees.
    """
    outline = view_cone(scene, rules, place, yaw)
    (cone,) = axes.fill(*outline.T, color=AGENT_COLOR, alpha=CONE_OPACITY, lw=0, zorder=3)
    marker = MarkerStyle(_ARROW, transform=Affine2D().rotate_deg(-yaw))
    (arrow,) = axes.plot(*place, marker=marker, color=AGENT_COLOR, markersize=15, markeredgecolor="white", zorder=8)
    return cone, arrow


def _draw_boxes(axes: Axes, scene: Scene, alpha: float) -> None:
    """Draw the boxes of all objects, the highest on top."""
    x, y, z, size_x, size_y, size_z = scene.boxes.T
    box_top = y + size_y / 2
    by_height = np.argsort(box_top)
    rectangle_patches = []
    for i in by_height:
        corner = (x[i] - size_x[i] / 2, z[i] - size_z[i] / 2)
        rectangle_patches.append(Rectangle(corner, size_x[i], size_z[i]))
    shades = HEIGHT_COLORMAP(np.clip(box_top[by_height] / FULL_SHADE_HEIGHT, 0.0, 1.0))
    artist_style = {"edgecolor": "white", "linewidth": 0.7, "alpha": alpha, "zorder": 2}
    axes.add_collection(PatchCollection(rectangle_patches, facecolor=shades, **artist_style))


def _draw_objects(axes: Axes, scene: Scene, categories: tuple[str, ...], goal: int | None) -> "LabelPlacer":
    """Mark and name the objects of categories, the objects of `goal` first."""
    # Indices of the objects with a category.
    object_categories = category_ids(scene.types, categories)
    places = scene.boxes[:, [0, 2]]
    objects = np.flatnonzero(np.array(object_categories, int) >= 0).tolist()
    objects.sort(key=lambda object_index: object_categories[object_index] != goal)

    # Labels avoid the dots and the walls.
    labels = LabelPlacer(axes, places[objects], wall_boxes(scene, scene.walls), halo=BACKGROUND_COLOR)

    # A mark for each object, and a label for each group of objects.
    labelled_places: dict[int, list[np.ndarray]] = {}
    for object_index in objects:
        is_goal = object_categories[object_index] == goal
        marker, size, color = ("*", 15, GOAL_COLOR) if is_goal else ("o", 4, TEXT_COLOR)
        artist_style = {"markeredgecolor": "white", "markeredgewidth": 0.7, "zorder": 6 if is_goal else 5}
        axes.plot(*places[object_index], marker, color=color, markersize=size, **artist_style)

        # Objects of one category that stand together share a label.
        same_category_places = labelled_places.setdefault(object_categories[object_index], [])
        if not is_any_near(places[object_index], same_category_places):
            same_category_places.append(places[object_index])
            labels.label_point(categories[object_categories[object_index]], places[object_index], color)
    return labels


def is_any_near(place: np.ndarray, other_places: Sequence[np.ndarray]) -> bool:
    """Return True if any other place [2] is so near that one label serves both."""
    return any(np.linalg.norm(place - other_place) < _SHARED_LABEL_DISTANCE for other_place in other_places)


class LabelPlacer:
    """Writes names on a plan where they cover the least.

    Covering an earlier name, a dot or a wall has a cost for each pixel, which is half as large for walls. The first of
    equally good positions is used.
    """

    def __init__(self, axes: Axes, dots: np.ndarray, walls: np.ndarray, halo: str) -> None:
        """Register dots and walls.

        Args:
          axes: axes of the plan, with their final limits and position.
          dots: float [N, 2], world (x, z) of the dots.
          walls: float [M, 2, 2], low and high corner (x, z) of each wall.
          halo: color around the letters.
        """
        self._axes = axes
        self._halo = withStroke(linewidth=1.6, foreground=halo)
        self._point_size = axes.figure.dpi / 72  # pixels

        # Boxes to avoid in pixels, [N, (low, high), (x, y)], and the cost of covering a pixel of each.
        dot_pixels = axes.transData.transform(dots.reshape(-1, 2))
        wall_corners = axes.transData.transform(walls.reshape(-1, 2))
        dot_boxes = dot_pixels[:, None] + 3 * self._point_size * np.array([[-1, -1], [1, 1]])
        self._occupied_boxes = np.concatenate([dot_boxes, wall_corners.reshape(-1, 2, 2)])
        self._costs = np.repeat([1.0, 0.5], [len(dot_boxes), len(wall_corners) // 2])

    def label_point(self, name: str, place: np.ndarray, color: str) -> None:
        """Write a name next to the dot at `place` [2]."""
        text = self._add_text(name, color, fontsize=7)
        size = np.array(text.get_window_extent().size)
        width, height = size

        # Candidates around the dot, the nearest first: left and right of it, below and above, then the corners.
        label_offsets: list[tuple[float, float]] = []
        for label_gap in self._point_size * np.array([5, 9, 14]):
            sides = (label_gap, -label_gap - width)
            label_offsets += [(side, -height / 2) for side in sides]
            label_offsets += [(-width / 2, label_gap), (-width / 2, -label_gap - height)]
            for level in (label_gap / 3, -label_gap / 3 - height):
                label_offsets += [(side, level) for side in sides]
        self._move_to_best(text, self._axes.transData.transform(place) + np.array(label_offsets), size)

    def label_area(self, name: str, places: np.ndarray, color: str) -> None:
        """Write the name of an area, centred on one of its places, preferably near its middle.

        Args:
          name: name to write.
          places: float [N, 2], world (x, z) of the area.
          color: color of the letters.
        """
        text = self._add_text(name, color, fontsize=9, style="italic", parse_math=False)
        distance_to_middle = np.linalg.norm(places - places.mean(axis=0), axis=1)
        places = places[np.argsort(distance_to_middle, kind="stable")]
        size = np.array(text.get_window_extent().size)
        self._move_to_best(text, self._axes.transData.transform(places) - size / 2, size)

    def _add_text(self, name: str, color: str, **font) -> Text:
        return self._axes.text(0, 0, name, color=color, va="bottom", path_effects=[self._halo], zorder=7, **font)

    def _move_to_best(self, text: Text, corners: np.ndarray, size: np.ndarray) -> None:
        """Move a text to the best of the lower left corners [N, 2], in pixels."""
        # The cost of a position: the area that the text would cover of each occupied box.
        text_boxes = np.stack([corners, corners + size], axis=1)
        overlap_low = np.maximum(text_boxes[:, None, 0], self._occupied_boxes[:, 0])
        overlap_high = np.minimum(text_boxes[:, None, 1], self._occupied_boxes[:, 1])
        position_cost = np.prod(np.maximum(overlap_high - overlap_low, 0.0), axis=-1) @ self._costs

        # The area outside the axes costs twice as much.
        frame = self._axes.bbox
        size_inside = np.minimum(text_boxes[:, 1], frame.max) - np.maximum(text_boxes[:, 0], frame.min)
        position_cost += 2 * (np.prod(size) - np.prod(np.maximum(size_inside, 0.0), axis=-1))

        best_index = int(np.argmin(np.round(position_cost)))
        x, y = self._axes.transData.inverted().transform(corners[best_index])
        text.set_position((x, y))
        self._occupied_boxes = np.concatenate([self._occupied_boxes, text_boxes[best_index : best_index + 1]])
        self._costs = np.append(self._costs, 1.0)
