"""Chunks, seeds side by side and poisoned rewards change nothing that they should not."""

import dataclasses
import functools
import os

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ACTING, CONFIG, KNOWLEDGE, LEARNER, PARAMS, act

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

#: Equal bits are promised of the programs that users get, see tests/conftest.py.
AS_FOR_USERS = {"xla_cpu_use_fusion_emitters": True} if "fusion_emitters" in os.environ.get("XLA_FLAGS", "") else None

init = jax.jit(LEARNER.init)
traces = []


@functools.partial(jax.jit, compiler_options=AS_FOR_USERS)
def one_update(states, scalars, params, knowledge):
    """A chunk of one update of several seeds, as in a run."""
    traces.append(1)
    return jax.lax.map(lambda state: LEARNER.train(state, scalars, params, knowledge, 1), states)


@functools.partial(jax.jit, compiler_options=AS_FOR_USERS)
def two_updates(state, scalars, params, knowledge):
    """A chunk of two updates of one seed."""
    traces.append(2)
    return LEARNER.train(state, scalars, params, knowledge, 2)


@pytest.fixture(scope="module")
def seeds():
    """Two seeds before their first update."""
    states = [init(jax.random.key(seed), PARAMS, KNOWLEDGE) for seed in range(2)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


@pytest.fixture(scope="module")
def first(seeds):
    """Both seeds after one update."""
    return one_update(seeds, SCALARS, PARAMS, KNOWLEDGE)


@pytest.fixture(scope="module")
def whole(seeds):
    """The first seed, alone, after two updates."""
    return two_updates(tiny.leaves_at(seeds, 0), SCALARS, PARAMS, KNOWLEDGE)


def assert_same(a, b):
    chex.assert_trees_all_equal(a.replace(key=jax.random.key_data(a.key)), b.replace(key=jax.random.key_data(b.key)))


def kernel(states):
    return np.asarray(states.params["fuse"]["kernel"])


@pytest.mark.exhaustive
def test_two_chunks_beside_another_seed_are_one_chunk_alone_bit_for_bit(first, whole):
    second = one_update(first[0], SCALARS, PARAMS, KNOWLEDGE)
    assert_same(tiny.leaves_at(second[0], 0), whole[0])
    assert whole[0].update == 2
    # Metrics of the whole are those of the parts: sums of episodes, means over updates, means over episodes.
    parts = [{name: float(value[0]) for name, value in metrics.items()} for _, metrics in (first, second)]
    logged = {name: float(value) for name, value in whole[1].items()}
    assert logged["episodes"] == sum(part["episodes"] for part in parts)
    for name in ("success", "return", "length", "truncated"):
        assert logged[name] * logged["episodes"] == pytest.approx(sum(part[name] * part["episodes"] for part in parts))
    for name in ("policy_loss", "entropy", "gradient_norm"):
        assert logged[name] == pytest.approx(sum(part[name] for part in parts) / 2)


@pytest.mark.slow
def test_the_best_policy_is_kept_and_a_later_one_among_equals(first):
    keep = jax.jit(LEARNER.keep_if_best)
    state = tiny.leaves_at(first[0], 0)
    assert state.best.score == -1.0
    chex.assert_trees_all_equal(state.best.params, init(jax.random.key(0), PARAMS, KNOWLEDGE).params)
    best = keep(state, jnp.float32(0.5))
    for score, update in ((0.4, 1), (0.5, 7), (0.6, 7)):
        later = keep(
            best.replace(update=jnp.int32(7), params=jax.tree.map(jnp.negative, best.params)), jnp.float32(score)
        )
        assert (float(later.best.score), int(later.best.update)) == (pytest.approx(max(score, 0.5)), update)
        chex.assert_trees_all_equal(later.best.params, later.params if update == 7 else best.params)
    # Nothing of training follows from what was kept.
    chex.assert_trees_all_equal(best.params, state.params)


def test_another_seed_gives_another_policy(first, seeds):
    for states in (seeds, first[0]):
        assert not np.array_equal(kernel(states)[0], kernel(states)[1])
    # So does another key of the updates alone.
    rekeyed = seeds.replace(key=seeds.key[::-1])
    assert not np.array_equal(kernel(one_update(rekeyed, SCALARS, PARAMS, KNOWLEDGE)[0])[0], kernel(first[0])[0])


def test_metrics_are_finite_numbers_of_every_seed(first):
    metrics = first[1]
    assert metrics.keys() == METRICS
    for name, values in metrics.items():
        assert values.shape == (2,), name
        assert values.dtype == jnp.float32, name
        assert np.isfinite(values).all(), name
    assert not metrics["skipped_steps"].any()
    assert (metrics["gradient_norm"] > 0).all()


def test_episode_statistics_are_those_of_the_episodes_that_ended(seeds, first):
    """Of one update, recounted from the rollout that it makes."""
    start = tiny.leaves_at(seeds, 0)
    key = jax.random.fold_in(jax.random.fold_in(start.key, start.update), 0)
    t = jax.tree.map(np.asarray, act(start.params, start.agent, key, False)[1].transitions)
    metrics = {name: float(value[0]) for name, value in first[1].items()}
    ended = t.terminated | t.truncated
    assert metrics["episodes"] == ended.sum() > 20
    # A successful episode's last action earns 5, every other one costs 0.01.
    returns = np.where(t.success, 5 + 0.01, 0) - 0.01 * t.episode_length
    for name, values in {
        "success": t.success,
        "length": t.episode_length,
        "truncated": t.truncated,
        "return": returns,
    }.items():
        assert metrics[name] == pytest.approx(values[ended].mean(), rel=1e-5), name


def test_no_episode_that_ends_counts_as_none(seeds):
    """After 6 steps none has reached a limit of 1000, and an actor that never says Done ends none either."""
    bias = seeds.params["actor"]["bias"].at[:, -1].set(-1e9)
    mute = seeds.replace(params=seeds.params | {"actor": seeds.params["actor"] | {"bias": bias}})
    _, metrics = one_update(mute, SCALARS, PARAMS.replace(step_limit=jnp.full(2, 1000, jnp.int32)), KNOWLEDGE)
    for name in ("episodes", "success", "return", "length", "truncated"):
        np.testing.assert_array_equal(metrics[name], [0, 0])


def test_chunks_and_other_scalars_do_not_trace_again(first):
    before = len(traces)
    states, _ = one_update(first[0], SCALARS, PARAMS, KNOWLEDGE)
    one_update(
        states, SCALARS.replace(learning_rate=jnp.float32(0.1), entropy_weight=jnp.float32(0.5)), PARAMS, KNOWLEDGE
    )
    one_update(states, SCALARS, PARAMS.replace(success_reward=jnp.float32(1)), Knowledge(2 * KNOWLEDGE.layout))
    assert len(traces) == before


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_gradients_that_are_not_finite_are_skipped_and_counted(seeds, poison):
    poisoned = PARAMS.replace(success_reward=jnp.float32(poison), step_reward=jnp.float32(poison))
    states, metrics = one_update(seeds, SCALARS, poisoned, KNOWLEDGE)
    np.testing.assert_array_equal(metrics["skipped_steps"], [8, 8])  # 4 epochs of 2 minibatches
    # Neither the parameters nor the moments have changed, so that learning goes on as if nothing had been.
    chex.assert_trees_all_equal(states.params, seeds.params)
    chex.assert_trees_all_equal(states.opt_state.inner_state, seeds.opt_state.inner_state)
    healed, metrics = one_update(states, SCALARS, PARAMS, KNOWLEDGE)
    np.testing.assert_array_equal(metrics["skipped_steps"], [0, 0])
    chex.assert_tree_all_finite(healed.params)
    assert not np.array_equal(kernel(healed), kernel(states))


def test_the_learning_rate_falls_to_zero(seeds):
    last = seeds.replace(update=jnp.full(2, UPDATES, jnp.int32))
    states, _ = one_update(last, SCALARS, PARAMS, KNOWLEDGE)
    chex.assert_trees_all_equal(states.params, seeds.params)


def test_minibatches_take_every_episode_once_and_one_of_every_block():
    """Six episodes in two minibatches: blocks 01, 23, 45; all leaves are cut alike."""
    order = assign_minibatches(jax.random.key(3), 6, 2)
    episodes = jnp.arange(6)
    steps = jnp.broadcast_to(10 * episodes, (4, 6))  # [T, B]
    parts, memory = split_minibatches(steps, order, axis=1), split_minibatches(episodes, order, axis=0)
    assert parts.shape == (2, 4, 3)
    np.testing.assert_array_equal(parts, np.broadcast_to(10 * memory[:, None], parts.shape))
    np.testing.assert_array_equal(np.sort(np.ravel(memory)), episodes)
    np.testing.assert_array_equal(memory // 2, [[0, 1, 2]] * 2)


def test_minibatches_differ_between_epochs():
    orders = {tuple(np.ravel(assign_minibatches(jax.random.key(i), 32, 4))) for i in range(8)}
    assert len(orders) == 8


@pytest.mark.slow
def test_a_method_without_experience_trains():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("rgb"))
    learner = dataclasses.replace(LEARNER, agent_loop=AgentLoop(ACTING.env, spec))
    before = learner.init(jax.random.key(0), PARAMS, KNOWLEDGE)
    after, metrics = jax.jit(learner.update)(before, SCALARS, PARAMS, KNOWLEDGE)
    chex.assert_tree_all_finite((after.params, metrics))
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).sum()), before.params, after.params)
    assert moved["view"]["kernel"] > 0.0
