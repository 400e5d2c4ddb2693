"""Tests of the most misleading exchange of categories: the model of places, the search and the shifted scenes."""

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
MUG, BOOK, COFFEE_MACHINE, BED, SOFA = range(len(TASK.categories))
SMALL = (0.1, 0.1, 0.1)
LARGE = (1.0, 1.0, 1.0)
SMALL_GOALS = ("Book", "Clock", "Vase", "Cup", "Bottle")


def make_room(index: int = 0):
    """A room with a mug at a coffee machine and a book at a bed, 8 m apart, and a sofa far from both."""
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


ROOMS = [make_room(index) for index in range(8)]


def types_at_places(scene) -> list[str]:
    return list(scene.types)


# Places


def test_neighbours_are_objects_within_each_distance_and_in_sight():
    # The book is 0.8 m from the mug. The bed is 0.5 m from the mug, but behind a wall. The sofa is 3.0 m from the mug
    # and 2.2 m from the book.
    scene = draw(
        ["........", "        ", "........"],
        ("Mug", 0.5, 0.5, 0.0, *SMALL),
        ("Book", 1.3, 0.5, 0.0, *SMALL),
        ("Bed", 0.5, 0.5, 0.5, *SMALL),
        ("Sofa", 3.5, 0.5, 0.0, *SMALL),
        walls=[(1, column) for column in range(8)],
    )
    places = find_places([scene], TASK, np.random.default_rng(0))

    # The places of the objects come first; the places after them are cells without an object.
    assert places.category[:4].tolist() == [MUG, BOOK, BED, SOFA]
    assert (places.category[4:] == len(TASK.categories)).all()

    # No object is a neighbour of its own place.
    assert NEIGHBOUR_DISTANCES == (1.0, 2.0, 4.0)
    mug_neighbours = np.zeros((3, 5))
    mug_neighbours[:, BOOK] = [1, 1, 1]
    mug_neighbours[:, SOFA] = [0, 0, 1]
    np.testing.assert_array_equal(places.neighbours[0], mug_neighbours)
    assert places.neighbours[1, :, MUG].tolist() == [1, 1, 1]

    # The wall stands between the bed and all other objects.
    assert not places.neighbours[2].any()


def test_place_weights_of_a_balanced_table_have_the_sign_of_the_log_odds():
    """Only the first distance is informative.

    Category 0 always has neighbour 1, category 1 never has it, and half of the places without an object have it.
    """
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
    new_types = types_at_places(exchange_places(ROOMS[0], TASK, 1.0, 0, exchange))

    # Several exchanges are equivalent; in each of them, mug and book lose their old neighbours.
    neighbour_place = {0: 1, 1: 0, 2: 3, 3: 2}
    mug_place = new_types.index("Mug")
    assert new_types[neighbour_place[mug_place]] != "CoffeeMachine"
    book_place = new_types.index("Book")
    assert new_types[neighbour_place[book_place]] != "Bed"

    # Goals stay among goals.
    assert {new_types[0], new_types[2]} == {"Mug", "Book"}


def test_search_finds_the_best_of_all_permutations():
    """All permutations within the groups are compared: 3! of the goals times 4! of the remaining categories."""
    # Random places of three small goals and four large categories; 7 is the category of a place without an object.
    rng = np.random.default_rng(3)
    is_goal = np.arange(7) < 3
    num_places = 400
    category = rng.integers(0, 8, num_places)
    neighbours = (rng.random((num_places, 3, 7)) < 0.2 + 0.6 * rng.random((8, 3, 7))[category]).astype(float)
    places = Places(category, neighbours, np.where(is_goal, 1.5, 5.0))

    weights = fit_place_weights(places)
    mean_neighbours = np.stack([neighbours[category == index].mean(axis=0) for index in range(7)])

    def score(place_of) -> float:
        """Score of a permutation: objects of category k stand where those of `place_of[k]` stood."""
        total = 0.0
        for goal in range(3):
            for distance, neighbour in itertools.product(range(3), range(7)):
                neighbour_rate = mean_neighbours[place_of[goal], distance, place_of[neighbour]]
                total += weights[goal, distance, neighbour] * neighbour_rate
        return total

    # The found permutation has the lowest score.
    goal_orders = itertools.permutations(range(3))
    remaining_orders = itertools.permutations(range(3, 7))
    all_scores = []
    for goal_order, remaining_order in itertools.product(goal_orders, remaining_orders):
        all_scores.append(score([*goal_order, *remaining_order]))
    cycles = find_misleading_cycles(places, is_goal, np.random.default_rng(0))
    assert score(apply_cycles(cycles, 7)) == pytest.approx(min(all_scores), abs=1e-9)

    # The most misleading cycle comes first.
    cycle_scores = [score(apply_cycles([cycle], 7)) for cycle in cycles]
    assert cycle_scores == sorted(cycle_scores)


@pytest.mark.parametrize("seed", range(20))
def test_applied_cycles_of_a_permutation_give_the_permutation(seed):
    permutation = np.random.default_rng(seed).permutation(9)
    np.testing.assert_array_equal(apply_cycles(list_cycles(permutation), 9), permutation)


@pytest.mark.slow
def test_random_exchanges_reach_every_permutation_within_the_groups():
    # Two small goals and three large categories: 2! x 3! = 12 permutations. After 250 draws, some permutation is
    # missing with a probability below 12 x (11 / 12)^250 < 1e-8.
    goals = {MUG, BOOK}
    drawn_permutations = set()
    for seed in range(250):
        (cycles,) = draw_exchange(ROOMS, TASK, seed).values()
        drawn_permutations.add(cycles)
        for cycle in cycles:
            assert set(cycle) <= goals or goals.isdisjoint(cycle)
    assert len(drawn_permutations) == 12


def test_rooms_without_exchangeable_categories_have_no_cycles():
    room = draw(["." * 4] * 4, ("Mug", 9.0, 0.5, 9.0, *SMALL), ("Bed", 9.7, 0.5, 9.0, *LARGE))
    assert fit_context_exchange([room], TASK) == {room.room_type: ()}
    with pytest.raises(InputError, match="no exchange of categories misleads"):
        fit_scene_exchange([room], TASK)


# Scenes


def test_objects_of_a_cycle_go_to_the_places_of_the_previous_category():
    exchange = {ROOMS[0].room_type: ((MUG, BOOK), (COFFEE_MACHINE, BED, SOFA))}
    shifted_room = exchange_places(ROOMS[0], TASK, 1.0, 0, exchange)
    assert types_at_places(shifted_room) == ["Book", "Bed", "Mug", "Sofa", "CoffeeMachine"]

    # Half of two cycles is the first cycle, for any seed.
    for seed in range(5):
        half_shifted_room = exchange_places(ROOMS[0], TASK, 0.5, seed, exchange)
        assert types_at_places(half_shifted_room) == ["Book", "CoffeeMachine", "Mug", "Bed", "Sofa"]

    # In a room without a bed, the two remaining categories of the cycle exchange.
    bedless_room = draw(["." * 4] * 4, ("CoffeeMachine", 9.0, 0.5, 9.0, *LARGE), ("Sofa", 12.0, 0.5, 9.0, *LARGE))
    assert types_at_places(exchange_places(bedless_room, TASK, 1.0, 0, exchange)) == ["Sofa", "CoffeeMachine"]


def test_rooms_of_another_type_are_refused():
    with pytest.raises(InputError, match="there are none among the training scenes"):
        exchange_places(ROOMS[0], TASK, 1.0, 0, {"kitchen-of-another-type": ()})


@pytest.mark.slow
def test_houses_shift_equally_and_nested():
    """All houses share one exchange, a larger shift exchanges a superset, and goals stay among goals."""
    task = dataclasses.replace(WORLDS["houses"].task, goals=SMALL_GOALS)
    exchange = fit_scene_exchange(make_generated_scenes("houses", "train", 40), task)
    scenes = make_generated_scenes("houses", "val", 12)

    # Per shift and category: the categories that come to its places. Goals stay among goals.
    is_goal = task.is_goal()
    new_categories = {}
    for shift in (0.25, 0.5, 1.0):
        shifted_scenes = shift_scenes(scenes, task, shift, 0, exchange)
        for index in range(len(scenes)):
            old_ids = category_ids(scenes[index].types, task.categories)
            new_ids = category_ids(shifted_scenes[index].types, task.categories)
            for old_id, new_id in zip(old_ids, new_ids, strict=True):
                # Types without a category have the id -1; they stay where they are.
                assert old_id == new_id or (min(old_id, new_id) >= 0 and is_goal[old_id] == is_goal[new_id])
                new_categories.setdefault((shift, old_id), set()).add(new_id)

    # A shift exchanges the first of the cycles, and the places of all other categories keep their category. (Within a
    # cycle, the new category depends on the house, because a house may lack a category.)
    cycles = exchange["house"]
    for shift in (0.25, 0.5, 1.0):
        num_cycles = max(1, round(shift * len(cycles)))
        exchanged_categories = set(itertools.chain.from_iterable(cycles[:num_cycles]))
        for category in range(len(task.categories)):
            if category not in exchanged_categories:
                assert new_categories.get((shift, category), {category}) == {category}
