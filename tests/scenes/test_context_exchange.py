"""The exchange of categories that misleads most: model of places, search, and what scenes become."""

import dataclasses
import itertools

import numpy as np
import pytest
from support.scenes import draw

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.context_exchange import (
    NEIGHBOUR_DISTANCES,
    Places,
    apply_cycles,
    draw_exchange,
    find_misleading_cycles,
    find_places,
    fit_context_exchange,
    fit_place_weights,
    list_cycles,
)
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, fit_scene_exchange, make_generated_scenes, shift_scenes

TASK = Task(
    categories=("Mug", "Book", "CoffeeMachine", "Bed", "Sofa"),
    goals=("Mug", "Book"),
)
SMALL = (0.1, 0.1, 0.1)
LARGE = (1.0, 1.0, 1.0)
SMALL_GOALS = ("Book", "Clock", "Vase", "Cup", "Bottle")


def two_contexts(index: int = 0):
    """Return a room with a mug at a coffee machine and a book at a bed, 8 m apart, and a sofa far from both."""
    offset = 0.05 * index
    scene = draw(
        ["." * 8] * 8,
        ("Mug", 10.0 + offset, 0.5, 10.0, *SMALL),
        ("CoffeeMachine", 10.7, 0.5, 10.0, *LARGE),
        ("Book", 18.0 + offset, 0.5, 10.0, *SMALL),
        ("Bed", 18.7, 0.5, 10.0, *LARGE),
        ("Sofa", 30.0, 0.5, 10.0, *LARGE),
    )
    return dataclasses.replace(scene, name=f"room-{index}")


ROOMS = [two_contexts(index) for index in range(8)]


def types_at_places(scene) -> list[str]:
    return list(scene.types)


# Places


def test_neighbours_are_objects_within_each_distance_and_in_sight():
    scene = draw(
        ["........", "        ", "........"],
        ("Mug", 0.5, 0.5, 0.0, *SMALL),
        ("Book", 1.3, 0.5, 0.0, *SMALL),  # 0.8 m from the mug
        ("Bed", 0.5, 0.5, 0.5, *SMALL),  # 0.5 m from the mug, but behind the wall
        ("Sofa", 3.5, 0.5, 0.0, *SMALL),  # 3.0 m from the mug, 2.2 m from the book
        walls=[(1, column) for column in range(8)],
    )
    places = find_places([scene], TASK, np.random.default_rng(0))
    mug, book, bed, sofa = (TASK.categories.index(name) for name in ("Mug", "Book", "Bed", "Sofa"))
    assert NEIGHBOUR_DISTANCES == (1.0, 2.0, 4.0)
    expected = np.zeros((3, 5))
    expected[:, book] = [1, 1, 1]
    expected[:, sofa] = [0, 0, 1]
    np.testing.assert_array_equal(places.neighbours[0], expected)  # an object is not next to itself
    assert places.neighbours[1, :, mug].tolist() == [1, 1, 1]
    assert not places.neighbours[2].any()  # the bed has the wall between it and all others
    assert places.category[:4].tolist() == [mug, book, bed, sofa]
    assert (places.category[4:] == len(TASK.categories)).all()  # cells hold nothing


def test_place_weights_of_a_balanced_table_have_the_sign_of_the_log_odds():
    """One distance tells: category 0 always has neighbour 1, category 1 never, and nothing in half of the places."""
    neighbours = np.zeros((40, len(NEIGHBOUR_DISTANCES), 2))
    category = np.repeat([0, 1, 2, 2], 10)
    neighbours[category == 0, 0, 1] = 1.0
    neighbours[30:, 0, 1] = 1.0
    weights = fit_place_weights(Places(category, neighbours, np.ones(2)))
    assert weights[0, 0, 1] > 1.0
    assert weights[1, 0, 1] < -1.0
    # Features that are always 0 have no weight.
    np.testing.assert_allclose(weights[:, 1:], 0.0, atol=1e-6)
    np.testing.assert_allclose(weights[:, 0, 0], 0.0, atol=1e-6)


# Search


def test_two_contexts_exchange_their_goals():
    exchange = fit_context_exchange(ROOMS, TASK)
    scene = ROOMS[0]
    shifted = exchange_places(scene, TASK, 1.0, 0, exchange)
    new_types = types_at_places(shifted)
    # The mug's old neighbour no longer stands next to the mug, whichever of the equivalent exchanges was found.
    at_mug = new_types.index("Mug")
    neighbour_of = {0: 1, 1: 0, 2: 3, 3: 2}
    assert new_types[neighbour_of[at_mug]] != "CoffeeMachine"
    at_book = new_types.index("Book")
    assert new_types[neighbour_of[at_book]] != "Bed"
    # Goals stay among goals.
    assert {new_types[0], new_types[2]} == {"Mug", "Book"}


def test_search_finds_the_best_of_all_permutations():
    """Compared with every permutation within the classes: 3! of the goals times 4! of the other categories."""
    rng = np.random.default_rng(3)
    is_goal = np.arange(7) < 3
    num_places = 400
    category = rng.integers(0, 8, num_places)
    neighbours = (rng.random((num_places, 3, 7)) < 0.2 + 0.6 * rng.random((8, 3, 7))[category]).astype(float)
    places = Places(category, neighbours, np.where(is_goal, 1.5, 5.0))

    weights = fit_place_weights(places)
    mean_neighbours = np.stack([neighbours[category == k].mean(axis=0) for k in range(7)])

    def score(place_of) -> float:
        total = 0.0
        for goal in range(3):
            for distance, neighbour in itertools.product(range(3), range(7)):
                chance = mean_neighbours[place_of[goal], distance, place_of[neighbour]]
                total += weights[goal, distance, neighbour] * chance
        return total

    all_scores = []
    for goals, others in itertools.product(itertools.permutations(range(3)), itertools.permutations(range(3, 7))):
        all_scores.append(score([*goals, *others]))
    cycles = find_misleading_cycles(places, is_goal, np.random.default_rng(0))
    assert score(apply_cycles(cycles, 7)) == pytest.approx(min(all_scores), abs=1e-9)
    # Cycles come with the most misleading first.
    alone = [score(apply_cycles([cycle], 7)) for cycle in cycles]
    assert alone == sorted(alone)


@pytest.mark.parametrize("seed", range(20))
def test_cycles_are_those_of_the_permutation(seed):
    permutation = np.random.default_rng(seed).permutation(9)
    np.testing.assert_array_equal(apply_cycles(list_cycles(permutation), 9), permutation)


@pytest.mark.slow
def test_random_exchanges_reach_every_permutation_within_the_groups():
    # Two small goals and three large categories: 2! x 3! = 12 permutations. After 250 draws, one is missing with a
    # chance below 12 x (11 / 12)^250 < 1e-8.
    goals = {TASK.categories.index(name) for name in ("Mug", "Book")}
    drawn = set()
    for seed in range(250):
        (cycles,) = draw_exchange(ROOMS, TASK, seed).values()
        drawn.add(cycles)
        for cycle in cycles:
            assert set(cycle) <= goals or goals.isdisjoint(cycle)
    assert len(drawn) == 12


def test_rooms_in_which_nothing_can_exchange_have_no_cycles():
    room = draw(["." * 4] * 4, ("Mug", 9.0, 0.5, 9.0, *SMALL), ("Bed", 9.7, 0.5, 9.0, *LARGE))
    assert fit_context_exchange([room], TASK) == {room.room_type: ()}
    with pytest.raises(InputError, match="no exchange of categories misleads"):
        fit_scene_exchange([room], TASK)


# Scenes


def test_objects_of_a_cycle_go_to_the_places_of_the_category_before():
    mug, book = (TASK.categories.index(name) for name in ("Mug", "Book"))
    machine, bed, sofa = (TASK.categories.index(name) for name in ("CoffeeMachine", "Bed", "Sofa"))
    exchange = {ROOMS[0].room_type: ((mug, book), (machine, bed, sofa))}
    shifted = exchange_places(ROOMS[0], TASK, 1.0, 0, exchange)
    assert types_at_places(shifted) == ["Book", "Bed", "Mug", "Sofa", "CoffeeMachine"]
    # Half of two cycles is the first, whatever the seed.
    for seed in range(5):
        half_shifted = exchange_places(ROOMS[0], TASK, 0.5, seed, exchange)
        assert types_at_places(half_shifted) == ["Book", "CoffeeMachine", "Mug", "Bed", "Sofa"]
    # Without a bed, the two others of its cycle exchange.
    without_bed = draw(["." * 4] * 4, ("CoffeeMachine", 9.0, 0.5, 9.0, *LARGE), ("Sofa", 12.0, 0.5, 9.0, *LARGE))
    assert types_at_places(exchange_places(without_bed, TASK, 1.0, 0, exchange)) == ["Sofa", "CoffeeMachine"]


def test_rooms_of_another_type_are_refused():
    with pytest.raises(InputError, match="there are none among the training scenes"):
        exchange_places(ROOMS[0], TASK, 1.0, 0, {"kitchen-of-another-type": ()})


@pytest.mark.slow
def test_houses_shift_equally_and_nested():
    """Every house has the same exchange, a larger shift exchanges a superset, and goals stay among goals."""
    task = dataclasses.replace(WORLDS["houses"].task, goals=SMALL_GOALS)
    exchange = fit_scene_exchange(make_generated_scenes("houses", "train", 40), task)
    scenes = make_generated_scenes("houses", "val", 12)
    is_goal = task.is_goal()
    maps = {}
    for shift in (0.25, 0.5, 1.0):
        shifted_scenes = shift_scenes(scenes, task, shift, 0, exchange)
        for index in range(len(scenes)):
            old_ids = category_ids(scenes[index].types, task.categories)
            new_ids = category_ids(shifted_scenes[index].types, task.categories)
            for old, new in zip(old_ids, new_ids, strict=True):
                assert old == new or is_goal[old] == is_goal[new]
                maps.setdefault((shift, old), set()).add(new)
    # A category's places get one category, or another where one of the cycle is missing from a house.
    full_cycles = exchange["house"]
    for shift, num_cycles in ((0.25, max(1, round(0.25 * len(full_cycles)))), (1.0, len(full_cycles))):
        exchanged = {k for cycle in full_cycles[:num_cycles] for k in cycle}
        for category in range(len(task.categories)):
            if category not in exchanged:
                assert maps.get((shift, category), {category}) == {category}
