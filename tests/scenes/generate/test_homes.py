"""The procedural apartments and houses: reproducible, physically sound, connected, and of the measured proportions."""

import dataclasses

import numpy as np
import pytest
from support.lattice import EIGHT, FOUR, parts_of

from jaxnav.errors import InputError
from jaxnav.scenes.categories import GIBSON_CATEGORIES, GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.floor_plans import DOOR_WIDTHS, Rectangle, apartment_plan, house_plan, room_shape
from jaxnav.scenes.generate.homes import generate_apartment, generate_house
from jaxnav.scenes.generate.room_shapes import make_shape, wall_mask
from jaxnav.scenes.scene import CELL, Room, Scene

MILLIMETRES = 2e-3  # boxes are rounded to 1 mm


@pytest.fixture(scope="module")
def apartments() -> list[Scene]:
    return [generate_apartment("train", i, seed=0) for i in range(60)]


@pytest.fixture(scope="module")
def houses() -> list[Scene]:
    return [generate_house("train", i, seed=0) for i in range(60)]


def contents(scene: Scene) -> list[bytes]:
    """Every field of a scene as bytes."""
    values = [getattr(scene, field.name) for field in dataclasses.fields(Scene) if field.name != "rooms"]
    values += [part for room in scene.rooms for part in room]
    return [value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode() for value in values]


def corners(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return boxes[:, :3] - boxes[:, 3:] / 2, boxes[:, :3] + boxes[:, 3:] / 2


def cell_centres(scene: Scene, mask: np.ndarray) -> np.ndarray:
    return np.asarray(scene.origin) + CELL * np.argwhere(mask)[:, ::-1]


@pytest.mark.parametrize("generate", [generate_apartment, generate_house])
@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_a_scene_depends_on_its_arguments_alone(generate, shift: float):
    scene = generate("val", 3, 7, shift)
    generate("val", 4, 7, shift)  # in between
    assert contents(generate("val", 3, 7, shift)) == contents(scene)
    for other in (generate("test", 3, 7, shift), generate("val", 4, 7, shift), generate("val", 3, 8, shift)):
        assert other.boxes.tobytes() != scene.boxes.tobytes()


def test_names():
    apartment, house = generate_apartment("train", 17, 0), generate_house("val", 17, 0)
    assert (apartment.name, apartment.world, apartment.room_type) == ("train-apartment-03-2", "apartments", "apartment")
    assert (house.name, house.world, house.room_type) == ("val-house-00017", "houses", "house")
    assert (apartment.split, house.split) == ("train", "val")


@pytest.mark.parametrize("generate", [generate_apartment, generate_house])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", -1, 0, 0.0), "index is -1"),
        (("train", 0, -2, 0.0), "seed is -2"),
        (("train", 0, 0, -0.1), "shift is -0.1"),
        (("train", 0, 0, 1.5), "shift is 1.5"),
        (("train", 0, 0, float("nan")), "shift is nan"),
        (("dev", 0, 0, 0.0), "split is 'dev'"),
    ],
)
def test_impossible_arguments_are_refused(generate, arguments: tuple, message: str):
    with pytest.raises(InputError, match=message):
        generate(*arguments)


def test_five_furnishings_share_the_walls_of_a_layout(apartments: list[Scene]):
    layouts = [scene.walls.tobytes() for scene in apartments]
    for i, walls in enumerate(layouts):
        assert walls == layouts[i - i % 5]
    assert len(set(layouts)) == 12
    held_out = {generate_apartment("val", 5 * layout, 0).walls.tobytes() for layout in range(3)}
    assert len(held_out) == 3
    assert not held_out & set(layouts)


def test_scene_invariants(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        assert scene.reach.shape == scene.walls.shape
        assert not (scene.reach & scene.walls).any()
        rim = np.ones_like(scene.walls)
        rim[1:-1, 1:-1] = False
        assert scene.walls[rim].all()
        assert np.remainder(np.asarray(scene.origin), CELL).tolist() == [0.0, 0.0]
        n = len(scene.types)
        assert scene.boxes.shape == (n, 6)
        assert scene.yaws.shape == scene.parents.shape == (n,)
        assert ((scene.parents >= -1) & (scene.parents < np.arange(n))).all()
        assert not {"Doorway", "Partition"} & set(scene.types)
        assert parts_of(scene.reach, EIGHT).number == 1  # one connected part


def test_boxes_meet_neither_walls_nor_each_other_nor_the_agent(apartments: list[Scene], houses: list[Scene]):
    for scene in (*apartments, *houses):
        low, high = corners(scene.boxes)
        walls = cell_centres(scene, scene.walls)
        depth = np.minimum(high[:, None, ::2], walls + CELL / 2) - np.maximum(low[:, None, ::2], walls - CELL / 2)
        assert not (depth > MILLIMETRES).all(axis=-1).any(), scene.name
        overlap = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low) > MILLIMETRES).all(axis=-1)
        related = scene.parents[:, None] == np.arange(len(low))  # what lies on a shelf is inside the shelf's box
        assert not (overlap & ~related & ~related.T & ~np.eye(len(low), dtype=bool)).any(), scene.name
        standing = (low[:, 1] < 1.7) & (high[:, 1] > 0.1)
        cells = cell_centres(scene, scene.reach)[:, None]
        nearest = np.clip(cells, low[standing][:, [0, 2]], high[standing][:, [0, 2]])
        assert np.linalg.norm(cells - nearest, axis=-1).min() >= 0.2 - MILLIMETRES


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
        cells = np.rint((scene.boxes[:, [2, 0]] - scene.origin[::-1]) / CELL).astype(int)
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


@pytest.mark.parametrize("high", [(True, True), (True, False), (False, True), (False, False)])
def test_faces_of_a_wall_mask_are_those_of_the_shape(high: tuple[bool, bool]):
    expected = make_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(high))
    shape = room_shape(wall_mask(expected))

    def faces(shape) -> list[tuple[float, ...]]:
        return sorted((*start, turn, length) for start, turn, length in zip(*shape[2:], strict=True))

    np.testing.assert_allclose(faces(shape), faces(expected))


def test_there_is_no_wall_to_put_anything_at_in_a_door_and_a_partition_has_two_faces():
    # A floor of 8 x 4 cells has walls of 2 (8 + 4) cells; a door of 4 cells leaves 20, in two pieces on its side.
    walls = np.pad(np.zeros((4, 8), bool), 1, constant_values=True)
    walls[0, 3:7] = False
    shape = room_shape(walls)
    assert shape.lengths.sum() == pytest.approx(20 * CELL)
    assert sorted(shape.lengths[shape.turns == 0] / CELL) == [2, 2]
    # A free-standing partition of 3 x 1 cells adds its outline of 8 cells.
    walls[3, 3:6] = True
    assert room_shape(walls).lengths.sum() == pytest.approx(28 * CELL)


def test_plans_repeat_and_have_the_walls_that_they_list():
    for seed in range(20):
        plan, again = (house_plan(np.random.default_rng(seed)) for _ in range(2))
        assert plan.rooms == again.rooms
        assert plan.walls.tobytes() == again.walls.tobytes()
        open_cells = sum(part.area for part in (*plan.rooms, *plan.doors))
        assert (~plan.walls).sum() == open_cells
        apartment = apartment_plan(np.random.default_rng(seed))
        assert all(apartment.walls[wall.cells].all() for wall in apartment.partitions)


def test_box_of_a_door():
    # A door in cells [4, 5) x [2, 6), above a room of rows 1 to 3 and columns 1 to 8: flat, at z = 3 x 0.25 m.
    room, door = Rectangle(1, 1, 4, 9), Rectangle(4, 2, 5, 6)
    assert door.within(room.around)
    assert not door.within(room)
    assert door.box(room, 2.5).tolist() == [[0.25, 0.0, 0.75], [1.25, 2.5, 0.75]]
