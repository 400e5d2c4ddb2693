"""Updates do not depend on chunks or other seeds, report ended episodes, and skip gradients that are not finite.

Minibatches hold every episode once, and the best policy of a training is stored.
"""

import dataclasses
import functools
import os

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import AGENT_LOOP, CONFIG, KNOWLEDGE, LEARNER, PARAMS, collect

from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import find_method
from jaxnav.training.ppo import assign_minibatches, split_minibatches

UPDATES = 400
SCALARS = CONFIG.scalars(UPDATES)
METRICS = {
    "success", "return", "length", "truncated", "episodes", "skipped_steps",
    "policy_loss", "value_loss", "entropy", "distil_loss", "gradient_norm",
}  # fmt: skip

#: Compiler options of users' programs, because bit-identical results are promised for these; see tests/conftest.py.
USER_COMPILER_OPTIONS = None
if "fusion_emitters" in os.environ.get("XLA_FLAGS", ""):
    USER_COMPILER_OPTIONS = {"xla_cpu_use_fusion_emitters": True}

init_state = jax.jit(LEARNER.init)
#: Number of updates in each chunk that was traced.
traced_chunks = []


@functools.partial(jax.jit, compiler_options=USER_COMPILER_OPTIONS)
def train_one_update(states, scalars, params, knowledge):
    """Train a chunk of one update for several seeds, as in a run."""
    traced_chunks.append(1)
    return jax.lax.map(lambda state: LEARNER.train(state, scalars, params, knowledge, 1), states)


@functools.partial(jax.jit, compiler_options=USER_COMPILER_OPTIONS)
def train_two_updates(state, scalars, params, knowledge):
    """Train a chunk of two updates for one seed."""
    traced_chunks.append(2)
    return LEARNER.train(state, scalars, params, knowledge, 2)


@pytest.fixture(scope="module")
def initial_states():
    """States of two seeds before their first update."""
    states = [init_state(jax.random.key(seed), PARAMS, KNOWLEDGE) for seed in range(2)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


@pytest.fixture(scope="module")
def first_update(initial_states):
    """States and metrics of two seeds after one update."""
    return train_one_update(initial_states, SCALARS, PARAMS, KNOWLEDGE)


@pytest.fixture(scope="module")
def two_update_chunk(initial_states):
    """State and metrics of the first seed, trained without the second seed, after a chunk of two updates."""
    return train_two_updates(tiny.leaves_at(initial_states, 0), SCALARS, PARAMS, KNOWLEDGE)


def assert_states_equal(state, other_state):
    """Check that two states are equal, their keys included."""
    state = state.replace(key=jax.random.key_data(state.key))
    other_state = other_state.replace(key=jax.random.key_data(other_state.key))
    chex.assert_trees_all_equal(state, other_state)


def fuse_kernel(states):
    return np.asarray(states.params["fuse"]["kernel"])


@pytest.mark.exhaustive
def test_two_chunks_of_two_seeds_equal_one_chunk_of_a_single_seed_bit_for_bit(first_update, two_update_chunk):
    second_update = train_one_update(first_update[0], SCALARS, PARAMS, KNOWLEDGE)
    assert_states_equal(tiny.leaves_at(second_update[0], 0), two_update_chunk[0])
    assert two_update_chunk[0].update == 2

    # Metrics of the chunk of two updates follow from those of its updates: sums of episodes, means over episodes, and
    # means over updates.
    metrics_by_update = []
    for _, metrics in (first_update, second_update):
        metrics_by_update.append({name: float(value[0]) for name, value in metrics.items()})
    chunk_metrics = {name: float(value) for name, value in two_update_chunk[1].items()}
    assert chunk_metrics["episodes"] == sum(metrics["episodes"] for metrics in metrics_by_update)
    for name in ("success", "return", "length", "truncated"):
        expected_sum = sum(metrics[name] * metrics["episodes"] for metrics in metrics_by_update)
        assert chunk_metrics[name] * chunk_metrics["episodes"] == pytest.approx(expected_sum)
    for name in ("policy_loss", "entropy", "gradient_norm"):
        assert chunk_metrics[name] == pytest.approx(sum(metrics[name] for metrics in metrics_by_update) / 2)


@pytest.mark.slow
def test_the_best_policy_is_stored_and_the_later_of_two_equal_ones(first_update):
    keep_if_best = jax.jit(LEARNER.keep_if_best)
    state = tiny.leaves_at(first_update[0], 0)
    assert state.best.score == -1.0
    chex.assert_trees_all_equal(state.best.params, init_state(jax.random.key(0), PARAMS, KNOWLEDGE).params)

    # The policy of update 1 has a score of 0.5; a later policy replaces it unless its score is lower.
    best_state = keep_if_best(state, jnp.float32(0.5))
    later_params = jax.tree.map(jnp.negative, best_state.params)
    for score, expected_update in ((0.4, 1), (0.5, 7), (0.6, 7)):
        later_state = keep_if_best(best_state.replace(update=jnp.int32(7), params=later_params), jnp.float32(score))
        assert float(later_state.best.score) == pytest.approx(max(score, 0.5))
        assert int(later_state.best.update) == expected_update
        expected_params = later_state.params if expected_update == 7 else best_state.params
        chex.assert_trees_all_equal(later_state.best.params, expected_params)

    # Training is not affected by the stored policy.
    chex.assert_trees_all_equal(best_state.params, state.params)


def test_another_seed_gives_another_policy(first_update, initial_states):
    for states in (initial_states, first_update[0]):
        assert not np.array_equal(fuse_kernel(states)[0], fuse_kernel(states)[1])
    # Equal initial parameters with another key of the updates give another policy as well.
    rekeyed_states = initial_states.replace(key=initial_states.key[::-1])
    updated_states, _ = train_one_update(rekeyed_states, SCALARS, PARAMS, KNOWLEDGE)
    assert not np.array_equal(fuse_kernel(updated_states)[0], fuse_kernel(first_update[0])[0])


def test_metrics_are_finite_numbers_of_every_seed(first_update):
    metrics = first_update[1]
    assert metrics.keys() == METRICS
    for name, values in metrics.items():
        assert values.shape == (2,), name
        assert values.dtype == jnp.float32, name
        assert np.isfinite(values).all(), name
    assert not metrics["skipped_steps"].any()
    assert (metrics["gradient_norm"] > 0).all()


def test_episode_statistics_are_those_of_the_episodes_that_ended(initial_states, first_update):
    """The statistics of one update equal a recount over the rollout of this update."""
    state = tiny.leaves_at(initial_states, 0)
    rollout_key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), 0)
    transitions = jax.tree.map(np.asarray, collect(state.params, state.agent, rollout_key, False)[1].transitions)
    metrics = {name: float(value[0]) for name, value in first_update[1].items()}
    has_ended = transitions.terminated | transitions.truncated
    assert metrics["episodes"] == has_ended.sum() > 20

    # The last action of a successful episode earns 5; every other action costs 0.01.
    returns = np.where(transitions.success, 5 + 0.01, 0) - 0.01 * transitions.episode_length
    expected_values = {
        "success": transitions.success,
        "length": transitions.episode_length,
        "truncated": transitions.truncated,
        "return": returns,
    }
    for name, values in expected_values.items():
        assert metrics[name] == pytest.approx(values[has_ended].mean(), rel=1e-5), name


def test_statistics_are_zero_if_no_episode_ends(initial_states):
    """The limit of 1000 steps exceeds the 6 steps of a rollout, and the actor never says Done."""
    params = initial_states.params
    bias = params["actor"]["bias"].at[:, -1].set(-1e9)
    endless_states = initial_states.replace(params=params | {"actor": params["actor"] | {"bias": bias}})
    env_params = PARAMS.replace(step_limit=jnp.full(2, 1000, jnp.int32))
    _, metrics = train_one_update(endless_states, SCALARS, env_params, KNOWLEDGE)
    for name in ("episodes", "success", "return", "length", "truncated"):
        np.testing.assert_array_equal(metrics[name], [0, 0])


def test_later_chunks_and_other_scalars_do_not_trace_again(first_update):
    num_traces = len(traced_chunks)
    states, _ = train_one_update(first_update[0], SCALARS, PARAMS, KNOWLEDGE)
    other_scalars = SCALARS.replace(learning_rate=jnp.float32(0.1), entropy_weight=jnp.float32(0.5))
    train_one_update(states, other_scalars, PARAMS, KNOWLEDGE)
    other_params = PARAMS.replace(success_reward=jnp.float32(1))
    train_one_update(states, SCALARS, other_params, Knowledge(2 * KNOWLEDGE.priors))
    assert len(traced_chunks) == num_traces


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_gradients_that_are_not_finite_are_skipped_and_counted(initial_states, poison):
    poisoned_params = PARAMS.replace(success_reward=jnp.float32(poison), step_reward=jnp.float32(poison))
    states, metrics = train_one_update(initial_states, SCALARS, poisoned_params, KNOWLEDGE)
    np.testing.assert_array_equal(metrics["skipped_steps"], [8, 8])  # 4 epochs of 2 minibatches

    # Parameters and moments are unchanged, so learning continues as if the poisoned update had not happened.
    chex.assert_trees_all_equal(states.params, initial_states.params)
    chex.assert_trees_all_equal(states.opt_state.inner_state, initial_states.opt_state.inner_state)
    next_states, metrics = train_one_update(states, SCALARS, PARAMS, KNOWLEDGE)
    np.testing.assert_array_equal(metrics["skipped_steps"], [0, 0])
    chex.assert_tree_all_finite(next_states.params)
    assert not np.array_equal(fuse_kernel(next_states), fuse_kernel(states))


def test_the_learning_rate_falls_to_zero(initial_states):
    final_states = initial_states.replace(update=jnp.full(2, UPDATES, jnp.int32))
    states, _ = train_one_update(final_states, SCALARS, PARAMS, KNOWLEDGE)
    chex.assert_trees_all_equal(states.params, initial_states.params)


def test_minibatches_take_every_episode_once_and_one_of_every_block():
    """Six episodes in two minibatches form the blocks 01, 23, 45, and all leaves are divided alike."""
    order = assign_minibatches(jax.random.key(3), 6, 2)
    episodes = jnp.arange(6)
    steps = jnp.broadcast_to(10 * episodes, (4, 6))  # [T, B]
    step_minibatches = split_minibatches(steps, order, axis=1)
    episode_minibatches = split_minibatches(episodes, order, axis=0)
    assert step_minibatches.shape == (2, 4, 3)
    expected_steps = np.broadcast_to(10 * episode_minibatches[:, None], step_minibatches.shape)
    np.testing.assert_array_equal(step_minibatches, expected_steps)
    np.testing.assert_array_equal(np.sort(np.ravel(episode_minibatches)), episodes)
    np.testing.assert_array_equal(episode_minibatches // 2, [[0, 1, 2]] * 2)


def test_minibatches_differ_between_epochs():
    orders = {tuple(np.ravel(assign_minibatches(jax.random.key(epoch), 32, 4))) for epoch in range(8)}
    assert len(orders) == 8


@pytest.mark.slow
def test_a_method_without_experience_trains():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("rgb"))
    learner = dataclasses.replace(LEARNER, agent_loop=AgentLoop(AGENT_LOOP.env, spec))
    state = learner.init(jax.random.key(0), PARAMS, KNOWLEDGE)
    next_state, metrics = jax.jit(learner.update)(state, SCALARS, PARAMS, KNOWLEDGE)
    chex.assert_tree_all_finite((next_state.params, metrics))

    def total_change(leaf, next_leaf):
        return float(jnp.abs(leaf - next_leaf).sum())

    changes = jax.tree.map(total_change, state.params, next_state.params)
    assert changes["view"]["kernel"] > 0.0
