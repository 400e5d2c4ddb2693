"""Tests of the plans of scenes: whole centimetres, and views that agree with the detector and the scene picture."""

import base64
import dataclasses

import numpy as np
import pytest
from support import tiny_world as tiny
from support.report_page import POSES

from jaxnav.env.render import view_cone
from jaxnav.report.replays import make_plan, pack_shares
from jaxnav.scenes.scene import Room
from jaxnav.scenes.tables.observation_row import RowFormat


@pytest.fixture(scope="module")
def plan():
    return make_plan(tiny.KITCHEN, tiny.BANK, 0, POSES)


def test_pack_shares_clips_and_rounds_to_bytes():
    # 0.5 * 255 = 127.5, which rounds to the even 128.
    assert base64.b64decode(pack_shares(np.array([-0.2, 0.0, 0.5, 1.0, 1.7]))) == bytes([0, 0, 128, 255, 255])


def test_plan_gives_floor_and_boxes_in_centimetres(plan):
    # Four rows of four standable cells of 25 cm, the first around (0, 0).
    (floor,) = plan.floors
    assert floor.cells == [(-12, -12, 100, 100)]
    assert plan.walls == []

    # The chair covers 0.5 x 0.5 m around (1.5, 1.5); its top is at 0.5 + 0.45 m, 48 % of the darkest height, 2 m.
    assert (125, 125, 50, 50, 48) in plan.furniture
    heights = [height for *_, height in plan.furniture]
    assert heights == sorted(heights)
    assert sorted(plan.objects) == [(0, 25, 175), (0, 150, 0), (1, 150, 150)]


def test_plan_separates_the_floor_of_a_room():
    room_cells = np.zeros_like(tiny.KITCHEN.reach)
    room_cells[:2, :2] = True
    scene = dataclasses.replace(tiny.KITCHEN, rooms=(Room("bath", room_cells),))
    floor_areas = {}
    for floor in make_plan(scene, tiny.BANK, 0, POSES).floors:
        floor_areas[floor.name] = sum(width * depth for *_, width, depth in floor.cells)
    assert floor_areas == {"": 12 * 625, "bath": 4 * 625}


def test_plan_views_stand_at_their_poses(plan):
    # Cells along x, looking along z.
    view_poses = [(view.x, view.z, view.yaw) for view in plan.views]
    assert view_poses == [(0, 0, 0.0), (25, 0, 0.0), (50, 0, 0.0), (75, 0, 0.0)]


def test_plan_views_list_the_detections_of_their_rows(plan):
    row_format = RowFormat(len(tiny.CATEGORIES))
    for pose, view in zip(POSES, plan.views, strict=True):
        expected_percent = {}
        for category, confidence in enumerate(row_format.detections(tiny.BANK.rows[pose])[:, 0].tolist()):
            if confidence:
                expected_percent[category] = round(100 * confidence / 255)
        assert {category: percent for category, _, _, percent in view.seen} == expected_percent

        percents = [percent for *_, percent in view.seen]
        assert percents == sorted(percents, reverse=True)
    assert any(view.seen for view in plan.views)


def test_plan_views_pack_the_depths_of_the_view_cone(plan):
    """Each depth, back from its byte, lies within half a step of the outline: 500 / 255 / 2 cm."""
    for view in plan.views:
        place = np.array([view.x, view.z]) / 100
        outline = view_cone(tiny.KITCHEN, tiny.BANK.task.rules, place, view.yaw)[1::2]
        expected_depths = np.linalg.norm(outline - place, axis=1)
        depths = np.frombuffer(base64.b64decode(view.cone), np.uint8) / 255 * 5
        np.testing.assert_allclose(depths, expected_depths, atol=0.0099)


def test_plan_views_place_detections_near_objects_of_the_category(plan):
    for view in plan.views:
        for category, x, z, _ in view.seen:
            distances = []
            for object_category, object_x, object_z in plan.objects:
                if object_category == category:
                    distances.append(np.hypot(x - object_x, z - object_z))

            # Bytes and the detector cause an error of at most 0.6 m; false alarms have no object.
            assert min(distances, default=0) < 60
