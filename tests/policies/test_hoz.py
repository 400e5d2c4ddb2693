"""HOZ: room type, zones and nodes of the tracker in corridors with a known graph, and the network's experience."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CHAIR, FRIDGE
from support.zones import (
    BEDROOM_PRIOR,
    EAST,
    KITCHEN_PRIOR,
    KITCHENS,
    NO_COUNTS,
    NUM_CATEGORIES,
    POSES_PER_CELL,
    ROOMS,
    THREE_ZONE_CORRIDOR,
    corridor,
    find_zone_of,
    indirect_share,
    learn_corridor_zones,
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

# The tracker


NODE_RATE = 0.25
TRACKER = ZoneTracker(node_rate=NODE_RATE)
update_state = jax.jit(TRACKER.update)
read_state = jax.jit(TRACKER.read)


def make_knowledge(zones):
    return Knowledge(jnp.zeros(0), jax.tree.map(jnp.asarray, zones))


def look(state, knowledge, row, heading=EAST):
    """Update the state by the view of a row, without an action."""
    percept = Percept(
        jnp.asarray(row), jnp.int32(heading), jnp.int32(NO_ACTION), jnp.bool_(False), jnp.int32(0), jnp.int32(0)
    )
    return update_state(state, knowledge, percept)


def look_from_cell(state, knowledge, cell, heading=EAST):
    """Look from a cell of the corridor of book, chair and fridge."""
    return look(state, knowledge, THREE_ZONE_CORRIDOR.rows[cell * POSES_PER_CELL + 2 * heading], heading)


def test_zone_follows_the_walk_and_next_zone_leads_to_the_goal():
    """East (B B B C C C F F F), four turns (F F F F), and three steps back (F F C)."""
    zones = learn_corridor_zones(*KITCHENS)
    knowledge = make_knowledge(zones)
    zone_by_category = [find_zone_of(zones, category) for category in range(NUM_CATEGORIES)]
    category_by_zone = {zone: category for category, zone in enumerate(zone_by_category)}

    # Poses of the walk, which begins in the first cell.
    pose = 2 * EAST
    poses = [pose]
    for action in [MOVE_AHEAD] * 8 + [ROTATE_RIGHT] * 4 + [MOVE_AHEAD] * 3:
        pose = int(THREE_ZONE_CORRIDOR.successor[pose, action])
        poses.append(pose)

    # Follow the walk on the way to the fridge.
    state = TRACKER.init(knowledge)
    walk_categories = []
    zone_rows = []
    for pose in poses:
        state = look_from_cell(state, knowledge, pose // POSES_PER_CELL, pose // 2 % 8)
        walk_categories.append(category_by_zone[int(state.zone)])
        zone_rows.append(read_state(state, knowledge, FRIDGE).zone_rows)
    assert walk_categories == [BOOK] * 3 + [CHAIR] * 3 + [FRIDGE] * 3 + [FRIDGE] * 4 + [FRIDGE] * 2 + [CHAIR]

    # The current, the next and the goal's zone are described by their nodes, mixed with the adjoining nodes. The node
    # of a zone is the one-hot vector of its category.
    nodes = np.eye(3)[[category_by_zone[zone] for zone in range(3)]]
    mixed_nodes = zones["mixing"][KITCHEN_PRIOR] @ nodes
    book_zone, chair_zone, fridge_zone = zone_by_category
    for cell, expected_zones in (
        (0, [book_zone, chair_zone, fridge_zone]),
        (4, [chair_zone, fridge_zone, fridge_zone]),
        (8, [fridge_zone, fridge_zone, fridge_zone]),
    ):
        np.testing.assert_allclose(zone_rows[cell], mixed_nodes[expected_zones], atol=1e-6)


def test_zones_without_poses_are_never_entered():
    zones = learn_corridor_zones(*KITCHENS, zones=5)  # three different views
    has_poses = zones["nodes"][KITCHEN_PRIOR].max(axis=-1) >= 0
    assert has_poses.sum() == 3
    assert (zones["nodes"][KITCHEN_PRIOR][~has_poses] == -1).all()
    assert (zones["nodes"][BEDROOM_PRIOR] == -1).all()
    assert indirect_share(zones, zones["next_zone"]) == 2 / 6
    assert all(np.isfinite(zones[name]).all() for name in ("nodes", "mixing", "detected"))

    # Walk through the corridor.
    knowledge = make_knowledge(zones)
    state = ZoneTracker().init(knowledge)
    for cell in range(9):
        state = look_from_cell(state, knowledge, cell)
        assert has_poses[state.zone]
        assert (read_state(state, knowledge, BOOK).zone_rows >= 0).all()


def test_view_pulls_only_the_node_of_its_zone():
    zones = learn_corridor_zones(*KITCHENS)
    knowledge = make_knowledge(zones)
    nodes = np.asarray(knowledge.method["nodes"][KITCHEN_PRIOR])

    # A view of book and chair is equally near to the zones of both, so either may be chosen.
    row = np.array(THREE_ZONE_CORRIDOR.rows[0])
    row[4 * CHAIR] = 200
    state = look(TRACKER.init(knowledge), knowledge, row, heading=0)
    zone = int(state.zone)
    assert zone in (find_zone_of(zones, BOOK), find_zone_of(zones, CHAIR))

    # node + rate (view - node): 1 stays 1, and a category that was not in the zone gets 0 + 0.25 (1 - 0).
    expected_nodes = nodes.copy()
    for category in (BOOK, CHAIR):
        expected_nodes[zone, category] = 1.0 if nodes[zone, category] == 1 else NODE_RATE
    expected_nodes[zone, FRIDGE] = 0.0
    np.testing.assert_allclose(state.nodes, expected_nodes)


def test_room_type_is_inferred_from_the_detected_categories():
    """Kitchens show book and chair, bedrooms chair and fridge; no input of the tracker names the room type."""
    training_scenes = (((BOOK, CHAIR), "kitchen"), ((BOOK, CHAIR), "kitchen"), ((CHAIR, FRIDGE), "bedroom"))
    knowledge = make_knowledge(learn_corridor_zones(*training_scenes, zones=2))
    state = TRACKER.init(knowledge)
    assert state.room_type == KITCHEN_PRIOR  # two scenes in three

    # The chair is equally frequent in both room types and leaves the shares of the scenes.
    state = look_from_cell(state, knowledge, 3)
    assert state.room_type == KITCHEN_PRIOR
    room_probs = read_state(state, knowledge, BOOK).room_probs
    np.testing.assert_allclose(room_probs[jnp.array(ROOMS)], [2 / 3, 1 / 3], rtol=1e-5)
    kitchen_nodes = state.nodes

    # 5 % of the uniform distribution over three categories is mixed in (`UNIFORM_SHARE`), so the fridge has the share
    # 0.95 x 1/2 + 0.05 / 3 in bedrooms and 0.05 / 3 in kitchens.
    state = look_from_cell(state, knowledge, 6)
    assert state.room_type == BEDROOM_PRIOR
    uniform_prob = 0.05 / 3
    bedroom_weight = (0.95 / 2 + uniform_prob) / 3
    kitchen_weight = 2 * uniform_prob / 3
    room_probs = read_state(state, knowledge, FRIDGE).room_probs
    np.testing.assert_allclose(room_probs[BEDROOM_PRIOR], bedroom_weight / (bedroom_weight + kitchen_weight), rtol=1e-5)
    room_types_without_scenes = sorted(set(range(NUM_PRIORS)) - set(ROOMS))
    assert (room_probs[jnp.array(room_types_without_scenes)] == 0).all()

    # The bedroom's graph begins as learn_corridor_zones, but for this view of its fridge.
    np.testing.assert_allclose(state.nodes, knowledge.method["nodes"][BEDROOM_PRIOR], atol=1e-6)
    assert (kitchen_nodes != state.nodes).any()

    # The detected fridge is not forgotten.
    assert look_from_cell(state, knowledge, 3).room_type == BEDROOM_PRIOR


# The network


SPEC = dataclasses.replace(tiny.SPEC, method=find_method("hoz"), method_sizes=())
EQUAL_WEIGHTS = jnp.ones(NUM_CATEGORIES)


@functools.cache
def make_policy():
    return bind(SPEC, init_params(SPEC, jax.random.key(0)))


def encode_experience(reading, layout_weights=EQUAL_WEIGHTS):
    """Experience in the first cell of the corridor, where the goal is the fridge."""
    policy = make_policy()
    features = unpack_features(jnp.asarray(THREE_ZONE_CORRIDOR.rows[0]), jnp.int32(FRIDGE), RowFormat(NUM_CATEGORIES))
    return policy.method.encode(features, policy.appearance.embedding[...], layout_weights, reading)


def read_first_cell(zones):
    """The tracker's reading in the first cell of the corridor, where the goal is the fridge."""
    knowledge = make_knowledge(zones)
    state = look_from_cell(TRACKER.init(knowledge), knowledge, 0)
    return read_state(state, knowledge, FRIDGE)


@pytest.mark.slow
def test_permuted_relations_change_the_experience_and_nothing_else_of_the_graph():
    bank = [corridor(BOOK, CHAIR, FRIDGE)]
    zones = learn_zones(bank, NO_COUNTS, 3)
    permuted_zones = learn_permuted_zones(bank, NO_COUNTS, 3)
    for name in ("nodes", "detected", "frequency"):
        np.testing.assert_array_equal(zones[name], permuted_zones[name])
    assert indirect_share(zones, permuted_zones["next_zone"]) == 2 / 6

    # Each zone gets the edges of the zone before it, its loop included: the graph is equal up to the names of zones.
    loops = np.diagonal(zones["mixing"][KITCHEN_PRIOR])
    permuted_loops = np.diagonal(permuted_zones["mixing"][KITCHEN_PRIOR])
    np.testing.assert_array_equal(permuted_loops, np.roll(loops, 1))
    next_zone = zones["next_zone"][KITCHEN_PRIOR]
    permuted_next_zone = permuted_zones["next_zone"][KITCHEN_PRIOR]
    for start_zone in range(3):
        for end_zone in range(3):
            assert (permuted_next_zone[start_zone, end_zone] - next_zone[start_zone - 1, end_zone - 1]) % 3 == 1

    # Either of the two relations changes the experience without the other one.
    for name in ("mixing", "next_zone"):
        changed_zones = zones | {name: permuted_zones[name]}
        experience = encode_experience(read_first_cell(zones))
        changed_experience = encode_experience(read_first_cell(changed_zones))
        assert np.abs(experience - changed_experience).max() > 1e-3


@pytest.mark.parametrize("zone_index", range(3))
def test_current_next_and_goal_zone_all_enter_the_experience(zone_index):
    reading = read_first_cell(learn_corridor_zones(*KITCHENS))
    changed_reading = reading._replace(zone_rows=reading.zone_rows.at[zone_index].add(1.0))
    assert np.abs(encode_experience(reading) - encode_experience(changed_reading)).max() > 1e-4


def test_layout_weights_multiply_the_zones_too():
    """The experience of a category of weight 0 does not depend on its entries in the zones; with weight 1 it does."""
    reading = read_first_cell(learn_corridor_zones(*KITCHENS))
    tripled_reading = ZoneReading(reading.room_probs, 3.0 * reading.zone_rows)
    outputs_per_category = (make_policy().method.width - NUM_PRIORS) // NUM_CATEGORIES
    chair_outputs = slice(CHAIR * outputs_per_category, (CHAIR + 1) * outputs_per_category)

    weights_without_chair = EQUAL_WEIGHTS.at[CHAIR].set(0.0)
    for layout_weights, is_chair_equal in ((weights_without_chair, True), (EQUAL_WEIGHTS, False)):
        experience = encode_experience(reading, layout_weights)
        tripled_experience = encode_experience(tripled_reading, layout_weights)
        assert np.array_equal(experience[chair_outputs], tripled_experience[chair_outputs]) == is_chair_equal
        assert not np.array_equal(experience, tripled_experience)

    # The probabilities of the room types follow the categories.
    np.testing.assert_array_equal(encode_experience(reading)[-NUM_PRIORS:], reading.room_probs)
