"""Generated apartments and houses: reproducible, sound, of measured proportions."""

import numpy as np
import pytest
from support.scene_geometry import (
    EIGHT,
    FOUR,
    MILLIMETRES,
    cell_centres,
    check_agent_fits,
    check_form,
    check_nothing_overlaps,
    corners,
    parts_of,
)
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.categories import GIBSON_CATEGORIES, GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.homes import DOOR_WIDTHS, generate_apartment, generate_house
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.scene import CELL_SIZE, Room, Scene

NUM_HOMES = 30


@pytest.fixture(scope="module")
def apartments() -> list[Scene]:
    return [generate_apartment("train", i, seed=0) for i in range(NUM_HOMES)]


@pytest.fixture(scope="module")
def houses() -> list[Scene]:
    return [generate_house("train", i, seed=0) for i in range(NUM_HOMES)]


@pytest.mark.parametrize("generate_scene", [generate_room, generate_apartment, generate_house])
def test_generated_scene_depends_on_split_index_and_seed_alone(generate_scene):
    scene = generate_scene("val", 3, 7)
    generate_scene("val", 4, 7)  # a scene in between changes nothing
    assert_scenes_equal(generate_scene("val", 3, 7), scene)
    for arguments in (("test", 3, 7), ("val", 4, 7), ("val", 3, 8)):
        assert generate_scene(*arguments).boxes.tobytes() != scene.boxes.tobytes()


def test_generated_homes_have_names_of_split_and_index():
    apartment = generate_apartment("train", 17, 0)
    house = generate_house("val", 17, 0)
    assert (apartment.name, apartment.world, apartment.room_type) == ("train-apartment-03-2", "apartments", "apartment")
    assert (house.name, house.world, house.room_type) == ("val-house-00017", "houses", "house")
    assert (apartment.split, house.split) == ("train", "val")


@pytest.mark.exhaustive
def test_generated_apartments_share_walls_in_groups_of_five(apartments: list[Scene]):
    plan_walls = [scene.walls.tobytes() for scene in apartments]
    for i, wall_bytes in enumerate(plan_walls):
        assert wall_bytes == plan_walls[i - i % 5]
    assert len(set(plan_walls)) == NUM_HOMES // 5
    val_walls = {generate_apartment("val", 5 * plan_index, 0).walls.tobytes() for plan_index in range(3)}
    assert len(val_walls) == 3
    assert not val_walls & set(plan_walls)


def test_generated_homes_satisfy_the_scene_invariants(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        check_form(scene)
        assert not {"Doorway", "Partition"} & set(scene.types)
        assert parts_of(scene.reach, EIGHT).number == 1  # one connected part


def test_generated_home_boxes_do_not_overlap_and_leave_room_for_the_agent(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        check_nothing_overlaps(scene)
        check_agent_fits(scene, 0.2)


def test_generated_apartments_have_each_goal_once_within_reach(apartments: list[Scene]):
    for scene in apartments:
        assert sorted(type_name for type_name in scene.types if type_name in ROBOTHOR_GOALS) == sorted(ROBOTHOR_GOALS)
        goal_places = scene.boxes[np.isin(scene.types, ROBOTHOR_GOALS)][:, [0, 2]]
        distances = np.linalg.norm(goal_places[:, None] - cell_centres(scene, scene.reach), axis=-1)
        assert distances.min(axis=1).max() <= 0.85 + MILLIMETRES


def test_generated_houses_keep_goals_within_reach(houses: list[Scene]):
    for scene in houses:
        goal_boxes = scene.boxes[np.isin(scene.types, GIBSON_GOALS)]
        low_corner, high_corner = corners(goal_boxes)
        reach_cells = cell_centres(scene, scene.reach)[:, None]
        nearest_points = np.clip(reach_cells, low_corner[:, [0, 2]], high_corner[:, [0, 2]])
        distances = np.linalg.norm(reach_cells - nearest_points, axis=-1)
        assert distances.min(axis=0).max() <= 0.6 + MILLIMETRES


def test_generated_houses_connect_all_rooms_by_doors(houses: list[Scene]):
    for scene in houses:
        room_floors = np.array([room.cells for room in scene.rooms])
        assert (room_floors.sum(axis=0) <= 1).all()
        assert not (room_floors.any(axis=0) & scene.walls).any()

        # Reach is one part, so a standable cell in every room and door means that one can walk between them all.
        assert all((scene.reach & room_floor).sum() >= 5 for room_floor in room_floors), scene.name
        door_labels, num_doors = parts_of(~scene.walls & ~room_floors.any(axis=0), FOUR)
        assert num_doors >= len(scene.rooms) - 1  # a tree at least
        for door in range(1, num_doors + 1):
            assert DOOR_WIDTHS[0] <= (door_labels == door).sum() <= DOOR_WIDTHS[-1]  # 1 to 2 m
            assert (scene.reach & (door_labels == door)).sum() >= 2

        # Corridors aside, there are four to ten rooms, and every type among them.
        room_types = [room.type for room in scene.rooms if room.type != "corridor"]
        assert 4 <= len(room_types) <= 10
        assert set(room_types) == {"kitchen", "living_room", "bedroom", "bathroom"}
        assert isinstance(scene.rooms[0], Room)


def test_generated_houses_place_objects_in_rooms_of_their_type(houses: list[Scene]):
    home_room = {"Toilet": "bathroom", "Bed": "bedroom", "Sofa": "living_room", "Oven": "kitchen"}
    for scene in houses:
        object_cells = np.rint((scene.boxes[:, [2, 0]] - scene.origin[::-1]) / CELL_SIZE).astype(int)
        for type_name, (iz, ix) in zip(scene.types, object_cells, strict=True):
            if type_name in home_room:
                assert [room.type for room in scene.rooms if room.cells[iz, ix]] == [home_room[type_name]]


def test_generated_apartment_sizes_follow_the_measured_ones(apartments: list[Scene]):
    # RoboTHOR: 155 / 296 / 340 standable cells (least, median, most) in a box of 34 x 14 cells.
    num_cells = np.array([scene.reach.sum() for scene in apartments])
    assert num_cells.min() >= 155
    assert num_cells.max() <= 340
    assert np.median(num_cells) == pytest.approx(296, rel=0.1)
    extents = [np.ptp(np.argwhere(scene.reach), axis=0) + 1 for scene in apartments]
    np.testing.assert_allclose(np.median(extents, axis=0), [14, 34], atol=1.5)


def test_generated_house_sizes_and_contents_follow_the_measured_ones(houses: list[Scene]):
    num_cells = np.array([scene.reach.sum() for scene in houses])
    assert num_cells.min() >= 250
    assert num_cells.max() <= 1500
    assert 650 <= np.median(num_cells) <= 900  # Gibson 854, ProcTHOR 1344

    # Quartiles of the number of objects.
    low_quartile, high_quartile = np.quantile([len(scene.types) for scene in houses], [0.25, 0.75])
    assert 25 <= low_quartile < high_quartile <= 48

    # Instances per house, chosen near those of the 30 Gibson houses; the standard error over 30 houses is about 0.3.
    mean_instances = {
        "Chair": 3.6,
        "Sofa": 1.6,
        "Bed": 2.0,
        "Toilet": 1.6,
        "HousePlant": 3.0,
        "Television": 1.0,
        "Fridge": 1,
    }
    for type_name, expected_mean in mean_instances.items():
        assert np.mean([scene.types.count(type_name) for scene in houses]) == pytest.approx(expected_mean, abs=0.9)
    present_types = set().union(*(scene.types for scene in houses))
    assert present_types >= set(GIBSON_CATEGORIES)
