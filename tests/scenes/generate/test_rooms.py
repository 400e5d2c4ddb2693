"""The procedural rooms: reproducible and physically sound."""

import collections

import numpy as np
import pytest
from support.placement import MILLIMETRES, cell_centres, check_agent_fits, check_form, check_nothing_overlaps, corners
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.generate.rooms import (
    AGENT_RADIUS,
    ROOM_RANGE,
    cells_away_from_boxes,
    cells_away_from_walls,
    generate_room,
    room_statistics,
)
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene


def test_a_scene_depends_on_its_arguments_alone():
    scene = generate_room("train", 2, 7)
    generate_room("train", 3, 7)  # in between
    assert_scenes_equal(generate_room("train", 2, 7), scene)
    # Another seed, and the same index in another split, are other rooms.
    for other in (generate_room("train", 2, 8), generate_room("val", 2, 7)):
        assert other.boxes.tobytes() != scene.boxes.tobytes()


def test_splits_are_balanced_and_names_unique():
    counts = {"train": 8, "val": 4, "test": 4}
    rooms = [generate_room(split, i, 1) for split, count in counts.items() for i in range(count)]
    rooms_by_type = collections.Counter((scene.split, scene.room_type) for scene in rooms)
    for room_type in ROOM_TYPES:
        assert [rooms_by_type[split, room_type] for split in ("train", "val", "test")] == [2, 1, 1]
    assert len({scene.name for scene in rooms}) == 16
    assert (rooms[4].name, rooms[4].world) == ("train-kitchen-004", "rooms")


def test_scene_invariants(rooms: list[Scene]):
    for scene in rooms:
        check_form(scene)
        np.testing.assert_array_equal(scene.boxes, np.round(scene.boxes, 3))
        assert len(standable_cells(scene.reach)) == scene.reach.sum()  # one connected part


def test_boxes_are_in_the_room_and_do_not_overlap(rooms: list[Scene]):
    for scene in rooms:
        check_nothing_overlaps(scene)


def test_objects_rest_on_the_surface_of_their_parent(rooms: list[Scene]):
    rested = 0
    for scene in rooms:
        items = room_statistics()[scene.room_type].items
        low, high = corners(scene.boxes)
        for i in np.flatnonzero(scene.parents >= 0):
            p = scene.parents[i]
            surface = items[scene.types[p]].surface
            top = high[p, 1] if surface is None else low[p, 1] + surface
            if f"in {scene.types[p]}" in items[scene.types[i]].rule.at:  # let in, with a rim of 1 cm
                assert high[i, 1] == pytest.approx(top + 0.01, abs=MILLIMETRES)
            else:
                assert low[i, 1] == pytest.approx(top, abs=MILLIMETRES)
            assert (np.abs(scene.boxes[i, [0, 2]] - scene.boxes[p, [0, 2]]) <= scene.boxes[p, [3, 5]] / 2).all()
            rested += 1
    assert rested > 1000


def test_the_agent_fits_and_every_target_is_within_reach(rooms: list[Scene]):
    for scene in rooms:
        check_agent_fits(scene, AGENT_RADIUS)
        targets = scene.boxes[np.isin(scene.types, ITHOR_CATEGORIES)][:, [0, 2]]
        distances = np.linalg.norm(targets[:, None] - cell_centres(scene, scene.reach), axis=-1).min(axis=1)
        assert distances.max() <= ROOM_RANGE.max_distance + MILLIMETRES


def test_free_cells_of_a_room_with_one_box():
    # 4 x 3 floor cells within walls; cells next to a wall are out, which leaves [2, 2] and [2, 3] with centres
    # x = 0.375 and 0.625, z = 0.375. A box that begins at x = 0.8 is 0.175 m from the second: too near for 0.2 m.
    free_cells = cells_away_from_walls(np.pad(np.zeros((3, 4), bool), 1, constant_values=True))
    assert np.argwhere(cells_away_from_boxes(free_cells, np.zeros((0, 2, 3)))).tolist() == [[2, 2], [2, 3]]
    box = np.array([[[0.8, 0.0, 0.0], [1.0, 1.0, 0.75]]])
    assert np.argwhere(cells_away_from_boxes(free_cells, box)).tolist() == [[2, 2]]
    overhead = box + np.array([0.0, 1.7, 0.0])  # begins at 1.7 m: not in the way
    assert np.argwhere(cells_away_from_boxes(free_cells, overhead)).tolist() == [[2, 2], [2, 3]]
