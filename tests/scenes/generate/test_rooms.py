"""The procedural rooms: reproducible, physically sound, and alike to the measured AI2-THOR rooms."""

import collections
import dataclasses

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.generate.relabel import relabel
from jaxnav.scenes.generate.room_rules import room_statistics
from jaxnav.scenes.generate.room_shapes import inside, make_shape, wall_mask
from jaxnav.scenes.generate.rooms import AGENT_RADIUS, FIND_DISTANCE, free_cells, generate_room_at, generate_rooms
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene

MILLIMETRES = 2e-3  # boxes are rounded to 1 mm


@pytest.fixture(scope="module")
def rooms() -> list[Scene]:
    return generate_rooms(num_train=200, num_val=0, num_test=0, seed=0)


def of_type(rooms: list[Scene], room_type: str) -> list[Scene]:
    return [scene for scene in rooms if scene.room_type == room_type]


def corners(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return boxes[:, :3] - boxes[:, 3:] / 2, boxes[:, :3] + boxes[:, 3:] / 2


def assert_same(a: Scene, b: Scene) -> None:
    for field in dataclasses.fields(Scene):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def test_a_scene_depends_on_seed_split_and_index_alone():
    few, more = generate_rooms(4, 4, 1, seed=7), generate_rooms(6, 5, 2, seed=7)
    by_name = {scene.name: scene for scene in more}
    for scene in few:
        assert_same(scene, by_name[scene.name])
    other = generate_rooms(4, 0, 0, seed=8)
    assert all(a.boxes.shape != b.boxes.shape or (a.boxes != b.boxes).any() for a, b in zip(few, other, strict=False))
    # The same index in another split is another room.
    assert few[0].boxes.shape != few[4].boxes.shape or (few[0].boxes != few[4].boxes).any()


def test_a_shifted_room_is_relabelled_with_its_own_seed():
    for i in range(4):
        twin, shifted = (generate_room_at("val", i, 7, shift) for shift in (0.0, 0.5))
        assert_same(shifted, relabel(twin, ITHOR_CATEGORIES, 0.5, 7))
    # Seed 8 chooses others among these objects.
    kitchen = generate_room_at("val", 0, 7)
    assert relabel(kitchen, ITHOR_CATEGORIES, 0.5, 7).types != relabel(kitchen, ITHOR_CATEGORIES, 0.5, 8).types


def test_splits_are_balanced_and_names_unique():
    rooms = generate_rooms(8, 4, 4, seed=1)
    counts = collections.Counter((scene.split, scene.room_type) for scene in rooms)
    for room_type in ROOM_TYPES:
        assert [counts[split, room_type] for split in ("train", "val", "test")] == [2, 1, 1]
    assert len({scene.name for scene in rooms}) == 16
    assert (rooms[4].name, rooms[4].world) == ("train-kitchen-004", "rooms")


@pytest.mark.parametrize("counts", [(-1, 2, 2), (1, -2, 0), (1, 1, -1), (0, 0, 0)])
def test_impossible_counts_are_refused(counts: tuple[int, int, int]):
    with pytest.raises(InputError, match="num_"):
        generate_rooms(*counts)


def test_a_negative_seed_is_refused():
    with pytest.raises(InputError, match="seed is -1"):
        generate_rooms(1, 0, 0, seed=-1)


def test_scene_invariants(rooms: list[Scene]):
    for scene in rooms:
        assert scene.reach.shape == scene.walls.shape
        assert scene.reach.dtype == scene.walls.dtype == bool
        assert not (scene.reach & scene.walls).any()
        rim = np.ones_like(scene.walls)
        rim[1:-1, 1:-1] = False
        assert scene.walls[rim].all()
        assert np.remainder(np.asarray(scene.origin), CELL).tolist() == [0.0, 0.0]
        n = len(scene.types)
        assert scene.boxes.shape == (n, 6)
        assert scene.yaws.shape == scene.parents.shape == (n,)
        np.testing.assert_array_equal(scene.boxes, np.round(scene.boxes, 3))
        assert ((scene.parents >= -1) & (scene.parents < np.arange(n))).all()
        assert len(standable_cells(scene.reach)) == scene.reach.sum()  # one connected part


def test_boxes_are_in_the_room_and_do_not_overlap(rooms: list[Scene]):
    for scene in rooms:
        low, high = corners(scene.boxes)
        # No box overlaps a wall cell: compare with the squares around their centres.
        walls = np.asarray(scene.origin) + CELL * np.argwhere(scene.walls)[:, ::-1]
        depth = np.minimum(high[:, None, ::2], walls + CELL / 2) - np.maximum(low[:, None, ::2], walls - CELL / 2)
        assert not (depth > MILLIMETRES).all(axis=-1).any(), scene.name
        overlap = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low) > MILLIMETRES).all(axis=-1)
        related = scene.parents[:, None] == np.arange(len(low))  # what lies on a sofa is inside the sofa's box
        assert not (overlap & ~related & ~related.T & ~np.eye(len(low), dtype=bool)).any(), scene.name


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


def test_the_agent_fits_and_every_target_can_be_found(rooms: list[Scene]):
    for scene in rooms:
        cells = np.asarray(scene.origin) + CELL * np.argwhere(scene.reach)[:, ::-1]
        low, high = corners(scene.boxes)
        obstacle = (low[:, 1] < 1.7) & (high[:, 1] > 0.1)
        nearest = np.clip(cells[:, None], low[obstacle][:, [0, 2]], high[obstacle][:, [0, 2]])
        assert np.linalg.norm(cells[:, None] - nearest, axis=-1).min() >= AGENT_RADIUS - MILLIMETRES
        targets = scene.boxes[np.isin(scene.types, ITHOR_CATEGORIES)][:, [0, 2]]
        distances = np.linalg.norm(targets[:, None] - cells, axis=-1).min(axis=1)
        assert distances.max() <= FIND_DISTANCE + MILLIMETRES


def test_free_cells_of_a_room_with_one_box():
    # 4 x 3 floor cells within walls; cells next to a wall are out, which leaves [2, 2] and [2, 3] with centres
    # x = 0.375 and 0.625, z = 0.375. A box that begins at x = 0.8 is 0.175 m from the second: too near for 0.2 m.
    walls = np.pad(np.zeros((3, 4), bool), 1, constant_values=True)
    assert np.argwhere(free_cells(walls, np.zeros((0, 2, 3)))).tolist() == [[2, 2], [2, 3]]
    box = np.array([[[0.8, 0.0, 0.0], [1.0, 1.0, 0.75]]])
    assert np.argwhere(free_cells(walls, box)).tolist() == [[2, 2]]
    overhead = box + np.array([0.0, 1.7, 0.0])  # begins at 1.7 m: not in the way
    assert np.argwhere(free_cells(walls, overhead)).tolist() == [[2, 2], [2, 3]]


@pytest.mark.parametrize("high", [(True, True), (True, False), (False, True), (False, False)])
def test_walls_of_an_l_shape_face_inwards(high: tuple[bool, bool]):
    shape = make_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(high))
    # An L-shape has the perimeter of its rectangle, 2 (4 + 3), and lacks 1.5 x 1.0 of its 12 square metres.
    assert shape.lengths.sum() == 14.0
    assert (~wall_mask(shape)).sum() * CELL**2 == 12.0 - 1.5
    forward = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])[shape.turns]
    along = np.roll(shape.starts, -1, axis=0) - shape.starts
    middles = shape.starts + along / 2
    for side, expected in ((0.2, True), (-0.2, False)):
        points = middles + side * forward
        assert (inside(shape, points - 0.1, points + 0.1) == expected).all()


#: Per room type, measured over the 30 AI2-THOR rooms: quartiles of standable cells; target instances; distinct
#: targets; cells of the rectangle around them that are standable.
MEASURED = {
    "kitchen": ((70, 98, 133), 16.5, 13.1, 0.61),
    "living_room": ((146, 204, 263), 10.0, 8.1, 0.53),
    "bedroom": ((80, 88, 101), 8.8, 8.4, 0.56),
    "bathroom": ((38, 50, 66), 3.5, 3.0, 0.67),
}


@pytest.mark.parametrize("room_type", ROOM_TYPES)
def test_statistics_follow_the_measured_ones(rooms: list[Scene], room_type: str):
    quartiles, instances, distinct, fill = MEASURED[room_type]
    scenes = of_type(rooms, room_type)
    cells = [scene.reach.sum() for scene in scenes]
    # The standard error of a quartile of 50 rooms is about 15 %.
    np.testing.assert_allclose(np.quantile(cells, [0.25, 0.5, 0.75]), quartiles, rtol=0.35)
    targets = [[name for name in scene.types if name in ITHOR_CATEGORIES] for scene in scenes]
    assert np.mean([len(names) for names in targets]) == pytest.approx(instances, rel=0.1)
    assert np.mean([len(set(names)) for names in targets]) == pytest.approx(distinct, rel=0.1)
    spans = [np.ptp(np.argwhere(scene.reach), axis=0) + 1 for scene in scenes]
    assert np.median(np.array(cells) / np.prod(spans, axis=1)) == pytest.approx(fill, rel=0.2)


#: (room type, target): share of rooms that have it, median height of its centre (0 where it varies by support).
PRESENCE = {
    ("kitchen", "Fridge"): (1.0, 0.92),
    ("kitchen", "Kettle"): (0.5, 0.99),
    ("kitchen", "Chair"): (0.4, 0.52),
    ("kitchen", "StoveBurner"): (1.0, 0.93),
    ("living_room", "Plate"): (0.33, 0.78),
    ("living_room", "FloorLamp"): (1.0, 0.94),
    ("living_room", "Chair"): (0.67, 0.49),
    ("bedroom", "Chair"): (0.73, 0.44),
    ("bedroom", "Laptop"): (1.0, 0.94),
    ("bedroom", "AlarmClock"): (1.0, 0.78),
    ("bathroom", "LightSwitch"): (1.0, 1.38),
}


@pytest.mark.parametrize(("room_type", "target"), PRESENCE)
def test_presence_and_height_follow_the_measured_ones(rooms: list[Scene], room_type: str, target: str):
    has, height = PRESENCE[room_type, target]
    scenes = of_type(rooms, room_type)
    heights = [y for scene in scenes for name, y in zip(scene.types, scene.boxes[:, 1], strict=True) if name == target]
    # The standard error of a share over 50 rooms is at most 0.07.
    assert np.mean([target in scene.types for scene in scenes]) == pytest.approx(has, abs=0.2)
    assert np.median(heights) == pytest.approx(height, abs=0.12)


def lift(scenes: list[Scene], a: str, b: str) -> float:
    """How much likelier an `a` is than other targets to have a `b` within 1.5 m."""

    def near(name: str) -> float:
        shares = []
        for scene in scenes:
            if name in scene.types and b in scene.types:
                types, places = np.array(scene.types), scene.boxes[:, [0, 2]]
                distances = np.linalg.norm(places[types == name][:, None] - places[types == b], axis=-1)
                shares.append((distances.min(axis=1) <= 1.5).mean())
        return float(np.mean(shares)) if shares else np.nan

    others = [name for name in ITHOR_CATEGORIES if name not in (a, b)]
    return near(a) / float(np.nanmean([near(name) for name in others]))


def shuffled(scene: Scene, rng: np.random.Generator) -> Scene:
    boxes = scene.boxes.copy()
    boxes[:, :3] = boxes[rng.permutation(len(boxes)), :3]
    return dataclasses.replace(scene, boxes=boxes)


PAIRS = [
    ("kitchen", "GarbageCan", "Fridge"),
    ("kitchen", "Chair", "DiningTable"),
    ("kitchen", "Bowl", "Chair"),
    ("living_room", "Chair", "Plate"),
    ("living_room", "Television", "TVStand"),
    ("living_room", "DeskLamp", "SideTable"),
    ("bedroom", "AlarmClock", "SideTable"),
    ("bedroom", "CellPhone", "Dresser"),
]


@pytest.mark.parametrize(("room_type", "a", "b"), PAIRS)
def test_objects_stand_near_what_they_belong_to(rooms: list[Scene], room_type: str, a: str, b: str):
    assert lift(of_type(rooms, room_type), a, b) > 1.5


def test_shuffled_positions_carry_no_co_occurrence(rooms: list[Scene]):
    rng = np.random.default_rng(0)
    mixed = [shuffled(scene, rng) for scene in rooms]
    lifts = np.array([[lift(of_type(world, t), a, b) for t, a, b in PAIRS] for world in (rooms, mixed)])
    # By chance the lift is 1; the mean of eight of them over 50 rooms each stays within about 0.2 of it.
    assert np.mean(lifts[0]) > 2.5
    assert np.mean(lifts[1]) == pytest.approx(1.0, abs=0.3)
