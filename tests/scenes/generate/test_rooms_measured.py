"""Generated rooms against measurements of AI2-THOR rooms."""

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


@pytest.mark.slow
@pytest.mark.parametrize("room_type", ROOM_TYPES)
def test_generated_room_statistics_follow_the_measured_ones(rooms: list[Scene], room_type: str):
    quartiles, mean_instances, mean_targets, fill_share = MEASURED[room_type]
    scenes = of_type(rooms, room_type)
    num_cells = [scene.reach.sum() for scene in scenes]
    # The standard error of a quartile of 50 rooms is about 15 %.
    np.testing.assert_allclose(np.quantile(num_cells, [0.25, 0.5, 0.75]), quartiles, rtol=0.35)

    # Numbers of target objects and of different targets.
    num_instances = [np.isin(scene.types, ITHOR_CATEGORIES).sum() for scene in scenes]
    num_targets = [len(set(scene.types) & set(ITHOR_CATEGORIES)) for scene in scenes]
    assert np.mean(num_instances) == pytest.approx(mean_instances, rel=0.1)
    assert np.mean(num_targets) == pytest.approx(mean_targets, rel=0.1)

    # Share of standable cells in the rectangle around them.
    spans = [np.ptp(np.argwhere(scene.reach), axis=0) + 1 for scene in scenes]
    assert np.median(np.array(num_cells) / np.prod(spans, axis=1)) == pytest.approx(fill_share, rel=0.2)


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


@pytest.mark.slow
@pytest.mark.parametrize(("room_type", "target"), PRESENCE)
def test_generated_room_presence_and_height_follow_the_measured_ones(rooms: list[Scene], room_type: str, target: str):
    presence_share, median_height = PRESENCE[room_type, target]
    scenes = of_type(rooms, room_type)
    heights = np.concatenate([scene.boxes[np.array(scene.types) == target, 1] for scene in scenes])
    # The standard error of a share over 50 rooms is at most 0.07.
    assert np.mean([target in scene.types for scene in scenes]) == pytest.approx(presence_share, abs=0.2)
    assert np.median(heights) == pytest.approx(median_height, abs=0.12)


def near_share(scenes: list[Scene], type_name: str, neighbour: str) -> float:
    """Return the share of the objects of a type within 1.5 m of one of another, NaN where they never meet."""
    shares = []
    for scene in scenes:
        if type_name in scene.types and neighbour in scene.types:
            types = np.array(scene.types)
            places = scene.boxes[:, [0, 2]]
            distances = np.linalg.norm(places[types == type_name][:, None] - places[types == neighbour], axis=-1)
            shares.append((distances.min(axis=1) <= 1.5).mean())
    return float(np.mean(shares)) if shares else np.nan


def neighbour_lift(scenes: list[Scene], type_name: str, neighbour: str) -> float:
    """Return the share of the objects of a type near another, over the mean share of other targets."""
    others = [other for other in ITHOR_CATEGORIES if other not in (type_name, neighbour)]
    other_shares = [near_share(scenes, other, neighbour) for other in others]
    return near_share(scenes, type_name, neighbour) / float(np.nanmean(other_shares))


def shuffle_places(scene: Scene, rng: np.random.Generator) -> Scene:
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


@pytest.mark.slow
@pytest.mark.parametrize(("room_type", "type_name", "neighbour"), PAIRS)
def test_generated_rooms_place_related_objects_near_each_other(
    rooms: list[Scene], room_type: str, type_name: str, neighbour: str
):
    assert neighbour_lift(of_type(rooms, room_type), type_name, neighbour) > 1.5


@pytest.mark.slow
def test_neighbour_lift_of_shuffled_rooms_is_one(rooms: list[Scene]):
    rng = np.random.default_rng(0)
    shuffled_rooms = [shuffle_places(scene, rng) for scene in rooms]
    lifts = []
    shuffled_lifts = []
    for room_type, type_name, neighbour in PAIRS:
        lifts.append(neighbour_lift(of_type(rooms, room_type), type_name, neighbour))
        shuffled_lifts.append(neighbour_lift(of_type(shuffled_rooms, room_type), type_name, neighbour))

    # By chance the lift is 1; the mean of eight of them over 50 rooms each stays within about 0.2 of it.
    assert np.mean(lifts) > 2.5
    assert np.mean(shuffled_lifts) == pytest.approx(1.0, abs=0.3)
