"""The picture of a scene: what is drawn, from which pose, and that names stay apart."""

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
# Cells (0, 0) to (0, 2) m and, with no way there, one at (1, 0); a wall on the right.
HALL = draw(
    [".##.#"] + [".####"] * 8,
    ("Book", 0.0, 0.8, 2.5, *SMALL),
    ("Chair", 0.0, 0.5, -1.0, 0.5, 0.9, 0.5),
    ("Bowl", 0.25, 0.8, 2.5, *SMALL),
    ("Sofa", 0.5, 0.4, 1.0, 0.5, 0.8, 0.5),
    walls=[(iz, 4) for iz in range(9)],
)


def names(axes):
    return sorted(text.get_text() for text in axes.texts)


def test_a_pose_is_drawn_as_it_was_asked_for():
    # From (0, 1.5) to the book is 1 m, to the bowl the root of 1 + 1/16; the chair is behind.
    view = view_from_pose(HALL, TASK, (0.05, 1.45, 0.0))
    assert view.place.tolist() == [0.0, 1.5]
    assert [(name, place.tolist()) for _, name, place in view.detections] == [("Book", [0, 2.5]), ("Bowl", [0.25, 2.5])]
    np.testing.assert_allclose([distance for distance, *_ in view.detections], [1.0, np.sqrt(1.0625)])
    back = view_from_pose(HALL, TASK, (0.0, 1.5, -180.0))
    assert back.yaw == 180.0
    assert [name for _, name, _ in back.detections] == ["Chair"]


def test_the_default_pose_detects_most():
    view = view_from_pose(HALL, TASK, None)
    assert [name for _, name, _ in view.detections] == ["Book", "Bowl"]
    poses = [(0.0, 0.25 * iz, 45.0 * heading) for iz in range(9) for heading in range(8)]
    everywhere = [len(view_from_pose(HALL, TASK, pose).detections) for pose in poses]
    assert len(view.detections) == max(everywhere)
    assert min(everywhere) == 0


def test_what_is_on_the_picture():
    figure = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, (0.0, 1.5, 0.0)))
    plan = figure.axes[0]
    assert names(plan) == ["  1 m", "Book", "Bowl", "Chair"]  # a sofa is no category here
    boxes, cells, crosses, rings = plan.collections
    assert len(boxes.get_paths()) == 4
    assert len(np.asarray(cells.get_offsets())) == 9
    assert np.asarray(crosses.get_offsets()).tolist() == [[0.75, 0.0]]
    assert sorted(np.asarray(rings.get_offsets()).tolist()) == [[0.0, 2.5], [0.25, 2.5]]
    bar = np.asarray(plan.lines[-1].get_xdata())
    assert bar[1] - bar[0] == 1.0
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["standable cell", "unreachable cell", "wall", "in view", "detected"]
    text = "\n".join(text.get_text() for text in figure.texts)
    # Without the wall x goes from the chair's -0.3 (the book's side) to 0.875, z from -1.25 to 2.525.
    for part in (
        "drawn",
        "kitchen, train",
        "1.2 x 3.8 m",
        "9 standable cells, 1 cut off",
        "4 objects, 3 of 3 categories",
    ):
        assert part in text
    assert "heading 0°\nis detected:\nBook, 1.0 m\nBowl, 1.0 m" in text


def test_sizes_of_a_scene():
    low, high = scene_extent(HALL)
    np.testing.assert_allclose([low, high], [[-0.3, -1.25], [1.125, 2.525]])
    np.testing.assert_allclose(scene_size(HALL), [0.875 + 0.3, 2.525 + 1.25])


def test_a_scene_without_objects():
    bare = draw(["..", ".."])
    figure = scene_figure(bare, TASK, view_from_pose(bare, TASK, None))
    assert names(figure.axes[0]) == ["  1 m"]
    assert any("nothing is detected" in text.get_text() for text in figure.texts)


def test_rooms_are_tinted_and_named():
    left_room, right_room = np.zeros((9, 5), bool), np.zeros((9, 5), bool)
    left_room[:, 0], right_room[:, 3] = True, True
    home = dataclasses.replace(HALL, rooms=(Room("living_room", left_room), Room("bedroom", right_room)))
    plan = scene_figure(home, TASK, view_from_pose(home, TASK, None)).axes[0]
    assert {"living room", "bedroom"} < set(names(plan))
    untinted = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, None)).axes[0]
    colours, plain = (np.asarray(axes.images[0].get_array()) for axes in (plan, untinted))
    assert (colours != plain).any(axis=-1).tolist() == (left_room | right_room).tolist()
    assert not np.array_equal(colours[0, 0], colours[0, 3])


@pytest.mark.parametrize(("world", "index"), [("rooms", 0), ("rooms", 3), ("apartments", 0), ("houses", 0)])
def test_no_names_overlap_or_are_clipped(world, index):
    scene, task = (
        make_generated_scenes(world, "val")[index],
        dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR),
    )
    figure = scene_figure(scene, task, view_from_pose(scene, task, None))
    plan = figure.axes[0]
    boxes = [text.get_window_extent() for text in plan.texts if text.get_text() != "  1 m"]
    assert len(boxes) >= 3
    for i, box in enumerate(boxes):
        assert plan.bbox.padded(1).containsx(box.x0)
        assert plan.bbox.padded(1).containsx(box.x1)
        assert not any(box.shrunk(0.98, 0.9).overlaps(other.shrunk(0.98, 0.9)) for other in boxes[:i])
    panel = [text.get_window_extent() for text in figure.texts]
    assert all(box.x1 < figure.bbox.x1 and box.y0 > 0 for box in panel)
    assert not any(box.overlaps(plan.bbox) for box in panel)


def test_a_crowd_of_names_finds_space():
    # Two dozen objects 0.15 m apart: the names can only be apart if they give way.
    kinds = [TASK.categories[i % 22] for i in range(24)]
    crowd = [(kind, 0.5 + 0.15 * i, 0.8, 1.0 + 1.1 * (i % 2), *SMALL) for i, kind in enumerate(kinds)]
    scene = draw(["." * 20] * 16, *crowd)
    figure = scene_figure(scene, TASK, view_from_pose(scene, TASK, None))
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    overlaps = sum(box.overlaps(other) for i, box in enumerate(boxes) for other in boxes[:i])
    assert len(boxes) >= 23
    assert overlaps <= 4


def test_the_goal_is_a_star():
    figure = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, None))
    axes = figure.add_axes((0, 0, 1, 1))
    draw_plan(axes, HALL, TASK.categories, TASK.categories.index("Bowl"))
    stars = [line for line in axes.lines if line.get_marker() == "*"]
    assert [np.asarray(line.get_data()).tolist() for line in stars] == [[[0.25], [2.5]]]
