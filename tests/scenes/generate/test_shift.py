"""The dial of layout shift."""

import collections
import dataclasses
import functools
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from support.scene_records import assert_scenes_equal

from jaxnav.errors import InputError
from jaxnav.scenes.categories import GIBSON_CATEGORIES, ITHOR_CATEGORIES, ROBOTHOR_CATEGORIES, category_ids
from jaxnav.scenes.generate.homes import generate_apartment, generate_house
from jaxnav.scenes.generate.room_rules import home_statistics
from jaxnav.scenes.generate.rooms import generate_room_at, generate_rooms
from jaxnav.scenes.generate.shift import derangement
from jaxnav.scenes.scene import CELL, Scene

WORLDS: dict[str, tuple[Callable[..., Scene], tuple[str, ...]]] = {
    "apartments": (generate_apartment, ROBOTHOR_CATEGORIES),
    "houses": (generate_house, GIBSON_CATEGORIES),
    "rooms": (generate_room_at, ITHOR_CATEGORIES),
}
NUM_SCENES = {"apartments": 48, "houses": 48, "rooms": 96}  # a room has fewer pairs
NEARLY_ZERO = 1e-12  # places all objects anew, each by its own rule

HOMES = [pytest.param(world, marks=pytest.mark.slow) for world in ("apartments", "houses")]
EACH = ["rooms", *HOMES]


@functools.cache
def scenes_of(world: str, shift: float, part: int = 0) -> list[Scene]:
    number = NUM_SCENES[world]
    return [WORLDS[world][0]("train", i, 0, shift) for i in range(part * number, (part + 1) * number)]


def near(scene: Scene, categories: tuple[str, ...]) -> np.ndarray:
    """Return which categories are within 1.5 m, bool [K, K]."""
    ids = np.array(category_ids(scene.types, categories))
    places = scene.boxes[ids >= 0][:, [0, 2]]
    close = np.linalg.norm(places[:, None] - places, axis=-1) <= 1.5
    one_hot = np.eye(len(categories), dtype=int)[ids[ids >= 0]]
    return (one_hot.T @ close @ one_hot > 0) & ~np.eye(len(categories), dtype=bool)


def both(scene: Scene, categories: tuple[str, ...]) -> np.ndarray:
    """Return which pairs the scene has, bool [K, K]."""
    has = np.isin(categories, [categories[i] for i in category_ids(scene.types, categories) if i >= 0])
    return has[:, None] & has


def lifts(scenes: list[Scene], categories: tuple[str, ...]) -> np.ndarray:
    """Return how much likelier pairs are near, float64 [K, K].

    It is the share of scenes where they are, over that of other pairs with either of the two categories.
    """
    together = np.sum([both(scene, categories) for scene in scenes], axis=0)
    share = np.sum([near(scene, categories) for scene in scenes], axis=0) / np.maximum(together, 1)
    counted = (together >= len(scenes) // 4) & ~np.eye(len(categories), dtype=bool)
    per_category = (share * counted).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    expected = np.maximum((per_category + per_category[:, None]) / 2, 1e-9)
    return np.triu(counted * share / expected)


def moved_apart(a: list[Scene], b: list[Scene], categories: tuple[str, ...], rng: np.random.Generator) -> float:
    """Return the p-value that pairs are equally often near.

    It is that of a permutation test of `a` against `b`.
    """
    upper = np.triu_indices(len(categories), 1)
    pairs = np.array([near(scene, categories)[upper] for scene in (*a, *b)], float)
    room_types = np.array([scene.room_type for scene in (*a, *b)])
    for room_type in set(room_types):  # both have equally many of each
        pairs[room_types == room_type] -= pairs[room_types == room_type].mean(axis=0)
    labels = np.arange(len(pairs)) < len(a)

    def difference(labels: np.ndarray) -> float:
        return float(np.square(pairs[labels].mean(axis=0) - pairs[~labels].mean(axis=0)).sum())

    chance = [difference(rng.permutation(labels)) for _ in range(400)]
    return (1 + sum(other >= difference(labels) for other in chance)) / 401


def test_each_type_takes_the_rule_of_the_next_of_its_group():
    assert derangement([["A", "B", "C"], ["D", "E"]]) == {"A": "B", "B": "C", "C": "A", "D": "E", "E": "D"}


@pytest.mark.parametrize(("groups", "message"), [([["A"]], "nobody"), ([["A", "B"], ["C", "A"]], "A is listed twice")])
def test_groups_that_are_no_derangement_are_refused(groups: list[list[str]], message: str):
    with pytest.raises(InputError, match=message):
        derangement(groups)


@pytest.mark.parametrize(("world", "categories"), [("apartments", ROBOTHOR_CATEGORIES), ("houses", GIBSON_CATEGORIES)])
def test_the_exchange_has_no_fixed_point_and_names_types_that_have_rules(world: str, categories: tuple[str, ...]):
    home = home_statistics(world)
    partners = derangement(home.exchange)
    assert all(name != partner for name, partner in partners.items())
    assert sorted(partners) == sorted(partners.values())
    assert set(partners) <= set().union(*home.rooms.values())
    assert set(categories) <= set(partners)  # all that can be sought, and more


@pytest.mark.parametrize("shift", [-0.01, 1.01, float("nan"), float("inf")])
def test_a_room_with_an_impossible_shift_is_refused(shift: float):
    with pytest.raises(InputError, match="shift is"):
        generate_room_at("train", 0, 0, shift)
    with pytest.raises(InputError, match="shift is"):
        generate_rooms(1, 0, 0, shift=shift)


def test_rooms_are_the_same_one_by_one():
    together = generate_rooms(3, 1, 1, seed=2, shift=0.5)
    places = [("train", 0), ("train", 1), ("train", 2), ("val", 0), ("test", 0)]
    for scene, (split, i) in zip(together, places, strict=True):
        alone = generate_room_at(split, i, 2, 0.5)
        assert_scenes_equal(alone, scene)


@pytest.mark.slow
def test_a_shifted_room_is_its_twin_with_other_labels():
    for twin, scene in zip(scenes_of("rooms", 0.0), scenes_of("rooms", 1.0), strict=True):
        assert_scenes_equal(dataclasses.replace(scene, types=twin.types), twin)
        before, after = (category_ids(s.types, ITHOR_CATEGORIES) for s in (twin, scene))
        assert all(a != b or a == -1 for a, b in zip(before, after, strict=True))
        assert sorted(collections.Counter(before).values()) == sorted(collections.Counter(after).values())


def test_those_who_exchange_labels_in_a_room_are_of_like_size():
    exchanging, others = [], []
    for twin, scene in zip(scenes_of("rooms", 0.0), scenes_of("rooms", 1.0), strict=True):
        ids, new = (np.array(category_ids(s.types, ITHOR_CATEGORIES)) for s in (twin, scene))
        volumes = np.log(twin.boxes[:, 3:].prod(axis=1))
        mean = {k: volumes[ids == k].mean() for k in set(ids[ids >= 0])}
        exchanging += [abs(mean[k] - mean[new[ids == k][0]]) for k in mean]
        others += [abs(a - b) for a, b in itertools.combinations(mean.values(), 2)]
    assert np.median(exchanging) < np.log(3)
    assert np.median(others) > np.log(8)  # at random they would differ by far


@pytest.mark.parametrize("world", HOMES)
def test_a_shifted_home_has_the_walls_and_objects_of_its_twin(world: str):
    alike = 0
    for twin, scene in zip(scenes_of(world, 0.0), scenes_of(world, 1.0), strict=True):
        assert scene.name == twin.name
        assert not np.array_equal(scene.boxes, twin.boxes)
        if np.array_equal(scene.walls, twin.walls) and sorted(scene.types) == sorted(twin.types):
            # Sizes as type, height, shorter and longer side, for an object may be turned.
            sizes = [
                sorted((name, y, min(x, z), max(x, z)) for name, (x, y, z) in zip(s.types, s.boxes[:, 3:], strict=True))
                for s in (twin, scene)
            ]
            assert [size[0] for size in sizes[0]] == [size[0] for size in sizes[1]]
            before, after = ([size[1:] for size in sized] for sized in sizes)
            np.testing.assert_allclose(after, before, atol=2e-3)
            # The standable cells are 15 % more or fewer at most.
            assert scene.reach.sum() == pytest.approx(twin.reach.sum(), rel=0.15)
            alike += 1
    # Where the objects of a scene find no place by the exchanged rules, another one is drawn instead.
    assert alike >= 0.9 * NUM_SCENES[world]


@pytest.mark.parametrize("world", HOMES)
def test_marginals_stay_put(world: str):
    categories = WORLDS[world][1]
    before, after = scenes_of(world, 0.0), scenes_of(world, 1.0)
    assert np.mean([len(s.types) for s in after]) == pytest.approx(np.mean([len(s.types) for s in before]), rel=0.02)
    cells = [np.mean([scene.reach.sum() for scene in scenes]) for scenes in (before, after)]
    assert cells[1] == pytest.approx(cells[0], rel=0.06)
    heights: list[dict[str, list[float]]] = [collections.defaultdict(list), collections.defaultdict(list)]
    for by_category, scenes in zip(heights, (before, after), strict=True):
        for scene in scenes:
            for i, y in zip(category_ids(scene.types, categories), scene.boxes[:, 1], strict=True):
                if i >= 0:
                    by_category[categories[i]].append(y)
    common = [name for name in heights[0] if len(heights[0][name]) >= 15]
    for name in common:  # like footing: a category is at most half a metre higher or lower
        assert np.mean(heights[1][name]) == pytest.approx(np.mean(heights[0][name]), abs=0.5), name
    change = [np.mean(heights[1][name]) - np.mean(heights[0][name]) for name in common]
    assert np.mean(change) == pytest.approx(0.0, abs=0.06)
    assert np.mean(np.abs(change)) < 0.13


@pytest.mark.parametrize("world", EACH)
@pytest.mark.slow
def test_the_dial_moves_away_from_the_training_distribution(world: str):
    categories, rng = WORLDS[world][1], np.random.default_rng(0)
    before = scenes_of(world, 0.0)
    assert moved_apart(before, scenes_of(world, 0.0, 1), categories, rng) > 0.01  # by chance alone
    assert moved_apart(before, scenes_of(world, 1.0), categories, rng) < 0.01


@pytest.mark.parametrize("world", HOMES)
def test_placed_anew_by_their_rules_objects_stay_in_the_training_distribution(world: str):
    assert (
        moved_apart(scenes_of(world, 0.0), scenes_of(world, NEARLY_ZERO, 1), WORLDS[world][1], np.random.default_rng(0))
        > 0.01
    )


@pytest.mark.parametrize("world", EACH)
@pytest.mark.slow
def test_pairs_that_belong_together_meet_by_chance_alone_at_full_shift(world: str):
    categories = WORLDS[world][1]
    # Chosen in other scenes, for the highest of many lifts are partly luck.
    top = np.argsort(-lifts(scenes_of(world, 0.0, 1), categories), axis=None)[:12]
    before, halfway, after = (
        lifts(scenes_of(world, shift), categories).ravel()[top].mean() for shift in (0.0, 0.5, 1.0)
    )
    # By chance the lift is 1; the mean of twelve stays within about 0.2 of it.
    assert before > 1.5
    assert after < 1.2
    assert after < halfway < before


@pytest.mark.slow
def test_a_shift_moves_objects_to_the_wrong_room():
    def share(scenes: list[Scene], name: str, room_type: str) -> float:
        inside = []
        for scene in scenes:
            cells = np.rint((scene.boxes[:, [2, 0]] - scene.origin[::-1]) / CELL).astype(int)
            where = [next(room.type for room in scene.rooms if room.cells[iz, ix]) for iz, ix in cells]
            inside += [kind == room_type for other, kind in zip(scene.types, where, strict=True) if other == name]
        return float(np.mean(inside))

    for name, room_type in (("Toilet", "bathroom"), ("Bed", "bedroom"), ("Sofa", "living_room"), ("Oven", "kitchen")):
        shares = [share(scenes_of("houses", shift), name, room_type) for shift in (0.0, 0.5, 1.0)]
        assert shares[0] == 1.0
        assert 0.25 < shares[1] < 0.75
        assert shares[2] < 0.2
