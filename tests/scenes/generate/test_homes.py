"""The procedural apartments and houses: reproducible, sound, of measured proportions."""

import numpy as np
import pytest
from support.lattice import EIGHT, FOUR, parts_of
from support.placement import MILLIMETRES, cell_centres, check_agent_fits, check_form, check_nothing_overlaps, corners
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.categories import GIBSON_CATEGORIES, GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.homes import DOOR_WIDTHS, generate_apartment, generate_house
from jaxnav.scenes.scene import CELL_SIZE, Room, Scene


@pytest.fixture(scope="module")
def apartments() -> list[Scene]:
    return [generate_apartment("train", i, seed=0) for i in range(60)]


@pytest.fixture(scope="module")
def houses() -> list[Scene]:
    return [generate_house("train", i, seed=0) for i in range(60)]


@pytest.mark.parametrize("generate", [generate_apartment, generate_house])
def test_a_scene_depends_on_its_arguments_alone(generate):
    scene = generate("val", 3, 7)
    generate("val", 4, 7)  # in between
    assert_scenes_equal(generate("val", 3, 7), scene)
    for other in (generate("test", 3, 7), generate("val", 4, 7), generate("val", 3, 8)):
        assert other.boxes.tobytes() != scene.boxes.tobytes()


def test_names():
    apartment, house = generate_apartment("train", 17, 0), generate_house("val", 17, 0)
    assert (apartment.name, apartment.world, apartment.room_type) == ("train-apartment-03-2", "apartments", "apartment")
    assert (house.name, house.world, house.room_type) == ("val-house-00017", "houses", "house")
    assert (apartment.split, house.split) == ("train", "val")


@pytest.mark.slow
def test_five_furnishings_share_the_walls_of_a_floor_plan(apartments: list[Scene]):
    plans = [scene.walls.tobytes() for scene in apartments]
    for i, walls in enumerate(plans):
        assert walls == plans[i - i % 5]
    assert len(set(plans)) == 12
    held_out = {generate_apartment("val", 5 * plan, 0).walls.tobytes() for plan in range(3)}
    assert len(held_out) == 3
    assert not held_out & set(plans)


def test_scene_invariants(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        check_form(scene)
        assert not {"Doorway", "Partition"} & set(scene.types)
        assert parts_of(scene.reach, EIGHT).number == 1  # one connected part


def test_boxes_meet_neither_walls_nor_each_other_nor_the_agent(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        check_nothing_overlaps(scene)
        check_agent_fits(scene, 0.2)


def test_an_apartment_has_each_goal_once_within_reach(apartments: list[Scene]):
    for scene in apartments:
        assert sorted(name for name in scene.types if name in ROBOTHOR_GOALS) == sorted(ROBOTHOR_GOALS)
        goals = scene.boxes[np.isin(scene.types, ROBOTHOR_GOALS)][:, [0, 2]]
        distances = np.linalg.norm(goals[:, None] - cell_centres(scene, scene.reach), axis=-1)
        assert distances.min(axis=1).max() <= 0.85 + MILLIMETRES


def test_every_goal_of_a_house_is_within_reach(houses: list[Scene]):
    for scene in houses:
        low, high = (corner[np.isin(scene.types, GIBSON_GOALS)][:, [0, 2]] for corner in corners(scene.boxes))
        cells = cell_centres(scene, scene.reach)[:, None]
        distances = np.linalg.norm(cells - np.clip(cells, low, high), axis=-1)
        assert distances.min(axis=0).max() <= 0.6 + MILLIMETRES


def test_all_rooms_of_a_house_can_be_walked_into(houses: list[Scene]):
    for scene in houses:
        floors = np.array([room.cells for room in scene.rooms])
        assert (floors.sum(axis=0) <= 1).all()
        assert not (floors.any(axis=0) & scene.walls).any()
        # Reach is one part, so a standable cell in every room and door means that one can walk between them all.
        assert all((scene.reach & floor).sum() >= 5 for floor in floors), scene.name
        doors, number = parts_of(~scene.walls & ~floors.any(axis=0), FOUR)
        assert number >= len(scene.rooms) - 1  # a tree at least
        for door in range(1, number + 1):
            assert DOOR_WIDTHS[0] <= (doors == door).sum() <= DOOR_WIDTHS[-1]  # 1 to 2 m
            assert (scene.reach & (doors == door)).sum() >= 2
        types = [room.type for room in scene.rooms if room.type != "corridor"]
        assert 4 <= len(types) <= 10
        assert set(types) == {"kitchen", "living_room", "bedroom", "bathroom"}
        assert isinstance(scene.rooms[0], Room)


def test_objects_stand_in_the_rooms_that_they_belong_to(houses: list[Scene]):
    belongs = {"Toilet": "bathroom", "Bed": "bedroom", "Sofa": "living_room", "Oven": "kitchen"}
    for scene in houses:
        cells = np.rint((scene.boxes[:, [2, 0]] - scene.origin[::-1]) / CELL_SIZE).astype(int)
        for name, (iz, ix) in zip(scene.types, cells, strict=True):
            if name in belongs:
                assert [room.type for room in scene.rooms if room.cells[iz, ix]] == [belongs[name]]


def test_sizes_of_apartments_are_like_the_measured_ones(apartments: list[Scene]):
    # RoboTHOR: 155 / 296 / 340 standable cells (least, median, most) in a box of 34 x 14 cells.
    cells = np.array([scene.reach.sum() for scene in apartments])
    assert cells.min() >= 155
    assert cells.max() <= 340
    assert np.median(cells) == pytest.approx(296, rel=0.1)
    spans = np.median([np.ptp(np.argwhere(scene.reach), axis=0) + 1 for scene in apartments], axis=0)
    np.testing.assert_allclose(spans, [14, 34], atol=1.5)


def test_sizes_and_contents_of_houses(houses: list[Scene]):
    cells = np.array([scene.reach.sum() for scene in houses])
    assert cells.min() >= 250
    assert cells.max() <= 1500
    assert 650 <= np.median(cells) <= 900  # Gibson 854, ProcTHOR 1344
    low, high = np.quantile([len(scene.types) for scene in houses], [0.25, 0.75])
    assert 25 <= low < high <= 48
    # Instances per house, chosen near those of the 30 Gibson houses; the standard error over 60 houses is about 0.2.
    expected = {"Chair": 3.6, "Sofa": 1.6, "Bed": 2.0, "Toilet": 1.6, "HousePlant": 3.0, "Television": 1.0, "Fridge": 1}
    for name, number in expected.items():
        assert np.mean([scene.types.count(name) for scene in houses]) == pytest.approx(number, abs=0.9)
    assert all(any(name in scene.types for scene in houses) for name in GIBSON_CATEGORIES)
