"""Advantages by hand and in NumPy; the PPO loss in NumPy; which parameters the counterfactual branch's loss reaches."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import tiny_world as tiny
from support.rollouts import ACTING, ENVS, LENGTH, PARAMS, ROWS, decide_again, rolled

from jaxnav.policies.methods import METHODS
from jaxnav.policies.pathways import NO_ACTION, Pathways, PolicyState
from jaxnav.training.config import PPOConfig, PPOScalars
from jaxnav.training.ppo import compute_advantages, mask_direct_pathways, ppo_loss, replay_rollout

F = np.float32

# Advantages


def column(*values):
    return jnp.asarray(np.array(values)[:, None])


def test_advantages_by_hand():
    # Gamma = lambda = 1/2, so a delta counts a quarter one step earlier. Step 1 ends by Done: nothing follows. Step 3
    # is truncated at a state of value 4. Step 4 goes on with the state after the rollout, of value 6.
    value = column(F(1), F(2), F(1), F(1), F(2))
    reward = column(F(1), F(0), F(2), F(1), F(3))
    next_value = column(F(2), F(0), F(1), F(4), F(6))
    ended = column(False, True, False, True, False)
    # delta_4 = 3 + 6/2 - 2 = 4                      A_4 = 4
    # delta_3 = 1 + 4/2 - 1 = 2, the episode ends:   A_3 = 2
    # delta_2 = 2 + 1/2 - 1 = 1.5                    A_2 = 1.5 + 2/4 = 2
    # delta_1 = 0 + 0/2 - 2 = -2, it ends:           A_1 = -2
    # delta_0 = 1 + 2/2 - 1 = 1                      A_0 = 1 - 2/4 = 0.5
    result = compute_advantages(reward, value, next_value, ended, jnp.float32(0.5), jnp.float32(0.5))
    np.testing.assert_array_equal(result, column(0.5, -2.0, 2.0, 2.0, 4.0))


def test_advantages_of_a_macro_step_by_hand():
    """Choices at steps 0 and 2, gamma = lambda = 1/2; what stands for a value at step 1 does not matter.

    A_2 = delta_2 = 1 + 6/2 - 1 = 3. The macro-step of steps 0 and 1 has the reward 1 + 0/2 = 1 and the discount 1/4:
    delta_0 = 1 + 1/4 - 1 = 0.25 and A_0 = 0.25 + 1/4 1/2 3 = 0.625.
    """
    due, ended = column(True, False, True), column(False, False, False)
    reward, last = column(F(1), F(0), F(1)), F(6)
    for between in (F(2), F(-8)):
        value, next_value = column(F(1), between, F(1)), column(between, F(1), last)
        result = compute_advantages(reward, value, next_value, ended, jnp.float32(0.5), jnp.float32(0.5), due)
        np.testing.assert_array_equal(result[::2], column(0.625, 3.0))


@given(st.integers(0, 1000), st.floats(0, 1, width=32), st.floats(0, 1, width=32))
@pytest.mark.slow
def test_advantages_over_macro_steps_are_those_of_their_sums(seed, gamma, lambda_):
    """Generalised advantages of macro-steps, each with its discounted rewards and gamma to the power of its length."""
    reward, value, next_value, ended = random_steps(seed)
    due = np.random.default_rng(seed + 1).random(reward.shape) < 0.4
    due[0] = True
    due[1:] |= ended[:-1]  # an episode begins with a choice
    result = compute_advantages(
        *(jnp.asarray(x) for x in (reward, value, next_value, ended)), F(gamma), F(lambda_), due
    )
    for b in range(reward.shape[1]):
        starts = np.flatnonzero(due[:, b])
        advantage = 0.0
        for start, end in reversed(list(zip(starts, [*starts[1:], len(reward)], strict=True))):
            discounts = gamma ** np.arange(end - start)
            total = (discounts * reward[start:end, b]).sum() + gamma ** (end - start) * next_value[end - 1, b]
            carry = 0.0 if ended[end - 1, b] else gamma ** (end - start) * lambda_ * advantage
            advantage = total - value[start, b] + carry
            np.testing.assert_allclose(result[start, b], advantage, rtol=1e-3, atol=1e-4)


def random_steps(seed, length=7, envs=5):
    generator = np.random.default_rng(seed)
    reward, value, last = generator.normal(size=(3, length, envs)).astype(F)
    terminated, truncated = generator.random((2, length, envs)) < 0.2
    truncated &= ~terminated
    next_value = np.concatenate([value[1:], generator.normal(size=(1, envs)).astype(F)])
    next_value = np.where(truncated, last, np.where(terminated, F(0), next_value))
    return reward, value, next_value, terminated | truncated


@given(st.integers(0, 1000), st.floats(0, 1, width=32), st.floats(0, 1, width=32))
def test_advantages_in_numpy(seed, gamma, lambda_):
    reward, value, next_value, ended = random_steps(seed)
    expected = np.zeros_like(reward)
    for b in range(reward.shape[1]):
        advantage = 0.0
        for t in reversed(range(len(reward))):
            delta = reward[t, b] + gamma * next_value[t, b] - value[t, b]
            advantage = delta if ended[t, b] else delta + gamma * lambda_ * advantage
            expected[t, b] = advantage
    result = jax.jit(compute_advantages)(reward, value, next_value, ended, F(gamma), F(lambda_))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


@given(st.integers(0, 1000), st.floats(0, 1, width=32))
def test_at_lambda_one_the_advantage_is_the_discounted_return_minus_the_value(seed, gamma):
    reward, value, next_value, ended = random_steps(seed)
    length, envs = reward.shape
    expected = np.zeros_like(reward)
    for b in range(envs):
        for t in range(length):
            # The rewards up to the end of the episode or of the rollout, then what follows there.
            last = next((i for i in range(t, length) if ended[i, b]), length - 1)
            rewards = sum(gamma ** (i - t) * reward[i, b] for i in range(t, last + 1))
            expected[t, b] = rewards + gamma ** (last + 1 - t) * next_value[last, b] - value[t, b]
    result = jax.jit(compute_advantages)(reward, value, next_value, ended, F(gamma), F(1))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


# The PPO loss

# Another policy than the one that acted.
NEW = jax.tree.map(lambda a, b: a + 0.2 * b, tiny.random_params(0), tiny.random_params(1))


def scalars(**changes) -> PPOScalars:
    return PPOConfig(clip=0.1, entropy=0.03, value=0.7, distil=0.4).scalars(1).replace(**changes)


@functools.partial(jax.jit, static_argnums=3)
def loss(weights, advantage, scalars, distil):
    run = rolled(True)
    replayed = replay_rollout(ACTING.bind(weights), run.transitions, run.memory, PARAMS)
    return ppo_loss(replayed, advantage, scalars, distil, METHODS["org"])


def some_advantage():
    return np.random.default_rng(0).normal(1.0, 2.0, (LENGTH, ENVS)).astype(F)


def log_softmax(logits):
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def loss_in_numpy(decisions, counterfactual, transitions, advantage):
    """The clipped loss of Schulman et al. (2017), sample by sample, and KL(pi || counterfactual)."""
    mean, std = advantage.mean(dtype=np.float64), advantage.std(dtype=np.float64)
    policy_loss, value_loss, entropy, divergence, clipped = 0.0, 0.0, 0.0, 0.0, 0
    for t, b in np.ndindex(advantage.shape):
        log_pi = log_softmax(np.float64(decisions.logits[t, b]))
        ratio = np.exp(log_pi[transitions.action[t, b]] - transitions.log_prob[t, b])
        scaled = (advantage[t, b] - mean) / std
        policy_loss -= min(ratio * scaled, np.clip(ratio, 0.9, 1.1) * scaled)
        clipped += np.clip(ratio, 0.9, 1.1) * scaled < ratio * scaled
        value_loss += (decisions.value[t, b] - (advantage[t, b] + transitions.value[t, b])) ** 2 / 2
        entropy -= (np.exp(log_pi) * log_pi).sum()
        divergence += (np.exp(log_pi) * (log_pi - log_softmax(np.float64(counterfactual.logits[t, b])))).sum()
    assert 0.1 < clipped / advantage.size < 0.9  # both branches count
    parts = np.array([policy_loss, value_loss, entropy, divergence]) / advantage.size
    return dict(zip(("policy_loss", "value_loss", "entropy", "distil_loss"), parts, strict=True))


@pytest.mark.parametrize("distil", [False, True])
def test_the_loss_is_that_of_numpy(distil):
    run, advantage = rolled(True), some_advantage()
    factual, counterfactual = jax.tree.map(np.asarray, decide_again(NEW, run.transitions, run.memory))
    expected = loss_in_numpy(factual, counterfactual, run.transitions, advantage)
    total = expected["policy_loss"] + 0.7 * expected["value_loss"] - 0.03 * expected["entropy"]
    if distil:
        total += 0.4 * expected["distil_loss"]
    else:
        del expected["distil_loss"]
    result, parts = loss(NEW, advantage, scalars(), distil)
    assert parts.keys() == expected.keys()
    for name, value in expected.items():
        assert parts[name] == pytest.approx(value, rel=1e-4), name
        assert abs(value) > 1e-3, name
    assert result == pytest.approx(total, rel=1e-4)


def test_with_the_policy_that_acted_nothing_is_clipped():
    # All ratios are 1, so the policy loss is minus the mean of the scaled advantages: 0.
    _, parts = loss(rolled(True).weights, some_advantage(), scalars(), False)
    assert parts["policy_loss"] == pytest.approx(0, abs=1e-5)


def test_a_term_of_the_method_is_added():
    run, named = rolled(True), {"told": jnp.float32(3)}
    method = dataclasses.replace(METHODS["org"], auxiliary=lambda _: (jnp.float32(0.25), named))
    replayed = replay_rollout(ACTING.bind(NEW), run.transitions, run.memory, PARAMS)
    without, parts = loss(NEW, some_advantage(), scalars(), False)
    total, more = ppo_loss(replayed, jnp.asarray(some_advantage()), scalars(), False, method)
    assert total == pytest.approx(float(without) + 0.25, rel=1e-5)
    assert more.keys() - parts.keys() == {"told"}


# The counterfactual branch

DISTIL_ONLY = {
    "entropy_weight": jnp.float32(0),
    "value_weight": jnp.float32(0),
    "distil_weight": jnp.float32(1),
}


def test_distillation_reaches_only_what_the_counterfactual_branch_uses():
    # Advantages of zero: the policy loss has no gradient either.
    gradient = jax.jit(jax.grad(lambda w: loss(w, jnp.zeros((LENGTH, ENVS)), scalars(**DISTIL_ONLY), True)[0]))(NEW)
    largest = {name: max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient[name])) for name in NEW}
    reached = {name for name, value in largest.items() if value > 0}
    assert reached == {"appearance", "method", "fuse", "core", "actor"}
    assert {"view", "detections", "sought", "critic"} == NEW.keys() - reached


def test_distillation_moves_towards_a_fixed_target_along_a_fixed_memory():
    """Its gradient is that of the divergence from numbers: neither the factual logits nor the memories have a part."""
    run = rolled(True)
    t, slot = run.transitions, 1
    rows, log_pi, memories = ROWS[t.pose[:, slot]], [], []
    memory = tiny.leaves_at(run.memory, slot)
    for time in range(LENGTH):
        now = tiny.leaves_at(t, time, slot)
        memories.append(memory)
        decision = tiny.decide(NEW, rows[time], now.goal, now.layout_weights, memory)[0 if now.use_direct else 1]
        log_pi.append(log_softmax(np.asarray(decision.logits)))
        memory = decision.next_state(now.action)
        if now.terminated | now.truncated:
            memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
    target, memories = np.array(log_pi), jax.tree.map(lambda *leaves: np.array(leaves), *memories)

    def divergence(weights):
        given = (rows, t.goal[:, slot], t.layout_weights[:, slot], memories)
        counterfactual = jax.vmap(functools.partial(tiny.decide, weights))(*given)[1]
        return (np.exp(target) * (target - jax.nn.log_softmax(counterfactual.logits))).sum(axis=-1).mean()

    def distil_loss(weights):
        one = jax.tree.map(lambda leaf: leaf[:, [slot]], t)
        memory = jax.tree.map(lambda leaf: leaf[[slot]], run.memory)
        nothing = jnp.zeros((LENGTH, 1))
        replayed = replay_rollout(ACTING.bind(weights), one, memory, PARAMS)
        return ppo_loss(replayed, nothing, scalars(**DISTIL_ONLY), True, METHODS["org"])[0]

    assert t.use_direct[:, slot].any()
    assert not t.use_direct[:, slot].all()
    (expected, wanted), (result, gradient) = (jax.jit(jax.value_and_grad(f))(NEW) for f in (divergence, distil_loss))
    assert float(expected) > 0.01
    assert result == pytest.approx(float(expected), rel=1e-4)
    chex.assert_trees_all_close(gradient, wanted, rtol=1e-3, atol=1e-5)


def test_the_coin_zeroes_both_direct_pathways_and_nothing_else():
    fields = {"scene": (3, 1.0), "goal": (4, 2.0), "experience": (5, 3.0), "gate": (1, 4.0)}
    pathways = Pathways(**{name: jnp.full((2, width), value) for name, (width, value) in fields.items()})
    unmasked, zeroed = (tiny.leaves_at(mask_direct_pathways(pathways, jnp.array([True, False])), i) for i in range(2))
    chex.assert_trees_all_equal(unmasked, tiny.leaves_at(pathways, 0))
    chex.assert_trees_all_equal(zeroed, Pathways(jnp.zeros(3), jnp.zeros(4), jnp.full(5, 3.0), jnp.full(1, 4.0)))
