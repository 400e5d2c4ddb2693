"""Generated rooms: balanced over room types and physically sound."""

import collections

import numpy as np
import pytest
from support.scene_geometry import (
    MILLIMETRES,
    cell_centres,
    check_agent_fits,
    check_form,
    check_nothing_overlaps,
    corners,
)

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


def test_generated_rooms_balance_room_types_and_have_unique_names():
    num_rooms = {"train": 8, "val": 4, "test": 4}
    rooms = []
    for split, count in num_rooms.items():
        rooms.extend(generate_room(split, i, 1) for i in range(count))
    rooms_by_type = collections.Counter((scene.split, scene.room_type) for scene in rooms)
    for room_type in ROOM_TYPES:
        assert [rooms_by_type[split, room_type] for split in ("train", "val", "test")] == [2, 1, 1]
    assert len({scene.name for scene in rooms}) == 16
    fifth_room = rooms[4]
    assert (fifth_room.name, fifth_room.world) == ("train-kitchen-004", "rooms")


def test_generated_rooms_satisfy_the_scene_invariants(rooms: list[Scene]):
    for scene in rooms:
        check_form(scene)
        np.testing.assert_array_equal(scene.boxes, np.round(scene.boxes, 3))
        assert len(standable_cells(scene.reach)) == scene.reach.sum()  # one connected part


def test_generated_room_boxes_do_not_overlap(rooms: list[Scene]):
    for scene in rooms:
        check_nothing_overlaps(scene)


def test_generated_room_objects_rest_on_the_surface_of_their_parent(rooms: list[Scene]):
    num_resting = 0
    for scene in rooms:
        items = room_statistics()[scene.room_type].items
        low_corner, high_corner = corners(scene.boxes)
        for child in np.flatnonzero(scene.parents >= 0):
            parent = scene.parents[child]
            parent_type = scene.types[parent]

            # The surface is at a height of its own, or on top of the parent.
            surface = items[parent_type].surface
            surface_height = high_corner[parent, 1] if surface is None else low_corner[parent, 1] + surface
            if f"in {parent_type}" in items[scene.types[child]].rule.at:  # let in, with a rim of 1 cm
                assert high_corner[child, 1] == pytest.approx(surface_height + 0.01, abs=MILLIMETRES)
            else:
                assert low_corner[child, 1] == pytest.approx(surface_height, abs=MILLIMETRES)

            # The centre lies within the parent's outline.
            offset = np.abs(scene.boxes[child, [0, 2]] - scene.boxes[parent, [0, 2]])
            assert (offset <= scene.boxes[parent, [3, 5]] / 2).all()
            num_resting += 1
    assert num_resting > 1000


def test_generated_rooms_fit_the_agent_and_keep_targets_within_reach(rooms: list[Scene]):
    for scene in rooms:
        check_agent_fits(scene, AGENT_RADIUS)
        target_places = scene.boxes[np.isin(scene.types, ITHOR_CATEGORIES)][:, [0, 2]]
        nearest_distance = np.linalg.norm(target_places[:, None] - cell_centres(scene, scene.reach), axis=-1).min(
            axis=1
        )
        assert nearest_distance.max() <= ROOM_RANGE.max_distance + MILLIMETRES


def test_free_cells_keep_away_from_walls_and_a_box():
    # 4 x 3 floor cells within walls; cells next to a wall are out, which leaves [2, 2] and [2, 3] with centres
    # x = 0.375 and 0.625, z = 0.375. A box that begins at x = 0.8 is 0.175 m from the second: too near for 0.2 m.
    free_cells = cells_away_from_walls(np.pad(np.zeros((3, 4), bool), 1, constant_values=True))
    assert np.argwhere(cells_away_from_boxes(free_cells, np.zeros((0, 2, 3)))).tolist() == [[2, 2], [2, 3]]
    box = np.array([[[0.8, 0.0, 0.0], [1.0, 1.0, 0.75]]])
    assert np.argwhere(cells_away_from_boxes(free_cells, box)).tolist() == [[2, 2]]
    overhead_box = box + np.array([0.0, 1.7, 0.0])  # begins at 1.7 m: no obstacle
    assert np.argwhere(cells_away_from_boxes(free_cells, overhead_box)).tolist() == [[2, 2], [2, 3]]
