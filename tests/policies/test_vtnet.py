"""VTNet: tokens are a set, queries are places in view, and training begins with imitation of shortest paths."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS, changed_parts
from support.scenes import CATEGORIES

from jaxnav.causal import do
from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.features import Features
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.imitation import imitation_loss
from jaxnav.policies.methods.vtnet import Transformer, UniformTransformer, position_codes, view_squares
from jaxnav.policies.network import bind
from jaxnav.policies.pathways import PolicyInputs, PolicyState
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner

NUM_CATEGORIES = 7
BATCH_SIZE = 16
#: Columns of the table of detections.
AHEAD_COLUMN, RIGHT_COLUMN, GOAL_COLUMN = 2, 3, 8
SIZES = {"token_width": 16, "feedforward": 16, "query_outputs": 4}
SPEC = PolicySpec(find_method("vtnet"), NUM_CATEGORIES, tiny.SIZES, tuple(SIZES.items()))


@functools.cache
def compile_encode(num_tokens=10, transformer_class=Transformer):
    """The compiled `encode` with random parameters, whose number does not depend on that of tokens."""
    spec = dataclasses.replace(SPEC, method_sizes=(*SPEC.method_sizes, ("tokens", num_tokens)))
    graph, params = nnx.split(transformer_class(spec, nnx.Rngs(params=1)))

    @jax.jit
    def encode(features, appearance, layout_weights):
        return nnx.merge(graph, params).encode(features, appearance, layout_weights, None)

    return encode


def make_features(*leaves):
    """Features of NumPy arrays, which their types do not name."""
    return Features(*leaves)


def random_inputs(seed=0):
    """Features [BATCH_SIZE], appearance [K, E] and layout weights [BATCH_SIZE, K].

    Every view has at least two detections beside that of the goal.
    """
    rng = np.random.default_rng(seed)
    goal = np.eye(NUM_CATEGORIES, dtype=np.float32)[rng.integers(0, NUM_CATEGORIES, BATCH_SIZE)]
    visible = (rng.random((BATCH_SIZE, NUM_CATEGORIES)) < 0.5).astype(np.float32)
    for index in range(BATCH_SIZE):
        visible[index, rng.choice(np.flatnonzero(goal[index] == 0), 2, replace=False)] = 1.0
    table = rng.normal(size=(BATCH_SIZE, NUM_CATEGORIES, 9)).astype(np.float32) * visible[..., None]
    table[..., 0] = visible
    table[..., GOAL_COLUMN] = goal
    view = rng.integers(0, 2, (BATCH_SIZE, 2 * 11 * 11)).astype(np.float32)
    appearance = rng.normal(size=(NUM_CATEGORIES, tiny.SIZES.appearance)).astype(np.float32)
    layout_weights = rng.uniform(0.1, 1.0, (BATCH_SIZE, NUM_CATEGORIES)).astype(np.float32)
    return make_features(view, visible, table, goal), appearance, layout_weights


# Tokens


@pytest.mark.slow
def test_encode_does_not_depend_on_the_order_of_categories():
    features, appearance, layout_weights = random_inputs()
    experience = compile_encode()(features, appearance, layout_weights)
    order = np.random.default_rng(1).permutation(NUM_CATEGORIES)
    permuted_features = make_features(
        features.view, features.visible[:, order], features.table[:, order], features.goal[:, order]
    )
    permuted_weights = layout_weights[:, order]
    permuted_experience = compile_encode()(permuted_features, appearance[order], permuted_weights)
    np.testing.assert_allclose(permuted_experience, experience, rtol=1e-5, atol=1e-6)
    assert np.std(experience, axis=0).max() > 0.1

    # Negative control: with another category at each place the set of tokens is another one.
    mismatched_experience = compile_encode()(permuted_features, appearance, permuted_weights)
    assert np.abs(mismatched_experience - experience).max() > 0.05


def test_encode_changes_when_two_categories_exchange_their_places():
    features, appearance, layout_weights = random_inputs()
    table = features.table.copy()
    for index in range(BATCH_SIZE):
        pair = np.flatnonzero(features.visible[index] * (1 - features.goal[index]))[:2]
        place = slice(AHEAD_COLUMN, RIGHT_COLUMN + 1)
        table[index, pair, place] = table[index, pair[::-1], place]
    experience = compile_encode()(features, appearance, layout_weights)
    exchanged_experience = compile_encode()(features._replace(table=table), appearance, layout_weights)
    assert (np.abs(exchanged_experience - experience).max(axis=-1) > 1e-3).all()


def test_encode_ignores_categories_neither_detected_nor_sought():
    features, appearance, layout_weights = random_inputs()
    is_absent = (features.visible + features.goal) == 0
    assert is_absent.any(axis=-1).sum() > BATCH_SIZE / 2
    table = np.where(is_absent[..., None], np.float32(9), features.table)
    changed_weights = np.where(is_absent, np.float32(5), layout_weights)
    experience = compile_encode()(features, appearance, layout_weights)
    changed_experience = compile_encode()(features._replace(table=table), appearance, changed_weights)
    np.testing.assert_array_equal(changed_experience, experience)

    # Negative control: weights of detected categories do matter.
    detected_weights = np.where(features.visible > 0, np.float32(5), layout_weights)
    reweighted_experience = compile_encode()(features, appearance, detected_weights)
    assert (np.abs(reweighted_experience - experience).max(axis=-1) > 1e-3).all()


@pytest.mark.slow
def test_encode_masks_surplus_tokens():
    features, appearance, layout_weights = random_inputs()
    assert (features.visible + features.goal > 0).sum(axis=-1).min() < NUM_CATEGORIES
    experience = compile_encode(NUM_CATEGORIES)(features, appearance, layout_weights)
    experience_of_more_tokens = compile_encode(3 * NUM_CATEGORIES)(features, appearance, layout_weights)
    np.testing.assert_allclose(experience, experience_of_more_tokens, rtol=1e-5, atol=1e-6)


def test_uniform_transformer_answers_all_places_alike():
    """Nothing tells them apart: their places are in the scores alone."""
    answer_shape = (BATCH_SIZE, -1, SIZES["query_outputs"])
    uniform_encode = compile_encode(transformer_class=UniformTransformer)
    uniform_answers = np.asarray(uniform_encode(*random_inputs())).reshape(answer_shape)
    attended_answers = np.asarray(compile_encode()(*random_inputs())).reshape(answer_shape)
    first_answers = np.broadcast_to(uniform_answers[:, :1], uniform_answers.shape)
    np.testing.assert_allclose(uniform_answers, first_answers, rtol=1e-5, atol=1e-6)
    assert np.std(uniform_answers, axis=0).max() > 0.01
    assert (np.std(attended_answers, axis=1).max(axis=-1) > 1e-3).all()


def test_encode_tells_goals_apart_without_detections():
    features, appearance, layout_weights = random_inputs()
    table = np.zeros_like(features.table)
    table[..., GOAL_COLUMN] = features.goal
    blind_features = make_features(0 * features.view, 0 * features.visible, table, features.goal)
    experience = np.asarray(compile_encode()(blind_features, appearance, np.ones_like(layout_weights)))
    goal = features.goal.argmax(axis=-1)
    distance = np.abs(experience[:, None] - experience).max(axis=-1)
    np.testing.assert_array_equal(distance < 1e-5, goal[:, None] == goal)


def test_slots_begin_with_the_goal_where_detections_outnumber_tokens():
    spec = dataclasses.replace(SPEC, method_sizes=(*SPEC.method_sizes, ("tokens", 2)))
    features, _, _ = random_inputs()
    slots = Transformer(spec, nnx.Rngs(params=1))._slots(jax.tree.map(jnp.asarray, features))
    np.testing.assert_array_equal(slots[:, 0], features.goal)

    # Then comes the first other detection.
    first_detection = (features.visible * (1 - features.goal)).argmax(axis=-1)
    np.testing.assert_array_equal(slots[:, 1], np.eye(NUM_CATEGORIES)[first_detection])


# Queries


@pytest.mark.parametrize(("num_squares", "square_side"), [(5, 3), (7, 5), (1, 11), (11, 1)])
def test_view_squares_cover_the_view(num_squares, square_side):
    # 5 squares along 11 cells begin every 2 and are 11 - 4 x 2 = 3 wide; 7, the paper's, begin at every cell, 5 wide.
    cells = view_squares(11, num_squares)
    assert cells.shape == (num_squares**2, 2 * square_side**2)
    assert set(cells.ravel()) == set(range(2 * 11 * 11))


def test_view_squares_hold_free_cells_and_then_blocked_ones():
    # The second square of the second line: cells 2 to 4 along and across, in free cells and again in blocked ones.
    free_cells = [24, 25, 26, 35, 36, 37, 46, 47, 48]
    blocked_cells = [121 + cell for cell in free_cells]
    assert view_squares(11, 5)[6].tolist() == free_cells + blocked_cells


def test_position_codes_are_distinct():
    codes = position_codes(5, 32)
    distance = np.linalg.norm(codes[:, None] - codes, axis=-1)
    assert distance[~np.eye(25, dtype=bool)].min() > 0.3


@pytest.mark.slow
def test_intervention_keeps_the_queries_of_the_view():
    """The view asks within experience: do(scene=0, goal=0) leaves that, and its answer still depends on the view."""
    num_categories = len(CATEGORIES)
    spec = PolicySpec(find_method("vtnet"), num_categories, tiny.SIZES, tuple(SIZES.items()))
    weights = tiny.random_params(0, spec)
    rows = tiny.BANK.rows

    @jax.jit
    def decide_counterfactually(row):
        policy = bind(spec, weights)
        inputs = PolicyInputs(Observation(row, jnp.int32(0)), jnp.ones(num_categories))
        counterfactual = do(policy.pathways(inputs), scene=0.0, goal=0.0)
        memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(0))
        return counterfactual.experience, policy.decide(counterfactual, memory).logits

    # Most detections, as a single token would answer all queries alike; and the view that differs most.
    row_format = RowFormat(num_categories)
    detections_pose = int(row_format.presence(rows).sum(axis=-1).argmax())
    view_difference = row_format.view_cells(rows) != row_format.view_cells(rows[detections_pose])
    view_pose = int(view_difference.sum(axis=-1).argmax())
    num_detection_bytes = 4 * num_categories
    mixed_row = np.concatenate([rows[detections_pose, :num_detection_bytes], rows[view_pose, num_detection_bytes:]])

    experience, logits = decide_counterfactually(rows[detections_pose])
    mixed_experience, mixed_logits = decide_counterfactually(mixed_row)
    assert np.abs(experience - mixed_experience).max() > 1e-3
    assert np.abs(logits - mixed_logits).max() > 1e-4  # of equal experience they would be equal to the bit


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"token_width": 30}, r"method_sizes.token_width is 30.*multiple of 4 and of heads"),
        ({"heads": 3}, r"method_sizes.token_width is 32.*multiple of 4 and of heads \(3\)"),
        ({"queries": 12}, r"method_sizes.queries is 12.*at most 11"),
    ],
)
def test_transformer_refuses_impossible_sizes(sizes, message):
    spec = dataclasses.replace(SPEC, method_sizes=tuple(sizes.items()))
    with pytest.raises(InputError, match=message):
        Transformer(spec, nnx.Rngs(0))


# Imitation


def test_imitation_loss_is_the_cross_entropy_to_the_expert():
    logits = jnp.log(jnp.array([[1.0, 1, 1, 1, 1, 1], [3, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 3]]))
    loss, parts = imitation_loss(logits, jnp.array([2, 0, 6]))
    # log 6, log (8 / 3), and nothing from where there is no way; of the two others the likeliest is right in one.
    assert loss == pytest.approx((np.log(6) + np.log(8 / 3)) / 3, rel=1e-6)
    assert parts["imitation_agreement"] == pytest.approx(1 / 2)
    _, parts_without_way = imitation_loss(logits, jnp.array([6, 6, 6]))
    assert parts_without_way["imitation_agreement"] == 0


@pytest.mark.exhaustive
@pytest.mark.usefixtures("optimised")
def test_imitation_stage_learns_the_expert_and_changes_only_the_method():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("vtnet"), method_sizes=tuple(SIZES.items()))
    expert = jnp.asarray(tiny.BANK.expert)
    params = PARAMS.replace(tables=PARAMS.tables.replace(expert=expert))
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=2, learning_rate=3e-3)
    imitation_stage = find_method("vtnet").stages[0]
    learner = Learner(AgentLoop(ENV, spec, tiny.ESTIMATOR), config, "distil", imitation_stage)
    scalars = config.scalars(400)
    train = jax.jit(learner.train, static_argnums=4)

    # The loss falls and the agreement rises.
    first_state = jax.jit(learner.init)(jax.random.key(0), params, KNOWLEDGE)
    middle_state, first_metrics = train(first_state, scalars, params, KNOWLEDGE, 50)
    last_state, last_metrics = train(middle_state, scalars, params, KNOWLEDGE, 50)
    assert first_metrics["imitation_loss"] < np.log(6)
    assert last_metrics["imitation_loss"] < 0.9 * first_metrics["imitation_loss"]
    assert last_metrics["imitation_agreement"] > first_metrics["imitation_agreement"]

    # All parameters of the encoder change, and none outside the method.
    assert changed_parts(first_state.params, last_state.params) == {"method"}
    first_leaves = jax.tree.leaves(first_state.params["method"]["encoder"])
    last_leaves = jax.tree.leaves(last_state.params["method"]["encoder"])
    for first_leaf, last_leaf in zip(first_leaves, last_leaves, strict=True):
        assert (first_leaf != last_leaf).any()

    # Negative control: a random expert is not to be learned.
    random_expert = jax.random.randint(jax.random.key(1), expert.shape, 0, 6).astype(jnp.uint8)
    random_params = params.replace(tables=params.tables.replace(expert=random_expert))
    _, random_metrics = train(middle_state, scalars, random_params, KNOWLEDGE, 50)
    assert random_metrics["imitation_loss"] > 1.5 * last_metrics["imitation_loss"]
