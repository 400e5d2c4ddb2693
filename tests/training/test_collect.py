"""Rollouts against a plain loop over single decisions, single updates of the belief and the tables."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import (
    ACTING,
    ENVS,
    KNOWLEDGE,
    LENGTH,
    PARAMS,
    SCENE,
    SLOTS,
    act,
    begin,
    decide_again,
    retrace,
    rolled,
)

from jaxnav.scenes.task import DONE

COIN = pytest.mark.parametrize("coin", [False, True])


@pytest.mark.slow
def test_the_rollout_holds_every_case():
    """Without which the comparisons below would say little."""
    run = rolled(False)
    t = jax.tree.map(lambda leaf: leaf[:, :SLOTS], run.transitions)
    assert t.terminated.sum() > 4
    assert t.truncated.sum() > 5
    assert t.truncated[:-1].any()
    assert t.truncated[-1].any()
    assert (run.before.state.time > 0).any()
    assert len(np.unique(SCENE[t.pose])) == 2
    assert rolled(True).transitions.use_direct.mean() == pytest.approx(0.5, abs=0.2)
    assert t.use_direct is None


@pytest.mark.slow
@COIN
def test_weights_values_and_probabilities_are_those_of_a_plain_loop(coin):
    stored, plain = rolled(coin).transitions, retrace(coin)
    for name in ("layout_weights", "value", "log_prob"):
        np.testing.assert_allclose(
            getattr(stored, name)[:, :SLOTS], getattr(plain, name), rtol=1e-4, atol=1e-5, err_msg=name
        )


@COIN
def test_returns_go_on_with_the_last_state_at_a_limit_and_with_nothing_after_done(coin):
    run, plain = rolled(coin), retrace(coin)
    np.testing.assert_allclose(run.next_value[:, :SLOTS], plain.next_value, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(run.next_value[run.transitions.terminated], 0)
    # The last state's value is not that of the episode that comes after.
    inside = run.transitions.truncated[:-1]
    assert np.abs(run.next_value[:-1][inside] - run.transitions.value[1:][inside]).max() > 0.01


@COIN
def test_the_agent_after_the_rollout_is_that_of_the_plain_loop(coin):
    after, plain = rolled(coin).after, retrace(coin)
    for slot in range(SLOTS):
        chex.assert_trees_all_close(tiny.leaves_at(after.memory, slot), plain.memory[slot], rtol=1e-4, atol=1e-5)
        chex.assert_trees_all_close(tiny.leaves_at(after.perception.layout, slot), plain.layout[slot], rtol=1e-5)


@COIN
def test_replay_gives_the_decisions_again(coin):
    run = rolled(coin)
    decisions, _ = decide_again(run.weights, run.transitions, run.memory)
    log_pi = np.asarray(jax.nn.log_softmax(decisions.logits))
    log_prob = np.take_along_axis(log_pi, run.transitions.action[..., None], axis=-1)
    np.testing.assert_allclose(log_prob[..., 0], run.transitions.log_prob, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(decisions.value, run.transitions.value, rtol=1e-4, atol=1e-5)


def test_rewards_and_lengths():
    t = rolled(False).transitions
    succeeds = (tiny.BANK.best_length == 1)[t.pose, t.goal]
    np.testing.assert_array_equal(t.terminated, t.action == DONE)
    np.testing.assert_array_equal(t.success, t.terminated & succeeds)
    np.testing.assert_array_equal(t.reward, np.where(t.success, np.float32(5), np.float32(-0.01)))
    np.testing.assert_array_equal(t.episode_length[t.truncated], np.array(tiny.STEP_LIMITS)[SCENE[t.pose]][t.truncated])


def test_poses_are_stored_as_integers():
    t = rolled(False).transitions
    chex.assert_type([t.pose, t.goal, t.action, t.episode_length], jnp.int32)
    chex.assert_shape([t.pose, t.value, t.reward], (LENGTH, ENVS))


def test_an_episode_slot_is_truncated_at_most_once():
    """A rollout as long as the shortest limit, by an agent that never says Done."""
    weights = tiny.random_params(0)
    bias = weights["actor"]["bias"].at[DONE].set(-1e9)
    weights |= {"actor": weights["actor"] | {"bias": bias}}
    agent, truncations = begin(jax.random.key(0)), []
    for i in range(4):
        agent, rollout = act(weights, agent, jax.random.key(i), False)
        truncations.append(np.asarray(rollout.transitions.truncated))
        assert not rollout.transitions.terminated.any()
    per_slot = np.array(truncations).sum(axis=1)  # [4, B]
    assert per_slot.max() == 1
    # All start together: kitchens, of limit 6, are truncated once in every rollout of 6; of the bedrooms' some are not.
    assert per_slot.min() == 0


def test_equal_keys_give_equal_rollouts_and_others_do_not():
    weights, agent = tiny.random_params(0), begin(jax.random.key(0))
    first = act(weights, agent, jax.random.key(5), False)
    chex.assert_trees_all_equal(act(weights, agent, jax.random.key(5), False), first)
    assert (act(weights, agent, jax.random.key(6), False)[1].transitions.action != first[1].transitions.action).any()


def test_without_a_setting_no_layout_is_carried_and_its_weights_are_ones():
    acting = dataclasses.replace(ACTING, estimator_config=None)
    key = jax.random.key(0)
    agent, rollout = jax.eval_shape(lambda: act(tiny.random_params(0), begin(key, acting), key, False, acting))
    assert agent.perception.layout is None
    assert rollout.transitions.layout_weights.shape == (LENGTH, ENVS, 3)
    weights = acting.policy_inputs(begin(key, acting), KNOWLEDGE, PARAMS).layout_weights
    np.testing.assert_array_equal(weights, np.ones((ENVS, 3)))
