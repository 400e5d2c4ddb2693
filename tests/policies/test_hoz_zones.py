"""HOZ: graphs of zones against counts by hand and all simple paths, and indirect paths in the shipped worlds."""

import itertools

import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CHAIR, FRIDGE
from support.zones import (
    BEDROOM_PRIOR,
    KITCHEN_PRIOR,
    KITCHENS,
    NO_COUNTS,
    NUM_CATEGORIES,
    TASK,
    THREE_ZONE_CORRIDOR,
    corridor,
    find_zone_of,
    indirect_share,
    learn_corridor_zones,
)

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

# Learned graphs


def test_graph_of_a_corridor_follows_counts_by_hand():
    zones = learn_corridor_zones(*KITCHENS)
    book, chair, fridge = (find_zone_of(zones, category) for category in (BOOK, CHAIR, FRIDGE))
    np.testing.assert_array_equal(zones["nodes"][KITCHEN_PRIOR][[book, chair, fridge]], np.eye(3))

    # Each zone has 3 cells of 16 poses. Two actions lead to the adjoining zone, MoveAhead at either horizon, and two
    # lead back: of 48 x 48 pairs, counted in both directions, (2 + 2) / (2 x 2304) adjoin. Book and fridge do not.
    graphs, scene_counts = build_room_graphs([THREE_ZONE_CORRIDOR], NUM_CATEGORIES, 3)
    adjacency = compute_adjacency(graphs)[KITCHEN_PRIOR]
    assert scene_counts.tolist() == [1, 0, 0, 0, 0]
    assert adjacency[book, chair] == adjacency[chair, book] == adjacency[chair, fridge] == 4 / 4608
    assert adjacency[book, fridge] == adjacency[book, book] == 0.0

    # Relative to the strongest edge all edges are 1; with loops the degrees are 2, 3 and 2.
    expected_mixing = np.array([[1 / 2, 6**-0.5, 0], [6**-0.5, 1 / 3, 6**-0.5], [0, 6**-0.5, 1 / 2]])
    category_order = np.ix_([book, chair, fridge], [book, chair, fridge])
    np.testing.assert_allclose(zones["mixing"][KITCHEN_PRIOR][category_order], expected_mixing, rtol=1e-6)

    # Of the six pairs of zones only book and fridge, in both directions, have an indirect path.
    next_zone = zones["next_zone"][KITCHEN_PRIOR]
    assert next_zone[book, fridge] == next_zone[fridge, book] == chair
    assert next_zone[book, chair] == chair
    assert next_zone[chair, fridge] == fridge
    assert [next_zone[zone, zone] for zone in range(3)] == [0, 1, 2]
    assert indirect_share(zones, zones["next_zone"]) == 2 / 6


def simple_paths(start, end, num_zones):
    """All paths between two zones that enter no zone twice, the direct path first."""
    other_zones = [zone for zone in range(num_zones) if zone not in (start, end)]
    paths = []
    for num_between in range(len(other_zones) + 1):
        for zones_between in itertools.permutations(other_zones, num_between):
            paths.append((start, *zones_between, end))
    return paths


def test_next_zones_lie_on_the_best_of_all_simple_paths():
    """An independent reference: every simple path of five zones."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        # Random symmetric edges, some of them missing.
        edges = rng.random((5, 5)) * (rng.random((5, 5)) < 0.7)
        edges = np.maximum(edges, edges.T) * (1 - np.eye(5))
        next_zones = find_next_zones(edges)

        for start, end in itertools.permutations(range(5), 2):
            paths = simple_paths(start, end, 5)
            products = [np.prod([edges[step] for step in itertools.pairwise(path)]) for path in paths]
            best_path = int(np.argmax(products))
            assert next_zones[start, end] == (paths[best_path][1] if products[best_path] > 0 else end)


def test_direct_path_wins_among_equal_paths():
    edges = np.array([[0.0, 0.5, 0.25], [0.5, 0.0, 0.5], [0.25, 0.5, 0.0]])
    assert find_next_zones(edges)[0, 2] == 2
    assert find_next_zones(edges - 0.01 * (edges == 0.25))[0, 2] == 1


def test_scenes_merge_by_detected_categories_in_any_order():
    """Zones of k-means have no order; zones of books are merged with each other, and counts add up."""
    category_orders = [(BOOK, CHAIR, FRIDGE), (FRIDGE, CHAIR, BOOK), (CHAIR, FRIDGE, BOOK)]
    graphs, scene_counts = build_room_graphs(
        [corridor(*categories) for categories in category_orders], NUM_CATEGORIES, 3
    )
    assert scene_counts[KITCHEN_PRIOR] == 3
    category_shares = graphs.category_shares[KITCHEN_PRIOR]
    np.testing.assert_array_equal(np.sort(category_shares, axis=0), np.sort(np.eye(3), axis=0))
    np.testing.assert_array_equal(graphs.pose_counts[KITCHEN_PRIOR], [144, 144, 144])

    # Book and chair adjoin in two of the three scenes, chair and fridge in all, book and fridge in one: 2 actions each.
    zone_by_category = category_shares.argmax(axis=0)
    transition_counts = graphs.transition_counts[KITCHEN_PRIOR][np.ix_(zone_by_category, zone_by_category)]
    np.testing.assert_array_equal(transition_counts[np.triu_indices(3, 1)], [4, 2, 6])


def test_more_zones_than_poses_are_refused():
    assert len(corridor(BOOK).rows) == 48
    assert len(learn_zones([corridor(BOOK)], NO_COUNTS, 48)["nodes"][0]) == 48
    with pytest.raises(InputError) as refusal:
        learn_zones([corridor(BOOK)], NO_COUNTS, 49)
    assert str(refusal.value) == "scene 'corridor': has 48 poses for 49 zones; give at most 48 zones"


def test_learned_zones_depend_only_on_the_banks():
    # Other co-occurrence counts give equal zones.
    bank = compile_bank([tiny.KITCHEN, tiny.BEDROOM], TASK)
    zones = learn_zones([bank], NO_COUNTS)
    zones_of_other_counts = learn_zones([bank], NO_COUNTS + 1)
    assert all(np.array_equal(zones[name], zones_of_other_counts[name]) for name in zones)

    # A bank for each scene gives the kitchen the nodes that it has in the joint bank.
    kitchen_bank = compile_bank([tiny.KITCHEN], TASK)
    bedroom_bank = compile_bank([tiny.BEDROOM], TASK)
    zones_of_both_banks = learn_zones([kitchen_bank, bedroom_bank], NO_COUNTS)
    np.testing.assert_array_equal(zones_of_both_banks["nodes"][KITCHEN_PRIOR], zones["nodes"][KITCHEN_PRIOR])
    assert (zones_of_both_banks["nodes"][BEDROOM_PRIOR] >= 0).any()

    # Without the bedroom's bank, the bedroom has no zones.
    kitchen_zones = learn_zones([kitchen_bank], NO_COUNTS)
    assert (kitchen_zones["nodes"][BEDROOM_PRIOR] == -1).all()
    assert (zones["nodes"][BEDROOM_PRIOR] >= 0).any()


# The shipped worlds


@pytest.mark.exhaustive
@pytest.mark.parametrize(("world", "num_scenes"), [("rooms", 80), ("apartments", 8), ("houses", 4)])
def test_indirect_paths_exist_where_edges_are_relative_and_not_where_they_are_absolute(world, num_scenes):
    # Bank of the first training scenes.
    task = WORLDS[world].task
    train_scenes = make_generated_scenes(world, "train", num_scenes)
    bank = compile_bank((train_scenes[index] for index in range(num_scenes)), task)

    # Learned zones have edges relative to the strongest one.
    num_categories = len(task.categories)
    no_counts = np.zeros((NUM_PRIORS, num_categories, num_categories))
    zones = learn_zones([bank], no_counts)
    assert indirect_share(zones, zones["next_zone"]) > 0.2

    # Absolute edges.
    graphs, _ = build_room_graphs([bank], num_categories, 8)
    assert indirect_share(zones, find_next_zones(compute_adjacency(graphs))) < 0.02
