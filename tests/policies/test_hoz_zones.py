"""Zones of the training scenes, counted by hand, and indirect paths in the shipped worlds."""

import itertools

import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CHAIR, FRIDGE
from support.zones import BEDROOM, KITCHEN, KITCHENS, NOTHING, PATH, TASK, K, corridor, holding, indirect_share, learned

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.policies.methods.hoz import (
    build_room_graphs,
    compute_adjacency,
    find_next_zones,
    learn_zones,
)
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

# What is learned


def test_the_graph_of_a_corridor_is_the_one_by_hand():
    zones = learned(*KITCHENS)
    book, chair, fridge = (holding(zones, category) for category in (BOOK, CHAIR, FRIDGE))
    np.testing.assert_array_equal(zones["nodes"][KITCHEN][[book, chair, fridge]], np.eye(3))
    # Each zone has 3 cells of 16 poses. To its neighbour lead 2 actions, MoveAhead at either horizon, and 2 back: of
    # 48 x 48 pairs, both ways counted, (2 + 2) / (2 x 2304) adjoin. Book and fridge do not.
    graphs, scenes = build_room_graphs([PATH], K, 3)
    near = compute_adjacency(graphs)[KITCHEN]
    assert scenes.tolist() == [1, 0, 0, 0, 0]
    assert near[book, chair] == near[chair, book] == near[chair, fridge] == 4 / 4608
    assert near[book, fridge] == near[book, book] == 0.0
    # Relative to the strongest the edges are 1; with loops the degrees are 2, 3 and 2.
    expected = np.array([[1 / 2, 6**-0.5, 0], [6**-0.5, 1 / 3, 6**-0.5], [0, 6**-0.5, 1 / 2]])
    order = np.ix_([book, chair, fridge], [book, chair, fridge])
    np.testing.assert_allclose(zones["mixing"][KITCHEN][order], expected, rtol=1e-6)
    following = zones["next_zone"][KITCHEN]
    assert following[book, fridge] == following[fridge, book] == chair
    assert following[book, chair] == chair
    assert following[chair, fridge] == fridge
    assert [following[zone, zone] for zone in range(3)] == [0, 1, 2]
    assert indirect_share(zones, zones["next_zone"]) == 2 / 6


def test_next_zones_are_those_of_the_best_of_all_paths():
    """An independent reference: every simple path of five zones."""
    draws = np.random.default_rng(0)
    for _ in range(20):
        edges = draws.random((5, 5)) * (draws.random((5, 5)) < 0.7)
        edges = np.maximum(edges, edges.T) * (1 - np.eye(5))
        next_zones = find_next_zones(edges)
        for start, end in itertools.permutations(range(5), 2):
            between = [zone for zone in range(5) if zone not in (start, end)]
            paths = [(start, *some, end) for n in range(4) for some in itertools.permutations(between, n)]
            products = [np.prod([edges[step] for step in itertools.pairwise(path)]) for path in paths]
            best = int(np.argmax(products))
            assert next_zones[start, end] == (paths[best][1] if products[best] > 0 else end)


def test_of_equal_paths_the_direct_one_is_taken():
    edges = np.array([[0.0, 0.5, 0.25], [0.5, 0.0, 0.5], [0.25, 0.5, 0.0]])
    assert find_next_zones(edges)[0, 2] == 2
    assert find_next_zones(edges - 0.01 * (edges == 0.25))[0, 2] == 1


def test_scenes_join_by_what_is_seen_whatever_their_order():
    """Zones of k-means have no order; book joins book, and counts add up."""
    orders = [(BOOK, CHAIR, FRIDGE), (FRIDGE, CHAIR, BOOK), (CHAIR, FRIDGE, BOOK)]
    graphs, scenes = build_room_graphs([corridor(*order) for order in orders], K, 3)
    assert scenes[KITCHEN] == 3
    np.testing.assert_array_equal(np.sort(graphs.category_shares[KITCHEN], axis=0), np.sort(np.eye(3), axis=0))
    np.testing.assert_array_equal(graphs.pose_counts[KITCHEN], [144, 144, 144])
    zone_of = graphs.category_shares[KITCHEN].argmax(axis=0)  # the zone of each category
    crossings = graphs.transition_counts[KITCHEN][np.ix_(zone_of, zone_of)]
    # Book and chair adjoin in two of the three, chair and fridge in all, book and fridge in one: 2 actions each.
    np.testing.assert_array_equal(crossings[np.triu_indices(3, 1)], [4, 2, 6])


def test_more_zones_than_poses_are_refused():
    assert len(corridor(BOOK).rows) == 48
    assert len(learn_zones([corridor(BOOK)], NOTHING, 48)["nodes"][0]) == 48
    with pytest.raises(InputError) as refusal:
        learn_zones([corridor(BOOK)], NOTHING, 49)
    assert str(refusal.value) == "scene 'corridor': has 48 poses for 49 zones; give at most 48 zones"


def test_what_is_learned_depends_on_the_banks_alone():
    bank = compile_bank([tiny.KITCHEN, tiny.BEDROOM], TASK)
    one, again = learn_zones([bank], NOTHING), learn_zones([bank], NOTHING + 1)
    assert all(np.array_equal(one[name], again[name]) for name in one)
    halves = [compile_bank([scene], TASK) for scene in (tiny.KITCHEN, tiny.BEDROOM)]
    apart = learn_zones(halves, NOTHING)
    np.testing.assert_array_equal(apart["nodes"][KITCHEN], one["nodes"][KITCHEN])
    assert (apart["nodes"][BEDROOM] >= 0).any()
    other = learn_zones(halves[:1], NOTHING)
    assert (other["nodes"][BEDROOM] == -1).all()
    assert (one["nodes"][BEDROOM] >= 0).any()


# The shipped worlds


@pytest.mark.exhaustive
@pytest.mark.parametrize(("world", "scenes"), [("rooms", 80), ("apartments", 8), ("houses", 4)])
def test_indirect_paths_exist_where_edges_are_relative_and_not_where_they_are_absolute(world, scenes):
    task, train_scenes = WORLDS[world].task, make_generated_scenes(world, "train", scenes)
    bank = compile_bank((train_scenes[i] for i in range(scenes)), task)
    nothing = np.zeros((NUM_PRIORS, *2 * [len(task.categories)]))
    zones = learn_zones([bank], nothing)
    assert indirect_share(zones, zones["next_zone"]) > 0.2
    graphs, _ = build_room_graphs([bank], len(task.categories), 8)
    assert indirect_share(zones, find_next_zones(compute_adjacency(graphs))) < 0.02
