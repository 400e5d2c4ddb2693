"""Zones of scenes whose graph can be written down, and what HOZ makes of them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CHAIR, FRIDGE
from support.zones import (
    BEDROOM,
    EAST,
    KITCHEN,
    KITCHENS,
    NOTHING,
    PATH,
    PER_CELL,
    ROOMS,
    K,
    corridor,
    holding,
    indirect_share,
    learned,
)

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.policies.features import unpack_features
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.hoz import (
    ZoneReading,
    ZoneTracker,
    learn_permuted_zones,
    learn_zones,
)
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_RIGHT

# What an episode remembers


TRACKER = ZoneTracker(node_rate=0.25)
update = jax.jit(TRACKER.update)
read_of = jax.jit(TRACKER.read)


def knowledge_of(*banks_of, zones=3):
    return Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, learned(*banks_of, zones=zones)))


def see(note, knowledge, cell, heading=EAST):
    """Look from a cell of the corridor of book, chair and fridge."""
    row = jnp.asarray(PATH.rows[cell * PER_CELL + 2 * heading])
    nothing = jnp.int32(NO_ACTION), jnp.bool_(False), jnp.int32(0), jnp.int32(0)
    return update(note, knowledge, Percept(row, jnp.int32(heading), *nothing))


def test_the_zone_follows_a_walk_and_the_next_zone_leads_to_the_goal():
    """East along the corridor, a turn, and back: B B B C C C F F F F F C."""
    knowledge = knowledge_of(*KITCHENS)
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
        ahead.append(reading.zone_rows)
    assert trace == [BOOK] * 3 + [CHAIR] * 3 + [FRIDGE] * 3 + [FRIDGE] * 4 + [FRIDGE] * 2 + [CHAIR]
    mixing, nodes = zones["mixing"][KITCHEN], np.eye(3)[[name[zone] for zone in range(3)]]
    book, chair, fridge = (holding(zones, category) for category in range(K))
    for cell, place in ((0, (book, chair, fridge)), (4, (chair, fridge, fridge)), (8, (fridge, fridge, fridge))):
        np.testing.assert_allclose(ahead[cell], (mixing @ nodes)[list(place)], atol=1e-6)


def test_zones_without_poses_are_never_entered():
    zones = learned(*KITCHENS, zones=5)  # three different views
    held = zones["nodes"][KITCHEN].max(axis=-1) >= 0
    assert held.sum() == 3
    assert (zones["nodes"][KITCHEN][~held] == -1).all()
    assert (zones["nodes"][BEDROOM] == -1).all()
    assert indirect_share(zones, zones["next_zone"]) == 2 / 6
    assert all(np.isfinite(zones[name]).all() for name in ("nodes", "mixing", "detected"))
    knowledge = Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, zones))
    note = ZoneTracker().init(knowledge)
    for cell in range(9):
        note = see(note, knowledge, cell)
        assert held[note.zone]
        assert (read_of(note, knowledge, BOOK).zone_rows >= 0).all()


def test_a_view_pulls_the_node_of_its_zone_alone():
    knowledge = knowledge_of(*KITCHENS)
    book = holding(learned(*KITCHENS), BOOK)
    both = np.array(PATH.rows[0])
    both[4 * CHAIR] = 200  # the chair beside the book: as near to either, and book's zone may be the other's
    nodes = np.asarray(knowledge.method["nodes"][KITCHEN])
    percept = Percept(
        jnp.asarray(both), jnp.int32(0), jnp.int32(NO_ACTION), jnp.bool_(False), jnp.int32(0), jnp.int32(0)
    )
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
    knowledge = knowledge_of(*pair, zones=2)
    note = TRACKER.init(knowledge)
    assert note.room_type == KITCHEN  # two scenes in three
    note = see(note, knowledge, 3)  # chair
    assert note.room_type == KITCHEN
    np.testing.assert_allclose(read_of(note, knowledge, BOOK).room_probs[jnp.array(ROOMS)], [2 / 3, 1 / 3], rtol=1e-5)
    pulled = note.nodes
    note = see(note, knowledge, 6)  # fridge: share 0.95 x 1/2 + 0.05 / 3 in bedrooms, 0.05 / 3 in kitchens
    bedroom, kitchen = (0.475 + 0.05 / 3) / 3, 2 * (0.05 / 3) / 3
    assert note.room_type == BEDROOM
    reading = read_of(note, knowledge, FRIDGE)
    np.testing.assert_allclose(reading.room_probs[BEDROOM], bedroom / (bedroom + kitchen), rtol=1e-5)
    assert (reading.room_probs[jnp.array([1, 3, 4])] == 0).all()  # room types without scenes
    # The bedroom's graph begins untouched, but for this view of its fridge.
    np.testing.assert_allclose(note.nodes, knowledge.method["nodes"][BEDROOM], atol=1e-6)
    assert (pulled != note.nodes).any()
    assert see(note, knowledge, 3).room_type == BEDROOM  # the fridge is not forgotten


# What the network makes of it


SPEC = dataclasses.replace(tiny.SPEC, method=find_method("hoz"), method_sizes=())


@functools.cache
def policy():
    return bind(SPEC, init_params(SPEC, jax.random.key(0)))


def experience(reading, weights=None, cell=0, goal=FRIDGE):
    module, row = policy().method, jnp.asarray(PATH.rows[cell * PER_CELL])
    seen = unpack_features(row, jnp.int32(goal), RowFormat(K))
    return module.encode(seen, policy().appearance.embedding[...], jnp.ones(K) if weights is None else weights, reading)


def reading_in(zones, goal=FRIDGE, cell=0):
    knowledge = Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, zones))
    return read_of(see(TRACKER.init(knowledge), knowledge, cell), knowledge, goal)


@pytest.mark.slow
def test_permuted_relations_change_the_experience_and_nothing_else_of_the_graph():
    bank = [corridor(BOOK, CHAIR, FRIDGE)]
    zones, permuted = learn_zones(bank, NOTHING, 3), learn_permuted_zones(bank, NOTHING, 3)
    for name in ("nodes", "detected", "frequency"):
        np.testing.assert_array_equal(zones[name], permuted[name])
    assert indirect_share(zones, permuted["next_zone"]) == 2 / 6
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
    other = reading._replace(zone_rows=reading.zone_rows.at[place].add(1.0))
    assert np.abs(experience(reading) - experience(other)).max() > 1e-4


def test_layout_weights_multiply_the_zones_too():
    """A category of weight 0 says the same whatever its entries in the zones are; others do not."""
    reading = reading_in(learned(*KITCHENS))
    wiped = jnp.ones(K).at[CHAIR].set(0.0)
    maps = (policy().method.width - NUM_PRIORS) // K
    for weights, same in ((wiped, True), (jnp.ones(K), False)):
        expected = experience(reading, weights)
        louder = ZoneReading(reading.room_probs, 3.0 * reading.zone_rows)
        louder_result = experience(louder, weights)
        chair = slice(CHAIR * maps, (CHAIR + 1) * maps)
        assert np.array_equal(expected[chair], louder_result[chair]) == same
        assert not np.array_equal(expected, louder_result)
    np.testing.assert_array_equal(experience(reading)[-NUM_PRIORS:], reading.room_probs)
