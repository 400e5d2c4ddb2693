"""Plans of scenes: whole centimetres, and views as the detector and the plan have them."""

import base64
import dataclasses

import numpy as np
import pytest
from support import tiny_world as tiny
from support.report_page import POSES

from jaxnav.report.replays import make_plan, pack_shares
from jaxnav.scenes.scene import Room
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.viz.scene import view_cone


@pytest.fixture(scope="module")
def plan():
    return make_plan(tiny.KITCHEN, tiny.BANK, 0, POSES)


def test_shares_are_bytes():
    # 0.5 * 255 = 127.5, which rounds to the even 128.
    assert base64.b64decode(pack_shares(np.array([-0.2, 0.0, 0.5, 1.0, 1.7]))) == bytes([0, 0, 128, 255, 255])


def test_floor_and_boxes_are_in_centimetres(plan):
    # Four rows of four standable cells of 25 cm, the first around (0, 0).
    (floor,) = plan.floors
    assert floor.cells == [(-12, -12, 100, 100)]
    assert plan.walls == []
    # The chair: 0.5 x 0.5 m around (1.5, 1.5), its top at 0.5 + 0.45 m of the 2 m that are darkest.
    assert (125, 125, 50, 50, 48) in plan.furniture
    tops = [tall for *_, tall in plan.furniture]
    assert tops == sorted(tops)
    assert sorted(plan.objects) == [(0, 25, 175), (0, 150, 0), (1, 150, 150)]


def test_rooms_are_floors_of_their_own():
    cells = np.zeros_like(tiny.KITCHEN.reach)
    cells[:2, :2] = True
    scene = dataclasses.replace(tiny.KITCHEN, rooms=(Room("bath", cells),))
    floors = {
        floor.name: sum(w * d for *_, w, d in floor.cells) for floor in make_plan(scene, tiny.BANK, 0, POSES).floors
    }
    assert floors == {"": 12 * 625, "bath": 4 * 625}


def test_a_view_is_that_of_its_pose(plan):
    rows = RowFormat(len(tiny.CATEGORIES))
    for number, (pose, view) in enumerate(zip(POSES, plan.views, strict=True)):
        assert (view.x, view.z, view.yaw) == (25 * number, 0, 0.0)  # cells along x, looking along z
        confidence = rows.detections(tiny.BANK.rows[pose])[:, 0]
        assert {category: sure for category, _, _, sure in view.seen} == {
            i: round(100 * c / 255) for i, c in enumerate(confidence.tolist()) if c
        }
        assert [sure for *_, sure in view.seen] == sorted((sure for *_, sure in view.seen), reverse=True)
        # Each depth, back from its byte, lies within half a step of the outline: 500 / 255 / 2 cm.
        place = np.array([view.x, view.z]) / 100
        outline = view_cone(tiny.KITCHEN, tiny.BANK.task.rules, place, view.yaw)[1::2]
        depth = np.frombuffer(base64.b64decode(view.cone), np.uint8) / 255 * 5
        np.testing.assert_allclose(depth, np.linalg.norm(outline - place, axis=1), atol=0.0099)
    assert any(view.seen for view in plan.views)


def test_what_is_detected_lies_near_what_is_there(plan):
    for view in plan.views:
        for category, x, z, _ in view.seen:
            centres = [np.hypot(x - ox, z - oz) for other, ox, oz in plan.objects if other == category]
            assert min(centres, default=0) < 60  # bytes and the detector's error; false alarms have no object
