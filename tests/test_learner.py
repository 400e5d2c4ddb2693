"""PPO learns; chunks, seeds and poisoned rewards change nothing that they should not."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from test_rollout import ACTING, ENV, ENVS, LENGTH, PARAMS, PRIORS, act

from jaxnav.training.config import PPOConfig
from jaxnav.training.learner import Learner

CONFIG = PPOConfig(
    num_envs=ENVS, rollout=LENGTH, epochs=2, minibatches=2, learning_rate=5e-3, gamma=0.95, gae_lambda=0.9, entropy=0.01
)
LEARNER = Learner(acting=ACTING, spec=tiny.SPEC, config=CONFIG, counterfactual="distil")
UPDATES = 600
SCALARS = CONFIG.scalars(UPDATES * ENVS * LENGTH)
METRICS = {
    "success", "return", "length", "truncated", "episodes", "skipped_updates",
    "policy_loss", "value_loss", "entropy", "distil_loss", "gradient_norm",
}  # fmt: skip

init = jax.jit(LEARNER.init)
traces = []


@functools.partial(jax.jit, static_argnums=4)
def train(state, scalars, params, priors, num_updates):
    traces.append(num_updates)
    return LEARNER.train(state, scalars, params, priors, num_updates)


@pytest.fixture(scope="module")
def start():
    return init(jax.random.key(0), PARAMS, PRIORS)


@pytest.fixture(scope="module")
def two(start):
    """Two updates in one chunk."""
    return train(start, SCALARS, PARAMS, PRIORS, 2)


def assert_same(a, b):
    chex.assert_trees_all_equal(a.replace(key=jax.random.key_data(a.key)), b.replace(key=jax.random.key_data(b.key)))


def test_two_chunks_are_one_bit_for_bit(start, two):
    once, first = train(start, SCALARS, PARAMS, PRIORS, 1)
    twice, second = train(once, SCALARS, PARAMS, PRIORS, 1)
    assert_same(twice, two[0])
    assert twice.update == 2
    # Metrics of the whole are those of the parts: sums of episodes, means over updates, means over episodes.
    assert first["episodes"] + second["episodes"] == two[1]["episodes"]
    assert (first["entropy"] + second["entropy"]) / 2 == pytest.approx(float(two[1]["entropy"]), rel=1e-5)
    lengths = first["length"] * first["episodes"] + second["length"] * second["episodes"]
    assert lengths / two[1]["episodes"] == pytest.approx(float(two[1]["length"]), rel=1e-5)


def test_another_key_gives_another_policy(start, two):
    other, _ = train(start.replace(key=jax.random.key(9)), SCALARS, PARAMS, PRIORS, 2)
    assert not np.array_equal(other.params["fuse"]["kernel"], two[0].params["fuse"]["kernel"])


def test_seeds_side_by_side_are_seeds_alone(start):
    keys = jax.vmap(jax.random.key)(jnp.arange(3))

    @jax.jit
    def seeds(keys, scalars, params, priors):
        states = jax.lax.map(lambda key: LEARNER.init(key, params, priors), keys)
        return jax.lax.map(lambda state: LEARNER.train(state, scalars, params, priors, 1), states)

    states, metrics = seeds(keys, SCALARS, PARAMS, PRIORS)
    alone, own = train(start, SCALARS, PARAMS, PRIORS, 1)
    assert_same(tiny.at(states, 0), alone)
    chex.assert_trees_all_equal(tiny.at(metrics, 0), own)
    assert not np.array_equal(states.params["fuse"]["kernel"][0], states.params["fuse"]["kernel"][1])


def test_metrics_are_finite_scalars(two):
    _, metrics = two
    assert metrics.keys() == METRICS
    for name, value in metrics.items():
        assert value.shape == (), name
        assert value.dtype == jnp.float32, name
        assert np.isfinite(value), name
    assert metrics["skipped_updates"] == 0
    assert 1 <= metrics["length"] <= max(tiny.LIMITS)
    assert 0 < metrics["success"] + metrics["truncated"] < 1


def test_episode_statistics_are_those_of_the_episodes_that_ended(start):
    """Of one update, recounted from the rollout that it makes."""
    key = jax.random.fold_in(jax.random.fold_in(start.key, start.update), 0)
    t = act(start.params, start.agent, key, False)[1]
    _, metrics = train(start, SCALARS, PARAMS, PRIORS, 1)
    ended = np.asarray(t.terminated | t.truncated)
    # A successful episode's last action earns 5, every other one costs 0.01.
    returns = np.where(t.success, 5 + 0.01, 0) - 0.01 * np.asarray(t.length)
    assert int(metrics["episodes"]) == ended.sum() > 20
    for name, values in {"success": t.success, "length": t.length, "truncated": t.truncated, "return": returns}.items():
        assert metrics[name] == pytest.approx(np.asarray(values)[ended].mean(), rel=1e-5), name


def test_chunks_and_other_scalars_do_not_trace_again(start, two):
    state, _ = train(start, SCALARS, PARAMS, PRIORS, 1)
    before = len(traces)
    state, _ = train(state, SCALARS, PARAMS, PRIORS, 1)
    train(state, SCALARS.replace(learning_rate=jnp.float32(0.1), entropy=jnp.float32(0.5)), PARAMS, PRIORS, 1)
    train(state, SCALARS, PARAMS.replace(success_reward=jnp.float32(1)), PRIORS, 1)
    assert len(traces) == before


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_gradients_that_are_not_finite_are_skipped_and_counted(start, poison):
    poisoned = PARAMS.replace(success_reward=jnp.float32(poison), step_reward=jnp.float32(poison))
    state, metrics = train(start, SCALARS, poisoned, PRIORS, 1)
    chex.assert_trees_all_equal(state.params, start.params)
    # All of an update's steps: 2 epochs of 2 minibatches.
    assert metrics["skipped_updates"] == 4
    # The moments are as they were as well, so that learning goes on as if nothing had been.
    chex.assert_trees_all_equal(state.optimizer.inner_state, start.optimizer.inner_state)
    healed, metrics = train(state, SCALARS, PARAMS, PRIORS, 1)
    assert metrics["skipped_updates"] == 0
    chex.assert_tree_all_finite(healed.params)
    assert not np.array_equal(healed.params["fuse"]["kernel"], state.params["fuse"]["kernel"])


def test_ppo_learns(start):
    """A random policy soon says Done, and is right by chance; a trained one finds most goals."""
    state, success = start, []
    for _ in range(UPDATES // 2):
        state, metrics = train(state, SCALARS, PARAMS, PRIORS, 2)
        success.append(float(metrics["success"]))
    print(np.array(success)[::25])
    assert np.mean(success[:10]) < 0.5
    assert np.mean(success[-10:]) > 0.85
