"""Zones of scenes whose graph can be written down, and what HOZ makes of them."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.errors import InputError
from jaxnav.policies.features import features
from jaxnav.policies.methods import Knowledge, Percept
from jaxnav.policies.methods.hoz import ZonePath, ZoneTracker
from jaxnav.policies.methods.zones import (
    adjacency,
    indirect_shares,
    learn_permuted,
    learn_zones,
    next_zones,
    room_graphs,
)
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.policies.policy import bind, init_params
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_RIGHT, Task
from jaxnav.scenes.worlds import WORLDS, generated

K, TASK, ROOMS = len(CATEGORIES), Task(CATEGORIES), [prior_index(room) for room in ("kitchen", "bedroom")]
EAST, WEST, PER_CELL = 2, 6, TASK.rules.poses_per_cell
KITCHEN, BEDROOM = ROOMS
NOTHING = np.zeros((NUM_PRIORS, K, K))
EVERY = np.ones(K, bool)


def corridor(*shown, room_type="kitchen"):
    """Three cells to the east for every category shown, which is detected at all of their poses and alone."""
    cells = np.arange(3 * len(shown))
    ahead = np.repeat(cells[:, None], TASK.rules.headings, axis=1).astype(np.int32)
    ahead[:, EAST], ahead[:, WEST] = np.minimum(cells + 1, cells[-1]), np.maximum(cells - 1, 0)
    detections = np.zeros((len(cells) * PER_CELL, K, 4), np.uint8)
    detections[np.arange(len(detections)), np.repeat(shown, 3 * PER_CELL), 0] = 255
    row_format = RowFormat(K)
    rows = row_format.pack(detections, np.zeros((len(detections), row_format.view, row_format.view), np.uint8))
    distance, length = np.ones((len(cells), K), np.float32), np.ones((len(rows), K), np.uint16)
    one = np.array([0], np.int32), np.array([len(cells)], np.int32)
    goals = np.arange(K, dtype=np.int32)[None], np.array([K], np.int32)
    return Bank(TASK, ("corridor",), (room_type,), ahead, rows, length, distance, *one, *goals, ())


PATH = corridor(BOOK, CHAIR, FRIDGE)


@functools.cache
def learned(*banks_of, zones=3):
    """Zones of corridors, each told by its categories and its room type."""
    banks = [corridor(*shown, room_type=room) for shown, room in banks_of]
    return learn_zones(banks, NOTHING, zones)


KITCHENS = (((BOOK, CHAIR, FRIDGE), "kitchen"),)


def holding(zones, category, room=KITCHEN):
    """The zone at which a category is always detected."""
    (zone,) = np.flatnonzero(zones["nodes"][room, :, category] == 1.0)
    return int(zone)


# What is learned


def test_the_graph_of_a_corridor_is_the_one_by_hand():
    zones = learned(*KITCHENS)
    book, chair, fridge = (holding(zones, category) for category in (BOOK, CHAIR, FRIDGE))
    np.testing.assert_array_equal(zones["nodes"][KITCHEN][[book, chair, fridge]], np.eye(3))
    # Each zone has 3 cells of 16 poses. To its neighbour lead 2 actions, MoveAhead at either horizon, and 2 back: of
    # 48 x 48 pairs, both ways counted, (2 + 2) / (2 x 2304) adjoin. Book and fridge do not.
    graphs, scenes = room_graphs([PATH], K, 3)
    near = adjacency(graphs)[KITCHEN]
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
    # 2 of the 6 pairs of zones, and the same of zones and goals, for each category has a zone of its own.
    assert indirect_shares(zones["nodes"], zones["next_zone"], EVERY) == (2 / 6, 2 / 6)
    # Chair alone is next to both: of its two pairs with another zone, none is indirect.
    assert indirect_shares(zones["nodes"], zones["next_zone"], np.arange(K) == CHAIR) == (2 / 6, 0.0)


def test_next_zones_are_those_of_the_best_of_all_paths():
    """An independent reference: every simple path of five zones."""
    draws = np.random.default_rng(0)
    for _ in range(20):
        edges = draws.random((5, 5)) * (draws.random((5, 5)) < 0.7)
        edges = np.maximum(edges, edges.T) * (1 - np.eye(5))
        found = next_zones(edges)
        for start, end in itertools.permutations(range(5), 2):
            between = [zone for zone in range(5) if zone not in (start, end)]
            paths = [(start, *some, end) for n in range(4) for some in itertools.permutations(between, n)]
            products = [np.prod([edges[step] for step in itertools.pairwise(path)]) for path in paths]
            best = int(np.argmax(products))
            assert found[start, end] == (paths[best][1] if products[best] > 0 else end)


def test_of_equal_paths_the_direct_one_is_taken():
    edges = np.array([[0.0, 0.5, 0.25], [0.5, 0.0, 0.5], [0.25, 0.5, 0.0]])
    assert next_zones(edges)[0, 2] == 2
    assert next_zones(edges - 0.01 * (edges == 0.25))[0, 2] == 1


def test_scenes_join_by_what_is_seen_whatever_their_order():
    """Zones of k-means have no order; book joins book, and counts add up."""
    orders = [(BOOK, CHAIR, FRIDGE), (FRIDGE, CHAIR, BOOK), (CHAIR, FRIDGE, BOOK)]
    graphs, scenes = room_graphs([corridor(*order) for order in orders], K, 3)
    assert scenes[KITCHEN] == 3
    np.testing.assert_array_equal(np.sort(graphs.centres[KITCHEN], axis=0), np.sort(np.eye(3), axis=0))
    np.testing.assert_array_equal(graphs.poses[KITCHEN], [144, 144, 144])
    at = graphs.centres[KITCHEN].argmax(axis=0)  # the zone of each category
    crossings = graphs.moves[KITCHEN][np.ix_(at, at)]
    # Book and chair adjoin in two of the three, chair and fridge in all, book and fridge in one: 2 actions each.
    np.testing.assert_array_equal(crossings[np.triu_indices(3, 1)], [4, 2, 6])


def test_zones_without_poses_are_never_entered():
    zones = learned(*KITCHENS, zones=5)  # three different views
    held = zones["nodes"][KITCHEN].max(axis=-1) >= 0
    assert held.sum() == 3
    assert (zones["nodes"][KITCHEN][~held] == -1).all()
    assert (zones["nodes"][BEDROOM] == -1).all()
    assert indirect_shares(zones["nodes"], zones["next_zone"], EVERY) == (2 / 6, 2 / 6)
    assert all(np.isfinite(zones[name]).all() for name in ("nodes", "mixing", "detected"))
    knowledge = Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, zones))
    note = ZoneTracker().init(knowledge)
    for cell in range(9):
        note = see(note, knowledge, cell)
        assert held[note.zone]
        assert (read_of(note, knowledge, BOOK).zones >= 0).all()


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
    assert apart["nodes"].shape == one["nodes"].shape
    other = learn_zones(halves[:1], NOTHING)
    assert (other["nodes"][BEDROOM] == -1).all()
    assert (one["nodes"][BEDROOM] >= 0).any()


# What an episode remembers


TRACKER = ZoneTracker(rate=0.25)
update = jax.jit(TRACKER.update)
read_of = jax.jit(TRACKER.read)


def known(*banks_of, zones=3):
    return Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, learned(*banks_of, zones=zones)))


def see(note, knowledge, cell, heading=EAST):
    """Look from a cell of the corridor of book, chair and fridge."""
    row = jnp.asarray(PATH.rows[cell * PER_CELL + 2 * heading])
    return update(
        note, knowledge, Percept(row, jnp.int32(heading), jnp.int32(NO_ACTION), jnp.bool_(False), jnp.int32(0))
    )


def test_the_zone_follows_a_walk_and_the_next_zone_leads_to_the_goal():
    """East along the corridor, a turn, and back: B B B C C C F F F F F C."""
    knowledge = known(*KITCHENS)
    zones = learned(*KITCHENS)
    name = {holding(zones, category): category for category in range(K)}
    successor, pose, note = PATH.successor, 2 * EAST, TRACKER.init(knowledge)
    walk = [MOVE_AHEAD] * 8 + [ROTATE_RIGHT] * 4 + [MOVE_AHEAD] * 3
    trace, ahead = [], []
    for action in [None, *walk]:
        pose = pose if action is None else int(successor[pose, action])
        note = see(note, knowledge, pose // PER_CELL, pose // 2 % 8)
        trace.append(name[int(note.zone)])
        # The zone on the way to the fridge is told by what is seen in it: its node mixed with those beside it.
        reading = read_of(note, knowledge, FRIDGE)
        ahead.append(reading.zones)
    assert trace == [BOOK] * 3 + [CHAIR] * 3 + [FRIDGE] * 3 + [FRIDGE] * 4 + [FRIDGE] * 2 + [CHAIR]
    mixing, nodes = zones["mixing"][KITCHEN], np.eye(3)[[name[zone] for zone in range(3)]]
    book, chair, fridge = (holding(zones, category) for category in range(K))
    for at, place in ((0, (book, chair, fridge)), (4, (chair, fridge, fridge)), (8, (fridge, fridge, fridge))):
        np.testing.assert_allclose(ahead[at], (mixing @ nodes)[list(place)], atol=1e-6)


def test_a_view_pulls_the_node_of_its_zone_alone():
    knowledge = known(*KITCHENS)
    book = holding(learned(*KITCHENS), BOOK)
    both = np.array(PATH.rows[0])
    both[4 * CHAIR] = 200  # the chair beside the book: as near to either, and book's zone may be the other's
    nodes = np.asarray(knowledge.method["nodes"][KITCHEN])
    percept = Percept(jnp.asarray(both), jnp.int32(0), jnp.int32(NO_ACTION), jnp.bool_(False), jnp.int32(0))
    note = update(TRACKER.init(knowledge), knowledge, percept)
    zone = int(note.zone)
    assert zone in (book, holding(learned(*KITCHENS), CHAIR))
    # node + rate (seen - node): where a category was not in the zone, 0 + 0.25 (1 - 0).
    expected = nodes.copy()
    expected[zone] = [1.0 if nodes[zone, category] == 1 else 0.25 for category in (BOOK, CHAIR)] + [0.0]
    np.testing.assert_allclose(note.nodes, expected)


def test_the_room_type_is_what_was_seen_not_what_it_is():
    """Kitchens show book and chair, bedrooms chair and fridge; the tracker is told of no room."""
    pair = (((BOOK, CHAIR), "kitchen"), ((BOOK, CHAIR), "kitchen"), ((CHAIR, FRIDGE), "bedroom"))
    knowledge = known(*pair, zones=2)
    note = TRACKER.init(knowledge)
    assert note.room == KITCHEN  # two scenes in three
    note = see(note, knowledge, 3)  # chair
    assert note.room == KITCHEN
    np.testing.assert_allclose(read_of(note, knowledge, BOOK).rooms[jnp.array(ROOMS)], [2 / 3, 1 / 3], rtol=1e-5)
    pulled = note.nodes
    note = see(note, knowledge, 6)  # fridge: share 0.95 x 1/2 + 0.05 / 3 in bedrooms, 0.05 / 3 in kitchens
    bedroom, kitchen = (0.475 + 0.05 / 3) / 3, 2 * (0.05 / 3) / 3
    assert note.room == BEDROOM
    reading = read_of(note, knowledge, FRIDGE)
    np.testing.assert_allclose(reading.rooms[BEDROOM], bedroom / (bedroom + kitchen), rtol=1e-5)
    assert (reading.rooms[jnp.array([1, 3, 4])] == 0).all()  # room types without scenes
    # The bedroom's graph begins untouched, but for this view of its fridge.
    np.testing.assert_allclose(note.nodes, knowledge.method["nodes"][BEDROOM], atol=1e-6)
    assert (pulled != note.nodes).any()
    assert see(note, knowledge, 3).room == BEDROOM  # the fridge is not forgotten


# What the network makes of it


SPEC = dataclasses.replace(tiny.SPEC, method="hoz", method_sizes=())


@functools.cache
def policy():
    return bind(SPEC, init_params(SPEC, jax.random.key(0)))


def experience(reading, weights=None, cell=0, goal=FRIDGE):
    module, row = policy().method, jnp.asarray(PATH.rows[cell * PER_CELL])
    seen = features(row, jnp.int32(goal), RowFormat(K))
    return module.encode(seen, policy().appearance.embedding[...], jnp.ones(K) if weights is None else weights, reading)


def reading_in(zones, goal=FRIDGE, cell=0):
    knowledge = Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, zones))
    return read_of(see(TRACKER.init(knowledge), knowledge, cell), knowledge, goal)


def test_permuted_relations_change_the_experience_and_nothing_else_of_the_graph():
    bank = [corridor(BOOK, CHAIR, FRIDGE)]
    zones, permuted = learn_zones(bank, NOTHING, 3), learn_permuted(bank, NOTHING, 3)
    for name in ("nodes", "detected", "frequency"):
        np.testing.assert_array_equal(zones[name], permuted[name])
    assert indirect_shares(zones["nodes"], permuted["next_zone"], EVERY) == (2 / 6, 2 / 6)
    # Each zone got the place of the one before it, loop and all: the graph is the same under other names.
    loops, moved = (np.diagonal(graph["mixing"][KITCHEN]) for graph in (zones, permuted))
    np.testing.assert_array_equal(moved, np.roll(loops, 1))
    for a in range(3):
        for b in range(3):
            assert (permuted["next_zone"][KITCHEN, a, b] - zones["next_zone"][KITCHEN, a - 1, b - 1]) % 3 == 1
    for name in ("mixing", "next_zone"):  # either alone
        one = zones | {name: permuted[name]}
        assert np.abs(experience(reading_in(zones)) - experience(reading_in(one))).max() > 1e-3


@pytest.mark.parametrize("place", range(3))
def test_current_next_and_goal_zone_all_enter(place):
    reading = reading_in(learned(*KITCHENS))
    other = reading._replace(zones=reading.zones.at[place].add(1.0))
    assert np.abs(experience(reading) - experience(other)).max() > 1e-4


def test_layout_weights_multiply_the_zones_too():
    """A category of weight 0 says the same whatever its entries in the zones are; others do not."""
    reading = reading_in(learned(*KITCHENS))
    wiped = jnp.ones(K).at[CHAIR].set(0.0)
    maps = (policy().method.width - NUM_PRIORS) // K
    for weights, same in ((wiped, True), (jnp.ones(K), False)):
        here = experience(reading, weights)
        louder = ZonePath(reading.rooms, 3.0 * reading.zones)
        there = experience(louder, weights)
        chair = slice(CHAIR * maps, (CHAIR + 1) * maps)
        assert np.array_equal(here[chair], there[chair]) == same
        assert not np.array_equal(here, there)
    np.testing.assert_array_equal(experience(reading)[-NUM_PRIORS:], reading.rooms)


# The shipped worlds


@pytest.mark.slow
@pytest.mark.parametrize(("world", "scenes"), [("rooms", 80), ("apartments", 8), ("houses", 4)])
def test_indirect_paths_exist_where_edges_are_relative_and_not_where_they_are_absolute(world, scenes):
    task, every = WORLDS[world].task, generated(world, "train", scenes)
    bank = compile_bank((every[i] for i in range(scenes)), task)
    nothing = np.zeros((NUM_PRIORS, *2 * [len(task.categories)]))
    zones = learn_zones([bank], nothing)
    assert min(indirect_shares(zones["nodes"], zones["next_zone"], task.is_goal())) > 0.2
    graphs, _ = room_graphs([bank], len(task.categories), 8)
    assert max(indirect_shares(zones["nodes"], next_zones(adjacency(graphs)), task.is_goal())) < 0.02
