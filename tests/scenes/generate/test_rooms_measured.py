"""The procedural rooms against what was measured in AI2-THOR rooms."""

import dataclasses

import numpy as np
import pytest

from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.scene import Scene


def of_type(rooms: list[Scene], room_type: str) -> list[Scene]:
    return [scene for scene in rooms if scene.room_type == room_type]


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
    """Return how much likelier an `a` has a `b` near.

    It is the share of those within 1.5 m of one, over that of other targets.
    """

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
