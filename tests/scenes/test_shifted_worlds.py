"""Layout shift in every world: goals, detection ranges and co-occurrence."""

import collections
import functools
import itertools

import numpy as np
import pytest
from support.scene_records import assert_scenes_equal
from support.scenes import draw
from support.tiers import params_by_tier

from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.scene import CELL_SIZE, Scene
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import detection_range, object_size
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, load_scenes, make_generated_scenes, shift_scenes

NUM_SCENES = {"apartments": 48, "houses": 48, "rooms": 96}  # a room has fewer pairs

EVERY_WORLD = params_by_tier(["rooms", "apartments", "houses"], fast=["rooms"])


@functools.cache
def shifted_scenes(world: str, shift: float, part: int = 0) -> list[Scene]:
    """Return `NUM_SCENES[world]` scenes at a shift; scenes of different parts are different."""
    if shift:
        return [exchange_places(scene, WORLDS[world].task, shift, 0) for scene in shifted_scenes(world, 0.0, part)]
    num_scenes = NUM_SCENES[world]
    scenes = make_generated_scenes(world, "train", (part + 1) * num_scenes)
    return [scenes[i] for i in range(part * num_scenes, len(scenes))]


def near_pairs(scene: Scene, categories: tuple[str, ...]) -> np.ndarray:
    """Return the pairs of categories with objects within 1.5 m, bool [K, K]."""
    ids = np.array(category_ids(scene.types, categories))
    places = scene.boxes[ids >= 0][:, [0, 2]]
    is_close = np.linalg.norm(places[:, None] - places, axis=-1) <= 1.5
    one_hot = np.eye(len(categories), dtype=int)[ids[ids >= 0]]
    return (one_hot.T @ is_close @ one_hot > 0) & ~np.eye(len(categories), dtype=bool)


def present_pairs(scene: Scene, categories: tuple[str, ...]) -> np.ndarray:
    """Return the pairs of categories that the scene has, bool [K, K]."""
    is_present = np.isin(np.arange(len(categories)), category_ids(scene.types, categories))
    return is_present[:, None] & is_present


def lifts(scenes: list[Scene], categories: tuple[str, ...]) -> np.ndarray:
    """Return the lift of pairs of categories, float64 [K, K].

    The lift is the share of scenes where a pair is near, over that of other pairs with either of the two categories.
    """
    num_present = np.sum([present_pairs(scene, categories) for scene in scenes], axis=0)
    num_near = np.sum([near_pairs(scene, categories) for scene in scenes], axis=0)
    near_share = num_near / np.maximum(num_present, 1)

    # Only pairs in at least a quarter of the scenes count.
    is_frequent = (num_present >= len(scenes) // 4) & ~np.eye(len(categories), dtype=bool)
    per_category = (near_share * is_frequent).sum(axis=0) / np.maximum(is_frequent.sum(axis=0), 1)
    expected_share = np.maximum((per_category + per_category[:, None]) / 2, 1e-9)
    return np.triu(is_frequent * near_share / expected_share)


def permutation_test(
    first: list[Scene], second: list[Scene], categories: tuple[str, ...], rng: np.random.Generator
) -> float:
    """Return the p-value of a permutation test that pairs are equally often near in both lists of scenes."""
    scenes = [*first, *second]
    upper_triangle = np.triu_indices(len(categories), 1)
    is_near = np.array([near_pairs(scene, categories)[upper_triangle] for scene in scenes], float)

    # Subtract the mean of each room type, of which both lists have equally many.
    room_types = np.array([scene.room_type for scene in scenes])
    for room_type in set(room_types):
        is_near[room_types == room_type] -= is_near[room_types == room_type].mean(axis=0)

    def squared_difference(in_first: np.ndarray) -> float:
        return float(np.square(is_near[in_first].mean(axis=0) - is_near[~in_first].mean(axis=0)).sum())

    # Compare the difference with those of random divisions.
    in_first = np.arange(len(scenes)) < len(first)
    by_chance = np.array([squared_difference(rng.permutation(in_first)) for _ in range(400)])
    return (1 + (by_chance >= squared_difference(in_first)).sum()) / 401


@pytest.mark.slow
@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_shift_scenes_exchanges_places_in_every_scene(world):
    task = WORLDS[world].task
    scenes = make_generated_scenes(world, "val", 3, 7)
    assert shift_scenes(scenes, task, 0.0, 7) is scenes
    half_shift = shift_scenes(scenes, task, 0.5, 7)
    assert len(half_shift) == 3
    for i in range(3):
        assert_scenes_equal(half_shift[i], exchange_places(scenes[i], task, 0.5, 7))


def test_shift_scenes_identity_depends_on_scenes_task_shift_and_seed(tmp_path):
    names = ITHOR_CATEGORIES[:3]
    objects = [(type_name, 1.0 + i, 1.0, 0.0, 0.1, 0.1, 0.1) for i, type_name in enumerate(names)]
    scene_file = tmp_path / "a.jsonl.gz"
    write_scenes(scene_file, [draw([".."], *objects)])
    sources = [
        load_scenes(scene_file, "train"),
        make_generated_scenes("rooms", "train", 1),
        make_generated_scenes("rooms", "train", 1, 1),
    ]

    # Three sources and six shifts give 18 identities.
    task = Task()
    few_categories = Task(names)
    few_goals = Task(goals=names)
    changes = [
        (task, 0.0, 0),
        (task, 0.5, 0),
        (task, 0.6, 0),
        (task, 0.5, 1),
        (few_categories, 0.5, 0),
        (few_goals, 0.5, 0),
    ]
    identities = {shift_scenes(source, *change).identity for source, change in itertools.product(sources, changes)}
    assert len(identities) == 18
    assert shift_scenes(sources[0], task, 0.5, 0)[0].types == (names[1], names[2], names[0])


def detection_ranges(scenes: list[Scene]) -> dict[str, list[float]]:
    """Return the detection ranges in metres of all objects of a type."""
    ranges = collections.defaultdict(list)
    for scene in scenes:
        for type_name, object_range in zip(scene.types, detection_range(object_size(scene.boxes)), strict=True):
            ranges[type_name].append(object_range)
    return ranges


@pytest.mark.slow
@pytest.mark.parametrize("world", EVERY_WORLD)
def test_layout_shift_keeps_detection_ranges_of_categories(world):
    ranges_before = detection_ranges(shifted_scenes(world, 0.0))
    ranges_after = detection_ranges(shifted_scenes(world, 1.0))
    for type_name, ranges in ranges_before.items():
        if type_name in WORLDS[world].task.categories and len(ranges) >= 10:
            # The numbers of objects change; within 15 cm the mean does not.
            assert np.mean(ranges_after[type_name]) == pytest.approx(np.mean(ranges), abs=0.15), type_name


@pytest.mark.slow
@pytest.mark.parametrize("world", EVERY_WORLD)
def test_layout_shift_keeps_number_and_distance_of_goals(world):
    task = WORLDS[world].task
    bank_before = compile_bank(shifted_scenes(world, 0.0)[:8], task)
    bank_after = compile_bank(shifted_scenes(world, 1.0)[:8], task)
    np.testing.assert_array_equal(bank_before.goals, bank_after.goals)
    np.testing.assert_array_equal(bank_before.ahead, bank_after.ahead)

    # Goals exchange their distances; a distance that ends at a footprint may change with the footprint.
    for scene in range(8):
        goals = bank_before.goals[scene, : bank_before.num_goals[scene]]
        first_cell = bank_before.first_cell[scene]
        cells = slice(first_cell, first_cell + bank_before.num_cells[scene])
        distances_before = np.sort(bank_before.goal_distance[cells, goals].mean(axis=0))
        distances_after = np.sort(bank_after.goal_distance[cells, goals].mean(axis=0))
        if task.rules.success == "seen":
            np.testing.assert_allclose(distances_after, distances_before, atol=1e-4)
        assert distances_after.mean() == pytest.approx(distances_before.mean(), rel=0.05)


@pytest.mark.parametrize("world", EVERY_WORLD)
@pytest.mark.exhaustive
def test_layout_shift_leaves_the_training_distribution(world: str):
    categories = WORLDS[world].task.categories
    rng = np.random.default_rng(0)
    training_scenes = shifted_scenes(world, 0.0)
    assert permutation_test(training_scenes, shifted_scenes(world, 0.0, 1), categories, rng) > 0.01  # the control
    assert permutation_test(training_scenes, shifted_scenes(world, 1.0), categories, rng) < 0.01


@pytest.mark.parametrize("world", params_by_tier(WORLDS, slow=["rooms"]))
def test_full_layout_shift_reduces_related_pairs_to_chance(world: str):
    categories = WORLDS[world].task.categories
    # The pairs are selected in other scenes, for the highest of many lifts are partly luck.
    top_pairs = np.argsort(-lifts(shifted_scenes(world, 0.0, 1), categories), axis=None)[:12]
    mean_lift = {}
    for shift in (0.0, 0.5, 1.0):
        mean_lift[shift] = lifts(shifted_scenes(world, shift), categories).ravel()[top_pairs].mean()

    # By chance the lift is 1; the mean of twelve stays within about 0.2 of it. In houses ovens, fridges and sinks are
    # alike in size, so that they exchange within kitchens.
    assert mean_lift[0.0] > 1.5
    assert mean_lift[1.0] < (1.5 if world == "houses" else 1.2)
    assert mean_lift[1.0] < mean_lift[0.5] < mean_lift[0.0]


def share_in_room(scenes: list[Scene], type_name: str, room_type: str) -> float:
    """Return the share of the objects of a type that stand in rooms of a type."""
    is_inside = []
    for scene in scenes:
        boxes = scene.boxes[np.array(scene.types) == type_name]
        for iz, ix in np.rint((boxes[:, [2, 0]] - scene.origin[::-1]) / CELL_SIZE).astype(int):
            home_room = next(room for room in scene.rooms if room.cells[iz, ix])
            is_inside.append(home_room.type == room_type)
    return float(np.mean(is_inside))


@pytest.mark.parametrize(
    ("type_name", "room_type"), [("Toilet", "bathroom"), ("Bed", "bedroom"), ("Sofa", "living_room")]
)
@pytest.mark.slow
def test_layout_shift_moves_goals_to_other_rooms(type_name, room_type):
    assert share_in_room(shifted_scenes("houses", 0.0), type_name, room_type) == 1.0
    assert 0.25 < share_in_room(shifted_scenes("houses", 0.5), type_name, room_type) < 0.8
    assert share_in_room(shifted_scenes("houses", 1.0), type_name, room_type) < 0.2
