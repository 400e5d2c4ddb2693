"""Options of the policy: the detections on the direct pathway, the gate on Done, and the kind of layout weights."""

import dataclasses
import functools
import itertools
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
from jaxnav.policies.method import Stage
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import DONE_GATE_FACTOR, bind, init_params
from jaxnav.policies.pathways import Pathways, PolicyInputs, PolicyState
from jaxnav.policies.spec import Direct, PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

DIRECT_OPTIONS = get_args(Direct)
NUM_CATEGORIES = len(CATEGORIES)
BATCH_SIZE = 6
EPISODES = np.arange(BATCH_SIZE)
GOALS = np.array([BOOK, CHAIR, FRIDGE] * 2)
#: Bytes of a detection, confidence, ahead, right and size, and those of an undetected category.
DETECTED = [128, 51, 140, 90]
UNDETECTED = [0, 0, 0, 0]
EQUAL_WEIGHTS = jnp.ones((BATCH_SIZE, NUM_CATEGORIES))


def make_detections(goal_detection, other_detections):
    """Detections of the goal and of the two other categories in every episode, bytes [BATCH_SIZE, K, 4]."""
    detections = np.empty((BATCH_SIZE, NUM_CATEGORIES, 4), np.uint8)
    detections[:] = other_detections
    detections[EPISODES, GOALS] = goal_detection
    return detections


def observe_detections(detections):
    """Observations of fixed views with some detections, bytes [BATCH_SIZE, K, 4]."""
    rows = BANK.rows[EPISODES].copy()
    rows[:, : 4 * NUM_CATEGORIES] = np.reshape(detections, (BATCH_SIZE, 4 * NUM_CATEGORIES))
    return Observation(row=jnp.asarray(rows), goal=jnp.asarray(GOALS))


def observe(goal_detection, other_detections):
    """Observations of fixed views with a detection of the goal and one of the two other categories."""
    return observe_detections(make_detections(goal_detection, other_detections))


def random_memory(seed=0):
    rng = np.random.default_rng(seed)
    hidden = jnp.asarray(rng.normal(size=(BATCH_SIZE, SIZES.hidden)), jnp.float32)
    return PolicyState(hidden=hidden, action=jnp.asarray(rng.integers(0, NUM_ACTIONS + 1, BATCH_SIZE), jnp.int32))


class CompiledPolicy:
    """Compiled methods of a policy with some options; the parameters are equal for all options."""

    def __init__(self, **options):
        policy = bind(dataclasses.replace(SPEC, **options), random_params(0))
        self.pathways = jax.jit(lambda observation: policy.pathways(PolicyInputs(observation, EQUAL_WEIGHTS)))
        self.decide = jax.jit(lambda pathways, memory: policy.decide(pathways, memory))


@pytest.fixture(scope="module", params=DIRECT_OPTIONS)
def direct_policy(request):
    """Value of the option `direct`, and a policy with it."""
    return request.param, CompiledPolicy(direct=request.param)


@pytest.fixture(scope="module")
def plain_policy():
    return CompiledPolicy()


@pytest.fixture(scope="module")
def gated_policy():
    return CompiledPolicy(done_gate=True)


# Detections on the direct pathway


def test_detections_of_other_categories_reach_the_direct_pathway_only_if_it_sees_all(direct_policy):
    option, policy = direct_policy
    pathways = policy.pathways(observe(DETECTED, DETECTED))
    goal_only_pathways = policy.pathways(observe(DETECTED, UNDETECTED))
    np.testing.assert_array_equal(pathways.scene, goal_only_pathways.scene)
    # In every episode experience depends on the other categories, for all values of the option.
    assert (pathways.experience != goal_only_pathways.experience).any(axis=1).all()
    assert (pathways.goal != goal_only_pathways.goal).any(axis=1).tolist() == [option == "all"] * BATCH_SIZE


def test_detection_of_the_goal_reaches_the_direct_pathway_unless_it_sees_none(direct_policy):
    option, policy = direct_policy
    pathways = policy.pathways(observe(DETECTED, DETECTED))
    others_only_pathways = policy.pathways(observe(UNDETECTED, DETECTED))
    assert (pathways.experience != others_only_pathways.experience).any(axis=1).all()
    assert (pathways.goal != others_only_pathways.goal).any(axis=1).tolist() == [option != "none"] * BATCH_SIZE


@pytest.mark.slow
def test_goal_row_shows_the_detection_of_the_goal_in_one_place_for_all_goals():
    """Goals that look alike and are detected alike have equal goal rows."""
    # All categories have one appearance.
    spec = dataclasses.replace(SPEC, goal_row=True)
    params = random_params(0, spec)
    params["appearance"]["embedding"] = jnp.ones_like(params["appearance"]["embedding"])

    def embed_goal(observation):
        return np.asarray(bind(spec, params).pathways(PolicyInputs(observation, EQUAL_WEIGHTS)).goal)

    # The goal pathway holds a row for each category, the goal row, and the appearance of the goal.
    goal = embed_goal(observe(DETECTED, UNDETECTED))
    first_goal_output = NUM_CATEGORIES * SIZES.row_outputs
    end_goal_output = first_goal_output + SIZES.row_outputs
    category_rows, goal_row, _ = np.split(goal, [first_goal_output, end_goal_output], axis=1)
    assert goal.shape[1] == (NUM_CATEGORIES + 1) * SIZES.row_outputs + SIZES.appearance
    assert len(np.unique(category_rows, axis=0)) == len(np.unique(GOALS))
    assert len(np.unique(goal_row, axis=0)) == 1

    # An undetected goal has another goal row.
    undetected_goal_row = embed_goal(observe(UNDETECTED, DETECTED))[:, first_goal_output : -SIZES.appearance]
    assert np.all(np.any(undetected_goal_row != goal_row, axis=1))


def test_goal_category_always_enters_the_direct_pathway(direct_policy):
    _, policy = direct_policy
    goal = policy.pathways(observe(UNDETECTED, UNDETECTED)).goal
    assert len(np.unique(np.asarray(goal), axis=0)) == NUM_CATEGORIES


def test_policy_acts_on_detections_of_every_pathway(direct_policy):
    """With `none` only experience depends on detections: without experience they have no effect."""
    option, policy = direct_policy
    memory = random_memory()
    pathways = policy.pathways(observe(DETECTED, DETECTED))
    undetected_pathways = policy.pathways(observe(UNDETECTED, UNDETECTED))
    logits = policy.decide(pathways, memory).logits
    undetected_logits = policy.decide(undetected_pathways, memory).logits
    assert (logits != undetected_logits).any(axis=1).all()

    # Without experience.
    decision = policy.decide(do(pathways, experience=0.0), memory)
    undetected_decision = policy.decide(do(undetected_pathways, experience=0.0), memory)
    is_changed = (decision.logits != undetected_decision.logits).any(axis=1)
    assert is_changed.tolist() == [option != "none"] * BATCH_SIZE


def test_parameters_have_equal_shapes_for_all_options():
    shapes = []
    for option, has_gate in itertools.product(DIRECT_OPTIONS, (False, True)):
        spec = dataclasses.replace(SPEC, direct=option, done_gate=has_gate)
        shapes.append(jax.eval_shape(functools.partial(init_params, spec), jax.random.key(1)))
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes[0])) > 1000
    assert shapes[1:] == 5 * [shapes[0]]


# The gate on Done

#: Confidence of the goal's detection in every episode: 255 is certain, 51 a fifth, 0 undetected.
CONFIDENCES = np.array([255, 51, 0, 0, 128, 1])
GATE_FACTORS = np.array([0.58, 0.116, 0.0, 0.0, 0.58 * 128 / 255, 0.58 / 255], np.float32)


def observe_confidences(other_detections=DETECTED):
    """Observations in which the goal is detected with these confidences."""
    detections = make_detections(DETECTED, other_detections)
    detections[EPISODES, GOALS, 0] = CONFIDENCES
    return observe_detections(detections)


def test_gate_is_proportional_to_the_confidence_of_the_goal(gated_policy, plain_policy):
    assert DONE_GATE_FACTOR == 0.58
    for other_detections in (DETECTED, UNDETECTED):
        gate = gated_policy.pathways(observe_confidences(other_detections)).gate
        np.testing.assert_allclose(gate[:, 0], GATE_FACTORS, rtol=1e-6)
    np.testing.assert_array_equal(plain_policy.pathways(observe_confidences()).gate, np.ones((BATCH_SIZE, 1)))


@pytest.mark.parametrize("intervention", [{}, {"scene": 0.0, "goal": 0.0}, {"experience": 0.0}])
def test_gate_multiplies_only_the_logit_of_done(gated_policy, plain_policy, intervention):
    """The factor is equal in the factual decision and in any counterfactual one."""
    observation = observe_confidences()
    memory = random_memory()
    gated = gated_policy.decide(do(gated_policy.pathways(observation), **intervention), memory)
    plain = plain_policy.decide(do(plain_policy.pathways(observation), **intervention), memory)
    np.testing.assert_allclose(gated.logits[:, :DONE], plain.logits[:, :DONE], rtol=1e-6)
    np.testing.assert_allclose(gated.logits[:, DONE], GATE_FACTORS * plain.logits[:, DONE], rtol=1e-5, atol=1e-9)
    assert (gated.logits[CONFIDENCES == 0, DONE] == 0).all()
    assert (plain.logits[:, DONE] != 0).all()
    np.testing.assert_allclose(gated.value, plain.value, rtol=1e-5)
    np.testing.assert_allclose(gated.hidden, plain.hidden, rtol=1e-5)


def test_gate_sees_the_goal_if_the_direct_pathway_sees_nothing():
    gate = CompiledPolicy(direct="none", done_gate=True).pathways(observe_confidences()).gate
    np.testing.assert_allclose(gate[:, 0], GATE_FACTORS, rtol=1e-6)


def test_gate_that_is_off_is_ignored(plain_policy):
    memory = random_memory()
    pathways = plain_policy.pathways(observe_confidences())
    closed_pathways = Pathways(*pathways[:3], gate=jnp.zeros_like(pathways.gate))
    chex.assert_trees_all_equal(plain_policy.decide(closed_pathways, memory), plain_policy.decide(pathways, memory))


# Scale at which the layout weights enter experience


def encode_experience(weight_kind, observation, layout_weights):
    """Z of a policy with this kind of weights, [BATCH_SIZE, Z]."""
    policy = bind(dataclasses.replace(SPEC, weight_kind=weight_kind), random_params(0))
    return np.asarray(policy.pathways(PolicyInputs(observation, jnp.asarray(layout_weights))).experience)


@pytest.mark.slow
def test_relative_weights_enter_as_raw_weights_that_were_scaled():
    observation = observe(DETECTED, DETECTED)
    raw_weights = np.tile(np.array([0.1, 0.3, 0.2], np.float32), (BATCH_SIZE, 1))
    raw_weights[EPISODES, GOALS] = 1.0

    # Two categories differ from the goal: the weight of each is divided by the mean of the two.
    scaled_weights = raw_weights.copy()
    for episode, goal in enumerate(GOALS):
        is_other = np.arange(NUM_CATEGORIES) != goal
        scaled_weights[episode, is_other] /= raw_weights[episode, is_other].mean()
    relative = encode_experience("relative", observation, raw_weights)
    np.testing.assert_allclose(relative, encode_experience("raw", observation, scaled_weights), rtol=1e-5, atol=1e-6)
    assert np.abs(relative - encode_experience("raw", observation, raw_weights)).max() > 0.01


@pytest.mark.parametrize("weight_kind", ["relative", "pixel"])
def test_direct_pathways_do_not_depend_on_the_kind_of_weights(weight_kind):
    inputs = PolicyInputs(observe(DETECTED, DETECTED), jnp.full((BATCH_SIZE, NUM_CATEGORIES), 0.2))
    pathways = {}
    for kind in ("raw", weight_kind):
        pathways[kind] = bind(dataclasses.replace(SPEC, weight_kind=kind), random_params(0)).pathways(inputs)
    np.testing.assert_array_equal(pathways["raw"].scene, pathways[weight_kind].scene)
    np.testing.assert_array_equal(pathways["raw"].goal, pathways[weight_kind].goal)
    assert (pathways["raw"].experience != pathways[weight_kind].experience).any()


def test_pixels_scale_position_and_size_but_not_visibility_confidence_and_goal():
    features = unpack_features(observe(DETECTED, DETECTED).row, jnp.asarray(GOALS), RowFormat(NUM_CATEGORIES))
    scaled_features = scale_geometry(features)
    ratio = np.asarray(scaled_features.table / jnp.where(features.table == 0, 1, features.table))
    is_set = np.asarray(features.table != 0)
    expected = np.array([1, 1, 300, 300, 300, 300, 300, 300, 1]) * is_set
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    np.testing.assert_array_equal(scaled_features.visible, features.visible)


def test_specs_of_earlier_versions_have_raw_weights():
    fields = dataclasses.replace(SPEC, weight_kind="relative").to_json()
    assert PolicySpec.from_json(fields, SPEC.method, NUM_CATEGORIES).weight_kind == "relative"
    del fields["weight_kind"]
    assert PolicySpec.from_json(fields, SPEC.method, NUM_CATEGORIES) == SPEC


def test_unknown_kind_of_weights_is_refused():
    with pytest.raises(ValueError, match="weight_kind is 'squared'; choose one of raw, relative, pixel"):
        dataclasses.replace(SPEC, weight_kind="squared")


def test_unknown_detections_of_the_direct_pathway_are_refused():
    with pytest.raises(ValueError, match="direct is 'goals'; choose one of"):
        dataclasses.replace(SPEC, direct="goals")


def test_methods_that_host_the_layout_keep_all_categories():
    """Layout weights belong to all categories, and `anonymous` perceives the goal alone."""
    method = dataclasses.replace(find_method("anonymous"), hosts_layout=True)
    with pytest.raises(ValueError, match="hosts_layout=False"):
        init_params(dataclasses.replace(SPEC, method=method), jax.random.key(0))


def test_a_stage_without_adaptation_comes_first_or_last():
    """Between two stages with adaptation, new episodes would inherit the fast weights of ended ones."""
    method = find_method("savn")
    without_adaptation = Stage(0.5, adapts_online=False)
    for stages in ((without_adaptation, Stage(0.5)), (Stage(0.5), without_adaptation)):
        assert dataclasses.replace(method, stages=stages).stages == stages
    with pytest.raises(ValueError, match="put this stage first or last"):
        dataclasses.replace(method, stages=(Stage(0.25), without_adaptation, Stage(0.25)))
