"""Advantages by hand and in NumPy; the PPO loss in NumPy; which parameters the counterfactual branch's loss reaches."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import tiny_world as tiny
from support.rollouts import AGENT_LOOP, ENVS, LENGTH, PARAMS, ROWS, changed_parts, record_rollout, replay_decisions

from jaxnav.policies.methods import METHODS
from jaxnav.policies.pathways import NO_ACTION, Pathways, PolicyState
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import PPOScalars, compute_advantages, mask_direct_pathways, ppo_loss, replay_rollout

FRACTIONS = st.floats(0, 1, width=32)
SEEDS = st.integers(0, 1000)

# Advantages


def column(*values):
    """Values over time of one environment, [T, 1]."""
    return jnp.asarray(np.array(values)[:, None])


def float_column(*values):
    return jnp.asarray(np.array(values, np.float32)[:, None])


HALF = jnp.float32(0.5)


def test_compute_advantages_follows_worked_arithmetic():
    # Gamma = lambda = 1/2, so a delta counts a quarter one step earlier. Step 1 ends by Done: nothing follows. Step 3
    # is truncated at a state of value 4. Step 4 goes on with the state after the rollout, of value 6.
    value = float_column(1, 2, 1, 1, 2)
    reward = float_column(1, 0, 2, 1, 3)
    next_value = float_column(2, 0, 1, 4, 6)
    ended = column(False, True, False, True, False)
    # delta_4 = 3 + 6/2 - 2 = 4                      A_4 = 4
    # delta_3 = 1 + 4/2 - 1 = 2, the episode ends:   A_3 = 2
    # delta_2 = 2 + 1/2 - 1 = 1.5                    A_2 = 1.5 + 2/4 = 2
    # delta_1 = 0 + 0/2 - 2 = -2, it ends:           A_1 = -2
    # delta_0 = 1 + 2/2 - 1 = 1                      A_0 = 1 - 2/4 = 0.5
    advantage = compute_advantages(reward, value, next_value, ended, HALF, HALF)
    np.testing.assert_array_equal(advantage, column(0.5, -2.0, 2.0, 2.0, 4.0))


@pytest.mark.parametrize("ignored_value", [2, -8])
def test_compute_advantages_of_a_macro_step_follows_worked_arithmetic(ignored_value):
    """Choices at steps 0 and 2, gamma = lambda = 1/2; what stands for a value at step 1 does not matter.

    A_2 = delta_2 = 1 + 6/2 - 1 = 3. The macro-step of steps 0 and 1 has the reward 1 + 0/2 = 1 and the discount 1/4:
    delta_0 = 1 + 1/4 - 1 = 0.25 and A_0 = 0.25 + 1/4 1/2 3 = 0.625.
    """
    is_decision_step = column(True, False, True)
    ended = column(False, False, False)
    reward = float_column(1, 0, 1)
    value = float_column(1, ignored_value, 1)
    next_value = float_column(ignored_value, 1, 6)
    advantage = compute_advantages(reward, value, next_value, ended, HALF, HALF, is_decision_step)
    np.testing.assert_array_equal(advantage[::2], column(0.625, 3.0))


class RandomSteps(NamedTuple):
    """Steps of environments, leaves [T, B]: float32 rewards and values, bool endings."""

    reward: np.ndarray
    value: np.ndarray
    next_value: np.ndarray
    ended: np.ndarray


def random_steps(seed, num_steps=7, num_envs=5):
    rng = np.random.default_rng(seed)
    reward, value, truncated_value = rng.normal(size=(3, num_steps, num_envs)).astype(np.float32)
    terminated, truncated = rng.random((2, num_steps, num_envs)) < 0.2
    truncated &= ~terminated
    last_value = rng.normal(size=(1, num_envs)).astype(np.float32)
    next_value = np.concatenate([value[1:], last_value])
    next_value = np.where(terminated, np.float32(0), next_value)
    next_value = np.where(truncated, truncated_value, next_value)
    return RandomSteps(reward, value, next_value, terminated | truncated)


@given(SEEDS, FRACTIONS, FRACTIONS)
@pytest.mark.slow
def test_compute_advantages_of_macro_steps_equals_gae_of_their_sums(seed, gamma, gae_lambda):
    """Generalised advantages of macro-steps, each with its discounted rewards and gamma to the power of its length."""
    steps = random_steps(seed)
    num_steps, num_envs = steps.reward.shape
    is_decision_step = np.random.default_rng(seed + 1).random(steps.reward.shape) < 0.4
    is_decision_step[0] = True
    is_decision_step[1:] |= steps.ended[:-1]  # an episode begins with a choice
    result = compute_advantages(
        jnp.asarray(steps.reward),
        jnp.asarray(steps.value),
        jnp.asarray(steps.next_value),
        jnp.asarray(steps.ended),
        jnp.float32(gamma),
        jnp.float32(gae_lambda),
        jnp.asarray(is_decision_step),
    )

    # Each macro-step from the last to the first.
    for env_index in range(num_envs):
        reward, value, next_value, ended = (leaf[:, env_index] for leaf in steps)
        starts = np.flatnonzero(is_decision_step[:, env_index]).tolist()
        macro_steps = list(zip(starts, [*starts[1:], num_steps], strict=True))
        advantage = 0.0
        for start, end in reversed(macro_steps):
            macro_gamma = gamma ** (end - start)
            macro_reward = (gamma ** np.arange(end - start) * reward[start:end]).sum()
            delta = macro_reward + macro_gamma * next_value[end - 1] - value[start]
            continuation = 0.0 if ended[end - 1] else macro_gamma * gae_lambda * advantage
            advantage = delta + continuation
            np.testing.assert_allclose(result[start, env_index], advantage, rtol=1e-3, atol=1e-4)


@given(SEEDS, FRACTIONS, FRACTIONS)
def test_compute_advantages_equals_gae_in_numpy(seed, gamma, gae_lambda):
    steps = random_steps(seed)
    expected = np.zeros_like(steps.reward)
    for env_index in range(expected.shape[1]):
        reward, value, next_value, ended = (leaf[:, env_index] for leaf in steps)
        advantage = 0.0
        for time in reversed(range(len(reward))):
            delta = reward[time] + gamma * next_value[time] - value[time]
            advantage = delta if ended[time] else delta + gamma * gae_lambda * advantage
            expected[time, env_index] = advantage
    result = jax.jit(compute_advantages)(*steps, np.float32(gamma), np.float32(gae_lambda))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


@given(SEEDS, FRACTIONS)
def test_compute_advantages_at_lambda_one_gives_return_minus_value(seed, gamma):
    steps = random_steps(seed)
    num_steps, num_envs = steps.reward.shape
    expected = np.zeros_like(steps.reward)
    for time, env_index in np.ndindex(num_steps, num_envs):
        reward, value, next_value, ended = (leaf[:, env_index] for leaf in steps)
        # The rewards up to the end of the episode or of the rollout, then the value of the next state.
        later_ends = time + np.flatnonzero(ended[time:])
        last_time = later_ends[0] if len(later_ends) else num_steps - 1
        discounts = gamma ** np.arange(last_time + 1 - time)
        discounted_return = (discounts * reward[time : last_time + 1]).sum()
        discounted_return += gamma ** (last_time + 1 - time) * next_value[last_time]
        expected[time, env_index] = discounted_return - value[time]
    result = jax.jit(compute_advantages)(*steps, np.float32(gamma), np.float32(1))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


# The PPO loss

#: Another policy than the one that acted.
NEW_WEIGHTS = jax.tree.map(lambda weight, change: weight + 0.2 * change, tiny.random_params(0), tiny.random_params(1))
RANDOM_ADVANTAGE = np.random.default_rng(0).normal(1.0, 2.0, (LENGTH, ENVS)).astype(np.float32)


def make_scalars(**changes) -> PPOScalars:
    return PPOConfig(clip=0.1, entropy=0.03, value=0.7, distil=0.4).scalars(1).replace(**changes)


@functools.partial(jax.jit, static_argnums=3)
def loss_on_rollout(weights, advantage, scalars, distil):
    run = record_rollout(True)
    replayed = replay_rollout(AGENT_LOOP.bind(weights), run.transitions, run.memory, PARAMS)
    return ppo_loss(replayed, advantage, scalars, distil, METHODS["org"])


def log_softmax(logits):
    shifted_logits = logits - logits.max(axis=-1, keepdims=True)
    return shifted_logits - np.log(np.exp(shifted_logits).sum(axis=-1, keepdims=True))


def loss_parts_in_numpy(factual, counterfactual, transitions, advantage):
    """The clipped loss of Schulman et al. (2017), sample by sample, and KL(pi || counterfactual)."""
    scaled_advantages = (advantage - advantage.mean(dtype=np.float64)) / advantage.std(dtype=np.float64)
    parts = {"policy_loss": 0.0, "value_loss": 0.0, "entropy": 0.0, "distil_loss": 0.0}
    num_clipped = 0
    for time, env_index in np.ndindex(advantage.shape):
        step = tiny.leaves_at(transitions, time, env_index)
        scaled_advantage = scaled_advantages[time, env_index]
        log_probs = log_softmax(np.float64(factual.logits[time, env_index]))
        counterfactual_log_probs = log_softmax(np.float64(counterfactual.logits[time, env_index]))
        probs = np.exp(log_probs)

        # The smaller one of the plain and the clipped objective.
        ratio = np.exp(log_probs[step.action] - step.log_prob)
        plain_objective = ratio * scaled_advantage
        clipped_objective = np.clip(ratio, 0.9, 1.1) * scaled_advantage
        parts["policy_loss"] -= min(plain_objective, clipped_objective)
        num_clipped += clipped_objective < plain_objective

        value_target = advantage[time, env_index] + step.value
        parts["value_loss"] += (factual.value[time, env_index] - value_target) ** 2 / 2
        parts["entropy"] -= (probs * log_probs).sum()
        parts["distil_loss"] += (probs * (log_probs - counterfactual_log_probs)).sum()
    assert 0.1 < num_clipped / advantage.size < 0.9  # both branches count
    return {name: part / advantage.size for name, part in parts.items()}


@pytest.mark.slow
@pytest.mark.parametrize("distil", [False, True])
def test_ppo_loss_equals_the_clipped_loss_in_numpy(distil):
    run = record_rollout(True)
    decisions = replay_decisions(NEW_WEIGHTS, run.transitions, run.memory)
    factual, counterfactual = jax.tree.map(np.asarray, decisions)
    expected_parts = loss_parts_in_numpy(factual, counterfactual, run.transitions, RANDOM_ADVANTAGE)
    expected_total = (
        expected_parts["policy_loss"] + 0.7 * expected_parts["value_loss"] - 0.03 * expected_parts["entropy"]
    )
    if distil:
        expected_total += 0.4 * expected_parts["distil_loss"]
    else:
        del expected_parts["distil_loss"]

    total, parts = loss_on_rollout(NEW_WEIGHTS, RANDOM_ADVANTAGE, make_scalars(), distil)
    assert parts.keys() == expected_parts.keys()
    for name, expected_part in expected_parts.items():
        assert parts[name] == pytest.approx(expected_part, rel=1e-4), name
        assert abs(expected_part) > 1e-3, name
    assert total == pytest.approx(expected_total, rel=1e-4)


def test_policy_loss_of_the_acting_policy_is_zero():
    # All ratios are 1, so the policy loss is minus the mean of the scaled advantages: 0.
    _, parts = loss_on_rollout(record_rollout(True).weights, RANDOM_ADVANTAGE, make_scalars(), False)
    assert parts["policy_loss"] == pytest.approx(0, abs=1e-5)


# The counterfactual branch

DISTIL_ONLY = {
    "entropy_weight": jnp.float32(0),
    "value_weight": jnp.float32(0),
    "distil_weight": jnp.float32(1),
}


@pytest.mark.slow
def test_distillation_gradient_reaches_only_the_counterfactual_branch():
    # Advantages of zero: the policy loss has no gradient either.
    no_advantage = jnp.zeros((LENGTH, ENVS))

    @jax.jit
    @jax.grad
    def compute_gradient(weights):
        total, _ = loss_on_rollout(weights, no_advantage, make_scalars(**DISTIL_ONLY), True)
        return total

    gradient = compute_gradient(NEW_WEIGHTS)
    reached_parts = changed_parts(jax.tree.map(jnp.zeros_like, gradient), gradient)
    assert reached_parts == {"appearance", "method", "fuse", "core", "actor"}
    assert {"view", "detections", "sought", "critic"} == NEW_WEIGHTS.keys() - reached_parts


@pytest.mark.slow
def test_distillation_gradient_is_that_of_kl_to_a_fixed_target_with_fixed_memories():
    """Neither the factual logits nor the memories have a part in the gradient."""
    run = record_rollout(True)
    slot = 1
    transitions = tiny.leaves_at(run.transitions, slice(None), slot)
    rows = ROWS[transitions.pose]
    assert transitions.use_direct.any()
    assert not transitions.use_direct.all()

    # The target and the memories along the recorded actions, as numbers.
    target_log_probs = []
    memories = []
    memory = tiny.leaves_at(run.memory, slot)
    for time in range(LENGTH):
        step = tiny.leaves_at(transitions, time)
        memories.append(memory)
        factual, counterfactual = tiny.decide(NEW_WEIGHTS, rows[time], step.goal, step.layout_weights, memory)
        decision = factual if step.use_direct else counterfactual
        target_log_probs.append(log_softmax(np.asarray(decision.logits)))
        memory = decision.next_state(step.action)
        if step.terminated | step.truncated:
            memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
    target = np.array(target_log_probs)
    stacked_memories = jax.tree.map(lambda *leaves: np.array(leaves), *memories)

    def divergence(weights):
        decide_steps = jax.vmap(functools.partial(tiny.decide, weights))
        _, counterfactual = decide_steps(rows, transitions.goal, transitions.layout_weights, stacked_memories)
        log_ratio = target - jax.nn.log_softmax(counterfactual.logits)
        return (np.exp(target) * log_ratio).sum(axis=-1).mean()

    def distil_loss(weights):
        slot_transitions = jax.tree.map(lambda leaf: leaf[:, None], transitions)
        slot_memory = jax.tree.map(lambda leaf: leaf[[slot]], run.memory)
        replayed = replay_rollout(AGENT_LOOP.bind(weights), slot_transitions, slot_memory, PARAMS)
        total, _ = ppo_loss(replayed, jnp.zeros((LENGTH, 1)), make_scalars(**DISTIL_ONLY), True, METHODS["org"])
        return total

    expected_loss, expected_gradient = jax.jit(jax.value_and_grad(divergence))(NEW_WEIGHTS)
    loss, gradient = jax.jit(jax.value_and_grad(distil_loss))(NEW_WEIGHTS)
    assert float(expected_loss) > 0.01
    assert loss == pytest.approx(float(expected_loss), rel=1e-4)
    chex.assert_trees_all_close(gradient, expected_gradient, rtol=1e-3, atol=1e-5)


def test_mask_direct_pathways_zeroes_scene_and_goal_alone():
    pathways = Pathways(
        scene=jnp.full((2, 3), 1.0),
        goal=jnp.full((2, 4), 2.0),
        experience=jnp.full((2, 5), 3.0),
        gate=jnp.full((2, 1), 4.0),
    )
    masked_pathways = mask_direct_pathways(pathways, jnp.array([True, False]))
    expected_masked = Pathways(jnp.zeros(3), jnp.zeros(4), jnp.full(5, 3.0), jnp.full(1, 4.0))
    chex.assert_trees_all_equal(tiny.leaves_at(masked_pathways, 0), tiny.leaves_at(pathways, 0))
    chex.assert_trees_all_equal(tiny.leaves_at(masked_pathways, 1), expected_masked)
