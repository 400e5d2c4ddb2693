"""Rollouts equal a plain loop over single decisions, single updates of the belief and look-ups in the tables."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import (
    AGENT_LOOP,
    ENVS,
    KNOWLEDGE,
    LENGTH,
    PARAMS,
    SCENE,
    SLOTS,
    collect,
    record_rollout,
    replay_decisions,
    run_plain_loop,
    start_agents,
)

from jaxnav.scenes.task import DONE

#: With `mask_direct`, each step has no direct pathways with probability 1/2.
WITH_AND_WITHOUT_MASKS = pytest.mark.parametrize("mask_direct", [False, True])


@pytest.mark.slow
def test_the_recorded_rollout_contains_every_case():
    """The comparisons below need terminated and truncated episodes, both scenes, and masked direct pathways."""
    recorded = record_rollout(False)
    transitions = jax.tree.map(lambda leaf: leaf[:, :SLOTS], recorded.transitions)
    assert transitions.terminated.sum() > 4
    assert transitions.truncated.sum() > 5
    assert transitions.truncated[:-1].any()
    assert transitions.truncated[-1].any()
    assert (recorded.before.state.time > 0).any()
    assert len(np.unique(SCENE[transitions.pose])) == 2
    assert record_rollout(True).transitions.use_direct.mean() == pytest.approx(0.5, abs=0.2)
    assert transitions.use_direct is None


@pytest.mark.slow
@WITH_AND_WITHOUT_MASKS
def test_weights_values_and_probabilities_equal_those_of_a_plain_loop(mask_direct):
    transitions = record_rollout(mask_direct).transitions
    plain_loop = run_plain_loop(mask_direct)
    for name in ("layout_weights", "value", "log_prob"):
        result = getattr(transitions, name)[:, :SLOTS]
        np.testing.assert_allclose(result, getattr(plain_loop, name), rtol=1e-4, atol=1e-5, err_msg=name)


@WITH_AND_WITHOUT_MASKS
def test_next_value_is_that_of_the_cut_state_at_a_limit_and_zero_after_done(mask_direct):
    recorded = record_rollout(mask_direct)
    plain_loop = run_plain_loop(mask_direct)
    np.testing.assert_allclose(recorded.next_value[:, :SLOTS], plain_loop.next_value, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(recorded.next_value[recorded.transitions.terminated], 0)
    # The value of a cut state differs from the value at the start of the next episode.
    is_truncated = recorded.transitions.truncated[:-1]
    value_changes = recorded.next_value[:-1][is_truncated] - recorded.transitions.value[1:][is_truncated]
    assert np.abs(value_changes).max() > 0.01


@WITH_AND_WITHOUT_MASKS
def test_the_agent_after_the_rollout_equals_that_of_the_plain_loop(mask_direct):
    last_agent = record_rollout(mask_direct).after
    plain_loop = run_plain_loop(mask_direct)
    for slot in range(SLOTS):
        memory = tiny.leaves_at(last_agent.memory, slot)
        layout = tiny.leaves_at(last_agent.perception.layout, slot)
        chex.assert_trees_all_close(memory, plain_loop.memory[slot], rtol=1e-4, atol=1e-5)
        chex.assert_trees_all_close(layout, plain_loop.layout[slot], rtol=1e-5)


@WITH_AND_WITHOUT_MASKS
def test_replay_repeats_the_recorded_decisions(mask_direct):
    recorded = record_rollout(mask_direct)
    decisions, _ = replay_decisions(recorded.weights, recorded.transitions, recorded.memory)
    log_probs = np.asarray(jax.nn.log_softmax(decisions.logits))
    action_log_prob = np.take_along_axis(log_probs, recorded.transitions.action[..., None], axis=-1)
    np.testing.assert_allclose(action_log_prob[..., 0], recorded.transitions.log_prob, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(decisions.value, recorded.transitions.value, rtol=1e-4, atol=1e-5)


def test_rewards_and_lengths_follow_the_tables():
    transitions = record_rollout(False).transitions
    can_succeed = (tiny.BANK.best_length == 1)[transitions.pose, transitions.goal]
    np.testing.assert_array_equal(transitions.terminated, transitions.action == DONE)
    np.testing.assert_array_equal(transitions.success, transitions.terminated & can_succeed)
    expected_reward = np.where(transitions.success, np.float32(5), np.float32(-0.01))
    np.testing.assert_array_equal(transitions.reward, expected_reward)

    # A truncated episode has the length of its scene's step limit.
    truncated = transitions.truncated
    step_limits = np.array(tiny.STEP_LIMITS)[SCENE[transitions.pose]]
    np.testing.assert_array_equal(transitions.episode_length[truncated], step_limits[truncated])


def test_poses_are_stored_as_integers():
    transitions = record_rollout(False).transitions
    chex.assert_type([transitions.pose, transitions.goal, transitions.action, transitions.episode_length], jnp.int32)
    chex.assert_shape([transitions.pose, transitions.value, transitions.reward], (LENGTH, ENVS))


def test_an_episode_slot_is_truncated_at_most_once():
    """A rollout has the length of the shortest limit, and the agent never says Done."""
    weights = tiny.random_params(0)
    bias = weights["actor"]["bias"].at[DONE].set(-1e9)
    weights |= {"actor": weights["actor"] | {"bias": bias}}
    agent = start_agents(jax.random.key(0))
    truncations = []
    for i in range(4):
        agent, rollout = collect(weights, agent, jax.random.key(i), False)
        truncations.append(np.asarray(rollout.transitions.truncated))
        assert not rollout.transitions.terminated.any()

    # All episodes start together. A kitchen has a limit of 6 and is truncated once in each rollout of 6 steps; some
    # bedrooms, with a limit of 8, are not truncated in a rollout.
    truncations_per_slot = np.array(truncations).sum(axis=1)  # [4, B]
    assert truncations_per_slot.max() == 1
    assert truncations_per_slot.min() == 0


def test_equal_keys_give_equal_rollouts_and_other_keys_do_not():
    weights = tiny.random_params(0)
    agent = start_agents(jax.random.key(0))
    expected = collect(weights, agent, jax.random.key(5), False)
    chex.assert_trees_all_equal(collect(weights, agent, jax.random.key(5), False), expected)
    _, other_rollout = collect(weights, agent, jax.random.key(6), False)
    assert (other_rollout.transitions.action != expected[1].transitions.action).any()


def test_without_an_estimator_there_is_no_layout_and_its_weights_are_ones():
    agent_loop = dataclasses.replace(AGENT_LOOP, estimator_config=None)
    key = jax.random.key(0)

    def start_and_collect():
        return collect(tiny.random_params(0), start_agents(key, agent_loop), key, False, agent_loop)

    agent, rollout = jax.eval_shape(start_and_collect)
    assert agent.perception.layout is None
    assert rollout.transitions.layout_weights.shape == (LENGTH, ENVS, 3)
    layout_weights = agent_loop.policy_inputs(start_agents(key, agent_loop), KNOWLEDGE, PARAMS).layout_weights
    np.testing.assert_array_equal(layout_weights, np.ones((ENVS, 3)))
