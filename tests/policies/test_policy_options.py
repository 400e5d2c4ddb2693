"""Options of the policy: which detections the direct pathway sees, and the gate on Done."""

import dataclasses
import functools
from typing import get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE
from support.tiny_world import BANK, SIZES, SPEC, random_params

from jaxnav.causal import do
from jaxnav.env.objectnav import Observation
from jaxnav.policies.features import scale_geometry, unpack_features
from jaxnav.policies.network import DONE_GATE, bind, init_params
from jaxnav.policies.pathways import Pathways, PolicyInputs, PolicyState
from jaxnav.policies.spec import Direct, PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

DIRECT = get_args(Direct)
K, BATCH = len(CATEGORIES), 6
GOAL = np.array([BOOK, CHAIR, FRIDGE] * 2)
SEEN, UNSEEN = [128, 51, 140, 90], [0, 0, 0, 0]  # bytes: confidence, ahead, right, size


def with_detections(detections):
    """Observations of the same views with these detections, bytes [BATCH, K, 4]."""
    row = BANK.rows[np.arange(BATCH)].copy()
    row[:, : 4 * K] = np.reshape(detections, (BATCH, 4 * K))
    return Observation(row=jnp.asarray(row), goal=jnp.asarray(GOAL))


def detections(goal, others):
    """The goal's detection in every episode, and that of the two other categories."""
    result = np.empty((BATCH, K, 4), np.uint8)
    result[:] = others
    result[np.arange(BATCH), GOAL] = goal
    return result


def memory(seed=0):
    generator = np.random.default_rng(seed)
    hidden = jnp.asarray(generator.normal(size=(BATCH, SIZES.hidden)), jnp.float32)
    return PolicyState(hidden=hidden, action=jnp.asarray(generator.integers(0, NUM_ACTIONS + 1, BATCH), jnp.int32))


class Compiled:
    """The same parameters under options of their own."""

    def __init__(self, **options):
        spec = dataclasses.replace(SPEC, **options)
        policy = bind(spec, random_params(0))
        self.pathways = jax.jit(lambda observation: policy.pathways(PolicyInputs(observation, jnp.ones((BATCH, K)))))
        self.decide = jax.jit(lambda pathways, memory: policy.decide(pathways, memory))


@pytest.fixture(scope="module", params=DIRECT)
def direct(request):
    return request.param, Compiled(direct=request.param)


@pytest.fixture(scope="module")
def plain():
    return Compiled()


@pytest.fixture(scope="module")
def gated():
    return Compiled(done_gate=True)


# Which detections the direct pathway sees


def test_detections_of_other_categories_reach_the_direct_pathway_only_if_it_sees_all(direct):
    name, policy = direct
    one, other = (policy.pathways(with_detections(detections(SEEN, others))) for others in (SEEN, UNSEEN))
    np.testing.assert_array_equal(one.scene, other.scene)
    # In every episode: experience speaks of the others whatever the direct pathway sees.
    assert (one.experience != other.experience).any(axis=1).all()
    assert (one.goal != other.goal).any(axis=1).tolist() == [name == "all"] * BATCH


def test_the_detection_of_the_goal_reaches_it_unless_it_sees_none(direct):
    name, policy = direct
    one, other = (policy.pathways(with_detections(detections(goal, SEEN))) for goal in (SEEN, UNSEEN))
    assert (one.experience != other.experience).any(axis=1).all()
    assert (one.goal != other.goal).any(axis=1).tolist() == [name != "none"] * BATCH


@pytest.mark.slow
def test_the_detection_of_the_goal_enters_in_one_place_whatever_is_sought():
    """Goals that look alike and are detected alike have equal rows there."""
    outputs, appearance = SIZES.row_outputs, SIZES.appearance
    spec = dataclasses.replace(SPEC, goal_row=True)
    weights = random_params(0, spec)
    weights["appearance"]["embedding"] = jnp.ones_like(weights["appearance"]["embedding"])
    observation = with_detections(detections(SEEN, UNSEEN))
    goal = np.asarray(bind(spec, weights).pathways(PolicyInputs(observation, jnp.ones((BATCH, K)))).goal)
    by_category, own, _ = np.split(goal, [K * outputs, (K + 1) * outputs], axis=1)
    assert goal.shape[1] == (K + 1) * outputs + appearance
    assert len(np.unique(by_category, axis=0)) == len(np.unique(GOAL))
    assert len(np.unique(own, axis=0)) == 1
    others = with_detections(detections(UNSEEN, SEEN))
    pathways = bind(spec, weights).pathways(PolicyInputs(others, jnp.ones((BATCH, K))))
    unseen = np.asarray(pathways.goal)[:, K * outputs : -appearance]
    assert np.all(np.any(unseen != own, axis=1))


def test_what_is_sought_is_always_known(direct):
    _, policy = direct
    goal = policy.pathways(with_detections(detections(UNSEEN, UNSEEN))).goal
    assert len(np.unique(np.asarray(goal), axis=0)) == K


def test_the_policy_acts_on_what_is_left(direct):
    """`none` still acts on detections, by way of experience alone: without it they are of no effect."""
    name, policy = direct
    one, other = (policy.pathways(with_detections(detections(seen, seen))) for seen in (SEEN, UNSEEN))
    assert (policy.decide(one, memory()).logits != policy.decide(other, memory()).logits).any(axis=1).all()
    one, other = (policy.decide(do(own, experience=0.0), memory()).logits for own in (one, other))
    assert (one != other).any(axis=1).tolist() == [name != "none"] * BATCH


def test_the_number_of_parameters_is_the_same_for_all_options():
    specs = [dataclasses.replace(SPEC, direct=name, done_gate=gate) for name in DIRECT for gate in (False, True)]
    first, *others = (jax.eval_shape(functools.partial(init_params, spec), jax.random.key(1)) for spec in specs)
    assert sum(leaf.size for leaf in jax.tree.leaves(first)) > 1000
    assert others == 5 * [first]


# The gate on Done

#: 255 is certain, 51 a fifth, 0 undetected.
CONFIDENCE = np.array([255, 51, 0, 0, 128, 1])
FACTOR = np.array([0.58, 0.116, 0.0, 0.0, 0.58 * 128 / 255, 0.58 / 255], np.float32)


def uncertain(others=SEEN):
    """The goal detected with those confidences."""
    result = detections(SEEN, others)
    result[np.arange(BATCH), GOAL, 0] = CONFIDENCE
    return with_detections(result)


def test_the_gate_is_the_confidence_of_the_goal(gated, plain):
    assert DONE_GATE == 0.58
    for others in (SEEN, UNSEEN):  # whatever else is detected
        np.testing.assert_allclose(gated.pathways(uncertain(others)).gate[:, 0], FACTOR, rtol=1e-6)
    np.testing.assert_array_equal(plain.pathways(uncertain()).gate, np.ones((BATCH, 1)))


@pytest.mark.parametrize("intervention", [{}, {"scene": 0.0, "goal": 0.0}, {"experience": 0.0}])
def test_the_gate_multiplies_the_logit_of_done_alone(gated, plain, intervention):
    """By the same factor in the factual decision and in any counterfactual one."""
    observation = uncertain()
    pathways = do(gated.pathways(observation), **intervention)
    result = gated.decide(pathways, memory())
    free = plain.decide(do(plain.pathways(observation), **intervention), memory())
    np.testing.assert_allclose(result.logits[:, :DONE], free.logits[:, :DONE], rtol=1e-6)
    np.testing.assert_allclose(result.logits[:, DONE], FACTOR * free.logits[:, DONE], rtol=1e-5, atol=1e-9)
    assert (result.logits[CONFIDENCE == 0, DONE] == 0).all()
    assert (free.logits[:, DONE] != 0).all()
    np.testing.assert_allclose(result.value, free.value, rtol=1e-5)
    np.testing.assert_allclose(result.hidden, free.hidden, rtol=1e-5)


def test_the_gate_sees_the_goal_where_the_direct_pathway_sees_nothing():
    gate = Compiled(direct="none", done_gate=True).pathways(uncertain()).gate
    np.testing.assert_allclose(gate[:, 0], FACTOR, rtol=1e-6)


def test_a_gate_that_is_off_is_ignored(plain):
    pathways = plain.pathways(uncertain())
    closed = Pathways(*pathways[:3], gate=jnp.zeros_like(pathways.gate))
    chex.assert_trees_all_equal(plain.decide(closed, memory()), plain.decide(pathways, memory()))


# Scale at which the layout weights enter experience


def encode_experience(weight_kind, observation, layout_weights):
    """Z of a policy with this kind of weights, [BATCH, Z]."""
    policy = bind(dataclasses.replace(SPEC, weight_kind=weight_kind), random_params(0))
    return np.asarray(policy.pathways(PolicyInputs(observation, jnp.asarray(layout_weights))).experience)


@pytest.mark.slow
def test_relative_weights_enter_as_raw_weights_that_were_scaled():
    observation = with_detections(detections(SEEN, SEEN))
    raw_weights = np.tile(np.array([0.1, 0.3, 0.2], np.float32), (BATCH, 1))
    raw_weights[np.arange(BATCH), GOAL] = 1.0
    # Two categories off the goal: each over the mean of both.
    scaled_weights = raw_weights.copy()
    for episode, goal in enumerate(GOAL):
        others = np.arange(K) != goal
        scaled_weights[episode, others] /= raw_weights[episode, others].mean()
    relative = encode_experience("relative", observation, raw_weights)
    np.testing.assert_allclose(relative, encode_experience("raw", observation, scaled_weights), rtol=1e-5, atol=1e-6)
    assert np.abs(relative - encode_experience("raw", observation, raw_weights)).max() > 0.01


@pytest.mark.parametrize("weight_kind", ["relative", "pixel"])
def test_the_direct_pathways_do_not_depend_on_the_kind_of_weights(weight_kind):
    observation = with_detections(detections(SEEN, SEEN))
    inputs = PolicyInputs(observation, jnp.full((BATCH, K), 0.2))
    pathways = {}
    for kind in ("raw", weight_kind):
        pathways[kind] = bind(dataclasses.replace(SPEC, weight_kind=kind), random_params(0)).pathways(inputs)
    np.testing.assert_array_equal(pathways["raw"].scene, pathways[weight_kind].scene)
    np.testing.assert_array_equal(pathways["raw"].goal, pathways[weight_kind].goal)
    assert (pathways["raw"].experience != pathways[weight_kind].experience).any()


def test_pixels_scale_position_and_size_but_not_visibility_confidence_and_goal():
    features = unpack_features(with_detections(detections(SEEN, SEEN)).row, jnp.asarray(GOAL), RowFormat(K))
    scaled_features = scale_geometry(features)
    ratio = np.asarray(scaled_features.table / jnp.where(features.table == 0, 1, features.table))
    is_set = np.asarray(features.table != 0)
    expected = np.array([1, 1, 300, 300, 300, 300, 300, 300, 1]) * is_set
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    np.testing.assert_array_equal(scaled_features.visible, features.visible)


def test_specs_of_earlier_versions_have_raw_weights():
    fields = dataclasses.replace(SPEC, weight_kind="relative").to_json()
    assert PolicySpec.from_json(fields, SPEC.method, K).weight_kind == "relative"
    del fields["weight_kind"]
    assert PolicySpec.from_json(fields, SPEC.method, K) == SPEC


def test_an_unknown_kind_of_weights_is_refused():
    with pytest.raises(ValueError, match="weight_kind is 'squared'; choose one of raw, relative, pixel"):
        dataclasses.replace(SPEC, weight_kind="squared")
