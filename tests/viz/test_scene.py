"""Tests of the picture of a scene: its marks, its default pose, and names that do not overlap."""

import dataclasses

import numpy as np
import pytest
from support.scenes import SMALL, draw

from jaxnav.scenes.scene import Room, scene_extent, scene_size
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes
from jaxnav.viz.scene import draw_plan, scene_figure, view_from_pose

TASK = Task(detector=PERFECT_DETECTOR)
# Cells from (0, 0) to (0, 2) m, an unreachable cell at (0.75, 0), and a wall on the right.
HALL = draw(
    [".##.#"] + [".####"] * 8,
    ("Book", 0.0, 0.8, 2.5, *SMALL),
    ("Chair", 0.0, 0.5, -1.0, 0.5, 0.9, 0.5),
    ("Bowl", 0.25, 0.8, 2.5, *SMALL),
    ("Sofa", 0.5, 0.4, 1.0, 0.5, 0.8, 0.5),
    walls=[(row, 4) for row in range(9)],
)
SCALE_LABEL = "  1 m"


def draw_default_plan(scene, task=TASK):
    """Axes of the plan, with the view from the default pose."""
    return scene_figure(scene, task, view_from_pose(scene, task, None)).axes[0]


def sorted_labels(axes):
    return sorted(text.get_text() for text in axes.texts)


def all_text(figure):
    return "\n".join(text.get_text() for text in figure.texts)


def count_overlaps(boxes):
    """Number of pairs of boxes that overlap."""
    num_overlaps = 0
    for index, box in enumerate(boxes):
        num_overlaps += sum(box.overlaps(earlier_box) for earlier_box in boxes[:index])
    return num_overlaps


def detected_names(view):
    return [name for _, name, _ in view.detections]


def test_view_from_pose_detects_objects_ahead_by_distance():
    # From (0, 1.5) the distance to the book is 1 m, and to the bowl sqrt(1 + 1/16); the chair is behind.
    view = view_from_pose(HALL, TASK, (0.05, 1.45, 0.0))
    assert view.place.tolist() == [0.0, 1.5]
    detected_places = [(name, place.tolist()) for _, name, place in view.detections]
    assert detected_places == [("Book", [0, 2.5]), ("Bowl", [0.25, 2.5])]
    np.testing.assert_allclose([distance for distance, *_ in view.detections], [1.0, np.sqrt(1.0625)])


def test_view_from_pose_normalises_the_heading():
    view = view_from_pose(HALL, TASK, (0.0, 1.5, -180.0))
    assert view.yaw == 180.0
    assert detected_names(view) == ["Chair"]


def test_default_pose_detects_the_most_objects():
    # All cells of the hall and all headings.
    num_detections = []
    for row in range(9):
        for heading in range(8):
            view = view_from_pose(HALL, TASK, (0.0, 0.25 * row, 45.0 * heading))
            num_detections.append(len(view.detections))

    default_view = view_from_pose(HALL, TASK, None)
    assert detected_names(default_view) == ["Book", "Bowl"]
    assert len(default_view.detections) == max(num_detections)
    assert min(num_detections) == 0


def test_scene_figure_draws_boxes_cells_and_detections():
    figure = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, (0.0, 1.5, 0.0)))
    plan = figure.axes[0]

    # Only objects of the categories have names; the sofa belongs to none.
    assert sorted_labels(plan) == [SCALE_LABEL, "Book", "Bowl", "Chair"]

    # Four boxes, nine standable cells, one unreachable cell, rings around both detections.
    boxes, cells, crosses, rings = plan.collections
    assert len(boxes.get_paths()) == 4
    assert len(np.asarray(cells.get_offsets())) == 9
    assert np.asarray(crosses.get_offsets()).tolist() == [[0.75, 0.0]]
    assert sorted(np.asarray(rings.get_offsets()).tolist()) == [[0.0, 2.5], [0.25, 2.5]]

    # The bar of the scale is one metre long.
    bar_start, bar_end = np.asarray(plan.lines[-1].get_xdata())
    assert bar_end - bar_start == 1.0
    assert len(figure.legends[0].get_texts()) == 5


def test_scene_figure_describes_scene_and_view():
    text = all_text(scene_figure(HALL, TASK, view_from_pose(HALL, TASK, (0.0, 1.5, 0.0))))
    # Without the wall, x goes from -0.3 (the side of the book) to 0.875 and z from -1.25 to 2.525.
    for part in (
        "drawn",
        "kitchen, train",
        "1.2 x 3.8 m",
        "9 standable cells, 1 cut off",
        "4 objects (3 in 3 categories)",
        "heading 0°",
        "Book, 1.0 m",
        "Bowl, 1.0 m",
    ):
        assert part in text


def test_scene_figure_names_the_shift_of_a_shifted_scene():
    view = view_from_pose(HALL, TASK, (0.0, 1.5, 0.0))
    assert "layout shift 0.5" in all_text(scene_figure(HALL, TASK, view, 0.5))
    assert "layout shift" not in all_text(scene_figure(HALL, TASK, view))


def test_scene_extent_includes_walls_and_scene_size_does_not():
    low_corner, high_corner = scene_extent(HALL)
    np.testing.assert_allclose([low_corner, high_corner], [[-0.3, -1.25], [1.125, 2.525]])
    np.testing.assert_allclose(scene_size(HALL), [0.875 + 0.3, 2.525 + 1.25])


def test_scene_figure_of_a_scene_without_objects_has_no_names():
    bare_scene = draw(["..", ".."])
    figure = scene_figure(bare_scene, TASK, view_from_pose(bare_scene, TASK, None))
    assert sorted_labels(figure.axes[0]) == [SCALE_LABEL]
    assert "Nothing is detected" in all_text(figure)


def test_scene_figure_tints_and_names_rooms():
    living_room = np.zeros((9, 5), bool)
    living_room[:, 0] = True
    bedroom = np.zeros((9, 5), bool)
    bedroom[:, 3] = True
    home = dataclasses.replace(HALL, rooms=(Room("living_room", living_room), Room("bedroom", bedroom)))
    plan = draw_default_plan(home)
    assert {"living room", "bedroom"} < set(sorted_labels(plan))

    # Only the cells of rooms change colour, and rooms differ.
    tinted_pixels = np.asarray(plan.images[0].get_array())
    plain_pixels = np.asarray(draw_default_plan(HALL).images[0].get_array())
    assert (tinted_pixels != plain_pixels).any(axis=-1).tolist() == (living_room | bedroom).tolist()
    assert not np.array_equal(tinted_pixels[0, 0], tinted_pixels[0, 3])


@pytest.mark.parametrize(("world", "index"), [("rooms", 0), ("rooms", 3), ("apartments", 0), ("houses", 0)])
def test_scene_figure_neither_overlaps_nor_clips_names(world, index):
    scene = make_generated_scenes(world, "val")[index]
    task = dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR)
    figure = scene_figure(scene, task, view_from_pose(scene, task, None))
    plan = figure.axes[0]

    # Names lie within the plan and apart.
    name_boxes = [text.get_window_extent() for text in plan.texts if text.get_text() != SCALE_LABEL]
    assert len(name_boxes) >= 3
    plan_box = plan.bbox.padded(1)
    assert all(plan_box.containsx(box.x0) and plan_box.containsx(box.x1) for box in name_boxes)
    assert count_overlaps([box.shrunk(0.98, 0.9) for box in name_boxes]) == 0

    # The description lies within the figure, next to the plan.
    text_boxes = [text.get_window_extent() for text in figure.texts]
    assert all(box.x1 < figure.bbox.x1 and box.y0 > 0 for box in text_boxes)
    assert not any(box.overlaps(plan.bbox) for box in text_boxes)


def test_scene_figure_spreads_a_crowd_of_names():
    # Two dozen objects 0.15 m apart: their names overlap unless they are moved.
    crowd = []
    for index in range(24):
        category = TASK.categories[index % 22]
        crowd.append((category, 0.5 + 0.15 * index, 0.8, 1.0 + 1.1 * (index % 2), *SMALL))
    plan = draw_default_plan(draw(["." * 20] * 16, *crowd))
    name_boxes = [text.get_window_extent() for text in plan.texts]
    assert len(name_boxes) >= 23
    assert count_overlaps(name_boxes) <= 4


def test_draw_plan_marks_the_goal_with_a_star():
    figure = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, None))
    axes = figure.add_axes((0, 0, 1, 1))
    draw_plan(axes, HALL, TASK.categories, TASK.categories.index("Bowl"))
    star_places = [np.asarray(line.get_data()).tolist() for line in axes.lines if line.get_marker() == "*"]
    assert star_places == [[[0.25], [2.5]]]
