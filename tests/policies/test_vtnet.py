"""VTNet: tokens are a set, queries are places in view, and training begins with imitation of shortest paths."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS
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

K, BATCH, AHEAD, RIGHT, GOAL = 7, 16, 2, 3, 8
SIZES = {"token_width": 16, "feedforward": 16, "query_outputs": 4}
SPEC = PolicySpec(find_method("vtnet"), K, tiny.SIZES, tuple(SIZES.items()))


@functools.cache
def transformer(tokens=10, kind=Transformer):
    """The compiled `encode` with random parameters, whose number does not depend on that of tokens."""
    spec = dataclasses.replace(SPEC, method_sizes=(*SPEC.method_sizes, ("tokens", tokens)))
    graph, params = nnx.split(kind(spec, nnx.Rngs(params=1)))
    return jax.jit(lambda seen, appearance, weights: nnx.merge(graph, params).encode(seen, appearance, weights, None))


def features(*leaves):
    """Features of NumPy arrays, which their types do not name."""
    return Features(*leaves)


def given(seed=0):
    """What is seen and sought, at least two detections beside the goal's; appearance and weights of categories."""
    draws = np.random.default_rng(seed)
    goal = np.eye(K, dtype=np.float32)[draws.integers(0, K, BATCH)]
    visible = (draws.random((BATCH, K)) < 0.5).astype(np.float32)
    for scene in range(BATCH):
        visible[scene, draws.choice(np.flatnonzero(goal[scene] == 0), 2, replace=False)] = 1.0
    table = draws.normal(size=(BATCH, K, 9)).astype(np.float32) * visible[..., None]
    table[..., 0], table[..., GOAL] = visible, goal
    view = draws.integers(0, 2, (BATCH, 2 * 11 * 11)).astype(np.float32)
    appearance = draws.normal(size=(K, tiny.SIZES.appearance)).astype(np.float32)
    weights = draws.uniform(0.1, 1.0, (BATCH, K)).astype(np.float32)
    return features(view, visible, table, goal), appearance, weights


# Tokens


def test_tokens_are_a_set():
    seen, appearance, weights = given()
    before = transformer()(seen, appearance, weights)
    order = np.random.default_rng(1).permutation(K)
    moved = features(seen.view, seen.visible[:, order], seen.table[:, order], seen.goal[:, order])
    after = transformer()(moved, appearance[order], weights[:, order])
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-6)
    assert np.std(before, axis=0).max() > 0.1
    # Negative control: what stands where is not the same set of tokens.
    assert np.abs(transformer()(moved, appearance, weights[:, order]) - before).max() > 0.05


def test_two_categories_that_exchange_their_places_are_other_tokens():
    seen, appearance, weights = given()
    table = seen.table.copy()
    for scene in range(BATCH):
        pair = np.flatnonzero(seen.visible[scene] * (1 - seen.goal[scene]))[:2]
        table[scene, pair, AHEAD : RIGHT + 1] = table[scene, pair[::-1], AHEAD : RIGHT + 1]
    change = transformer()(seen._replace(table=table), appearance, weights) - transformer()(seen, appearance, weights)
    assert (np.abs(change).max(axis=-1) > 1e-3).all()


def test_what_is_neither_detected_nor_sought_has_no_influence():
    seen, appearance, weights = given()
    absent = (seen.visible + seen.goal) == 0
    assert absent.any(axis=-1).sum() > BATCH / 2
    table, other = seen.table.copy(), weights.copy()
    table[absent], other[absent] = 9.0, 5.0
    before = transformer()(seen, appearance, weights)
    np.testing.assert_array_equal(transformer()(seen._replace(table=table), appearance, other), before)
    # Negative control: the same to what is detected does matter, and so do the weights alone.
    other = np.where(seen.visible > 0, 5.0, weights).astype(np.float32)
    assert (np.abs(transformer()(seen, appearance, other) - before).max(axis=-1) > 1e-3).all()


def test_tokens_that_stand_for_nothing_are_masked():
    seen, appearance, weights = given()
    assert (seen.visible + seen.goal > 0).sum(axis=-1).min() < K
    few, many = (transformer(tokens)(seen, appearance, weights) for tokens in (K, 3 * K))
    np.testing.assert_allclose(few, many, rtol=1e-5, atol=1e-6)


def test_without_attention_all_places_get_the_same_answer():
    """Nothing tells them apart: their places are in the scores alone."""
    answers, attended = (
        np.asarray(transformer(kind=kind)(*given())).reshape(BATCH, -1, SIZES["query_outputs"])
        for kind in (UniformTransformer, Transformer)
    )
    np.testing.assert_allclose(answers, np.broadcast_to(answers[:, :1], answers.shape), rtol=1e-5, atol=1e-6)
    assert np.std(answers, axis=0).max() > 0.01
    assert (np.std(attended, axis=1).max(axis=-1) > 1e-3).all()


def test_what_is_sought_is_known_where_nothing_is_detected():
    seen, appearance, weights = given()
    nothing, certain = np.zeros_like(seen.visible), np.ones_like(weights)
    table = np.zeros_like(seen.table)
    table[..., GOAL] = seen.goal
    blind = np.asarray(transformer()(features(0 * seen.view, nothing, table, seen.goal), appearance, certain))
    sought = seen.goal.argmax(axis=-1)
    for one in range(BATCH):
        same = np.abs(blind - blind[one]).max(axis=-1) < 1e-5
        np.testing.assert_array_equal(same, sought == sought[one])


def test_more_detections_than_tokens_leave_the_goals_in():
    few = dataclasses.replace(SPEC, method_sizes=(*SPEC.method_sizes, ("tokens", 2)))
    graph, params = nnx.split(Transformer(few, nnx.Rngs(params=1)))
    seen, *_ = given()
    slots = nnx.merge(graph, params)._slots(jax.tree.map(jnp.asarray, seen))
    np.testing.assert_array_equal(slots[:, 0], seen.goal)
    first = [np.flatnonzero(visible * (1 - goal))[0] for visible, goal in zip(seen.visible, seen.goal, strict=True)]
    np.testing.assert_array_equal(slots[:, 1], np.eye(K)[first])


# Queries


def test_squares_cover_the_view():
    # 5 squares along 11 cells begin every 2 and are 11 - 4 x 2 = 3 wide; 7, the paper's, begin at every cell, 5 wide.
    for side, wide in ((5, 3), (7, 5), (1, 11), (11, 1)):
        cells = view_squares(11, side)
        assert cells.shape == (side**2, 2 * wide**2)
        assert set(cells.ravel()) == set(range(2 * 11 * 11))
    # The second square of the second line: cells 2 to 4 along and across, in free cells and again in blocked ones.
    free = [24, 25, 26, 35, 36, 37, 46, 47, 48]
    assert view_squares(11, 5)[6].tolist() == [*free, *(121 + cell for cell in free)]


def test_every_place_has_a_code_of_its_own():
    code = position_codes(5, 32)
    apart = np.linalg.norm(code[:, None] - code, axis=-1)
    assert apart[~np.eye(25, dtype=bool)].min() > 0.3


def test_queries_stay_under_an_intervention():
    """The view asks within experience: do(scene=0, goal=0) leaves that, and its answer still depends on the view."""
    spec = PolicySpec(find_method("vtnet"), len(CATEGORIES), tiny.SIZES, tuple(SIZES.items()))
    weights, rows, detections = tiny.random_params(0, spec), tiny.BANK.rows, 4 * len(CATEGORIES)

    @jax.jit
    def counterfactual(row):
        policy = bind(spec, weights)
        pathways = policy.pathways(PolicyInputs(Observation(row, jnp.int32(0)), jnp.ones(len(CATEGORIES))))
        removed = do(pathways, scene=0.0, goal=0.0)
        memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(0))
        return removed.experience, policy.decide(removed, memory).logits

    row_format = RowFormat(len(CATEGORIES))
    one_pose = int(row_format.presence(rows).sum(axis=-1).argmax())  # a single token would answer all queries alike
    other_pose = int((row_format.view_cells(rows) != row_format.view_cells(rows[one_pose])).sum(axis=-1).argmax())
    mixed = np.concatenate([rows[one_pose, :detections], rows[other_pose, detections:]])  # seen from here, lying there
    (one, logits), (other, others) = counterfactual(rows[one_pose]), counterfactual(mixed)
    assert np.abs(one - other).max() > 1e-3
    assert np.abs(logits - others).max() > 1e-4  # of equal experience they would be equal to the bit


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"token_width": 30}, "method_sizes.token_width is 30; give a multiple of 4 and of heads"),
        ({"heads": 3}, r"method_sizes.token_width is 32; give a multiple of 4 and of heads \(3\)"),
        ({"queries": 12}, "method_sizes.queries is 12; give at most 11"),
    ],
)
def test_impossible_sizes_are_refused(sizes, message):
    with pytest.raises(InputError, match=message):
        Transformer(dataclasses.replace(SPEC, method_sizes=tuple(sizes.items())), nnx.Rngs(0))


# Imitation


def test_the_loss_is_the_cross_entropy_to_the_expert():
    logits = jnp.log(jnp.array([[1.0, 1, 1, 1, 1, 1], [3, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 3]]))
    loss, parts = imitation_loss(logits, jnp.array([2, 0, 6]))
    # log 6, log (8 / 3), and nothing from where there is no way; the likeliest is right in the second alone.
    assert loss == pytest.approx((np.log(6) + np.log(8 / 3)) / 3, rel=1e-6)
    assert parts["imitation_agreement"] == pytest.approx(1 / 3)


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_imitation_lowers_its_loss_and_leaves_the_policy_as_it_is():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("vtnet"), method_sizes=tuple(SIZES.items()))
    expert = jnp.asarray(tiny.BANK.expert)
    params = PARAMS.replace(tables=PARAMS.tables.replace(expert=expert))
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=2, learning_rate=3e-3)
    learner = Learner(AgentLoop(ENV, spec, tiny.ESTIMATOR), config, "distil", find_method("vtnet").stages[0])
    before = jax.jit(learner.init)(jax.random.key(0), params, KNOWLEDGE)
    state, first = jax.jit(learner.train, static_argnums=4)(before, config.scalars(400), params, KNOWLEDGE, 50)
    after, last = jax.jit(learner.train, static_argnums=4)(state, config.scalars(400), params, KNOWLEDGE, 50)
    assert first["imitation_loss"] < np.log(6)
    assert last["imitation_loss"] < 0.9 * first["imitation_loss"]
    assert last["imitation_agreement"] > first["imitation_agreement"]
    for name, part in before.params.items():
        if name != "method":
            chex.assert_trees_all_equal(after.params[name], part)
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before.params["method"], after.params["method"])
    assert all(jax.tree.leaves(moved["encoder"]))
    # Negative control: an expert that does anything is not to be learned.
    anything = jax.random.randint(jax.random.key(1), expert.shape, 0, 6).astype(jnp.uint8)
    false = params.replace(tables=params.tables.replace(expert=anything))
    _, control = jax.jit(learner.train, static_argnums=4)(state, config.scalars(400), false, KNOWLEDGE, 50)
    assert control["imitation_loss"] > 1.5 * last["imitation_loss"]
