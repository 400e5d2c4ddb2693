"""Adaptation by a learned loss, against gradient steps on whole kernels of one's own."""

import dataclasses
import functools
from typing import cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support import tiny_world as tiny

from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.policies.adaptation import (
    WINDOW,
    HasLearnedLoss,
    LearnedLoss,
    LearnedLossAdaptation,
    limit_inner_steps,
    replay_window,
)
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.network import bind
from jaxnav.policies.pathways import PolicyInputs, mask_experience
from jaxnav.scenes.task import NUM_ACTIONS

STEPS, RATE, K = 27, 0.05, tiny.SPEC.num_categories
FAST = ("fuse", "core", "actor")
SAVN = dataclasses.replace(tiny.SPEC, method=find_method("savn"), method_sizes=())
SPECS = {
    "savn": SAVN,
    "gated": dataclasses.replace(SAVN, done_gate=True),
    "streams": dataclasses.replace(SAVN, decision="streams", direct="goal"),
    "eotp": dataclasses.replace(SAVN, method=find_method("jaxnav.policies.methods.eotp:ADAPTED")),
}


def given(seed, *batch):
    """Observations and actions of 27 steps, leaves [27, *batch]: four windows and what follows them."""
    draws, shape = np.random.default_rng(seed), (STEPS, *batch)
    row = tiny.BANK.rows[draws.integers(0, len(tiny.BANK.rows), shape)]
    goal, action = draws.integers(0, K, shape), draws.integers(0, NUM_ACTIONS, shape)
    return Observation(jnp.asarray(row), jnp.asarray(goal)), jnp.asarray(action, jnp.int32)


def acted(spec, weights, adaptation, observation, action):
    """Logits and fast weights along given actions, leaves [27, *batch, ...]."""
    policy = bind(spec, weights)
    policy.adaptation = adaptation
    experienced = None if spec.decision == "fused" else jnp.ones(action.shape[1:])

    def step(memory, part):
        observation, action = part
        pathways = policy.pathways(PolicyInputs(observation, jnp.ones((*action.shape, K))), memory)
        decision = policy.decide(pathways, memory)
        return decision.next_state(action), (decision.logits, decision.fast)

    memory = policy.initial_memory(action.shape[1:])._replace(use_experience=experienced)
    return jax.lax.scan(step, memory, (observation, action))[1]


def acted_plainly(spec, weights, observation, action, order=2):
    """Logits [27, A] of one episode whose kernels take the steps themselves: the rule as SAVN's code has it.

    After each window the gradient of the learned loss by the kernels and biases that act is taken with the hidden
    state before the window and experience as they were. With `order` 1 it is no function of anything but the loss's
    parameters, with `order` 0 it is a constant.
    """
    fast, memory = weights, bind(spec, weights).initial_memory()
    window, logits = [], []
    for time in range(STEPS):
        policy = bind(spec, fast)
        seen = jax.tree.map(lambda leaf, time=time: leaf[time], observation)
        pathways = policy.pathways(PolicyInputs(seen, jnp.ones(K)), memory)
        window.append((pathways, memory))
        decision = policy.decide_with_changes(pathways, memory)
        logits.append(decision.logits)
        memory = decision.next_state(action[time])
        if len(window) == WINDOW and time < 4 * WINDOW:
            begin, held = fast, window
            if order < 2:
                begin, held = jax.lax.stop_gradient((begin, held))
            loss = functools.partial(judged, spec, held, weights["method"])
            gradient = jax.grad(loss)({name: begin[name] for name in FAST})
            gradient = jax.lax.stop_gradient(gradient) if order == 0 else gradient
            fast = fast | jax.tree.map(lambda w, g: w - RATE * g, {name: fast[name] for name in FAST}, gradient)
        window = window if len(window) < WINDOW else []
    return jnp.stack(logits)


def judged(spec, window, method, fast):
    """The learned loss of a window that is acted again; with streams the direct stream acts alone."""
    policy = bind(spec, tiny.random_params(0, spec) | fast | {"method": method})
    alone = None if spec.decision == "fused" else jnp.float32(0.0)
    hidden, rows = window[0][1].hidden, []
    for pathways, memory in window:
        decision = policy.decide_with_changes(mask_experience(pathways, alone), memory._replace(hidden=hidden))
        hidden = decision.hidden
        rows.append(jnp.concatenate([hidden[: policy.hidden], jax.nn.softmax(decision.logits)]))
    return cast(HasLearnedLoss, policy.method).learned_loss(jnp.stack(rows))


# The rule


@pytest.mark.slow
@pytest.mark.parametrize("name", SPECS)
def test_factors_are_steps_of_the_whole_kernels(name):
    """What is added up, of rank 24, is what autodiff takes from kernels of the episode's own."""
    spec, (observation, action) = SPECS[name], given(0)
    weights = tiny.random_params(0, spec)
    logits, fast = jax.jit(functools.partial(acted, spec, weights, LearnedLossAdaptation(learning_rate=RATE)))(
        observation, action
    )
    expected = jax.jit(functools.partial(acted_plainly, spec))(weights, observation, action)
    np.testing.assert_allclose(logits, expected, rtol=2e-4, atol=2e-4)
    plain = acted(spec, weights, None, observation, action)[0]
    np.testing.assert_allclose(logits[:WINDOW], plain[:WINDOW], rtol=1e-5, atol=1e-5)
    assert np.abs(logits - plain)[WINDOW:].max(axis=1).min() > 1e-4
    for factors in fast.layer_changes.values():
        assert (np.abs(factors.outputs[-1]).max(axis=-1) > 0).sum() == 4 * WINDOW  # the rank is at most 24


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_training_differentiates_through_the_steps(order):
    spec, (observation, action) = SAVN, given(1)
    weights = tiny.random_params(0, spec)
    adaptation = LearnedLossAdaptation(learning_rate=RATE, second_order=order == 2)
    mixture = jnp.asarray(np.random.default_rng(2).normal(size=(STEPS, NUM_ACTIONS)), jnp.float32)
    gradient = jax.jit(jax.grad(lambda w: (mixture * acted(spec, w, adaptation, observation, action)[0]).sum()))(
        weights
    )

    @functools.partial(jax.jit, static_argnums=1)
    def by_order(weights, order):
        return jax.grad(lambda w: (mixture * acted_plainly(spec, w, observation, action, order)).sum())(weights)

    scale = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(gradient))
    chex.assert_trees_all_close(gradient, by_order(weights, order), rtol=2e-3, atol=1e-4 * scale)
    of_loss = jax.tree.leaves(gradient["method"]["learned_loss"])
    assert max(np.abs(leaf).max() for leaf in of_loss) > 1e-3
    # Negative controls: the orders differ, and the plain switch teaches the loss nothing.
    other = by_order(weights, 3 - order)
    assert np.abs(other["fuse"]["kernel"] - gradient["fuse"]["kernel"]).max() > 1e-3 * scale
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(by_order(weights, 0)["method"]))


def test_the_loss_is_two_causal_convolutions_and_a_length():
    loss = LearnedLoss(nnx.Rngs(params=0))
    rows = np.random.default_rng(0).normal(size=(WINDOW, 9)).astype(np.float32)

    def convolve(entries, layer, distance):  # [C, L] by taps [2, C, D], the earlier one first
        taps = np.asarray(layer.kernel[...]).reshape(2, len(entries), -1)
        earlier = np.pad(entries, ((0, 0), (distance, 0)))[:, : entries.shape[1]]
        outputs = np.einsum("cl,cd->dl", earlier, taps[0]) + np.einsum("cl,cd->dl", entries, taps[1])
        outputs = outputs + np.asarray(layer.bias[...])[:, None]
        return np.where(outputs > 0, outputs, 0.01 * outputs)

    expected = np.linalg.norm(convolve(convolve(rows, loss.first, 1), loss.second, 2))
    np.testing.assert_allclose(loss(jnp.asarray(rows)), expected, rtol=1e-5)


# Episodes


@pytest.mark.slow
def test_an_episode_ignores_the_others():
    """Every episode of a batch adapts as it does alone."""
    observation, action = given(3, 16)
    weights, adaptation = tiny.random_params(0, SAVN), LearnedLossAdaptation(learning_rate=RATE)
    go = jax.jit(functools.partial(acted, SAVN, weights, adaptation))
    logits, _ = go(observation, action)
    other = jax.tree.map(lambda leaf: leaf.at[:, 5].set(leaf[:, 6]), (observation, action))
    changed, _ = go(*other)
    rest = np.arange(16) != 5
    np.testing.assert_array_equal(changed[:, rest], logits[:, rest])
    assert np.abs(changed[:, 5] - logits[:, 5]).max() > 0.1
    one, _ = go(*jax.tree.map(lambda leaf: leaf[:, 2], (observation, action)))
    np.testing.assert_allclose(one, logits[:, 2], rtol=1e-4, atol=1e-4)


def test_nothing_is_learned_before_a_window_is_full_nor_after_the_fourth():
    _, fast = jax.jit(
        functools.partial(acted, SAVN, tiny.random_params(0, SAVN), LearnedLossAdaptation(learning_rate=RATE))
    )(*given(4))
    changes = fast.layer_changes["hidden_gates"].outputs
    times = [time + 1 for time in range(STEPS) if np.any(changes[time] != (changes[time - 1] if time else 0.0))]
    assert times == [6, 12, 18, 24]


@pytest.mark.slow
def test_the_window_is_what_was_decided():
    """Deciding again along a window ends in what the agent decided and remembers."""
    policy, (observation, action) = bind(SAVN, tiny.random_params(0, SAVN)), given(5)

    def step(memory, part):
        decision = policy.decide(policy.pathways(PolicyInputs(part[0], jnp.ones(K))), memory)
        return decision.next_state(part[1]), (memory, decision)

    # The second window: after the first step, before the second.
    window = jax.tree.map(lambda leaf: leaf[: 2 * WINDOW], (observation, action))
    _, (before, decision) = jax.lax.scan(step, policy.initial_memory(), window)
    last, after = jax.tree.map(lambda leaf: leaf[-1], (before, decision))
    nothing = {layer: jnp.zeros_like(f.outputs[:WINDOW]) for layer, f in last.fast.layer_changes.items()}
    rows, inputs = replay_window(policy, after.fast._replace(layer_changes=last.fast.layer_changes), nothing)
    np.testing.assert_allclose(rows[:, : policy.hidden], decision.hidden[WINDOW:], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows[-1, policy.hidden :], jax.nn.softmax(after.logits), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(inputs["hidden_gates"], before.hidden[WINDOW:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", SPECS)
def test_fast_weights_can_be_stored(name):
    """Checkpoints hold no empty arrays, though experience may have no width."""
    spec = SPECS[name]
    memory = jax.eval_shape(lambda: bind(spec, tiny.random_params(0, spec)).initial_memory((3,)))
    assert all(leaf.size > 0 for leaf in jax.tree.leaves(memory.fast))


# Fewer steps


def test_fewer_steps_are_possible_and_more_are_refused():
    adaptation = METHODS["savn"].adaptation
    assert limit_inner_steps(adaptation, 0) is None
    assert limit_inner_steps(adaptation, 2) == LearnedLossAdaptation(inner_steps=2)
    for steps in (5, -1):
        with pytest.raises(
            InputError, match=rf"^inner_steps is {steps}; an episode remembers 4 windows of 6 actions: "
        ):
            limit_inner_steps(adaptation, steps)
    with pytest.raises(InputError, match=r"^inner_steps is 1; the method adapts in another way: give 0"):
        limit_inner_steps(METHODS["tpn"].adaptation, 1)
    with pytest.raises(
        InputError, match=r"^LearnedLossAdaptation: inner_steps is 0; give 1 or more, or no adaptation$"
    ):
        LearnedLossAdaptation(inner_steps=0)


@pytest.mark.slow
def test_fewer_steps_are_the_first_of_more():
    weights, (observation, action) = tiny.random_params(0, SAVN), given(6)
    two, _ = acted(SAVN, weights, LearnedLossAdaptation(inner_steps=2, learning_rate=RATE), observation, action)
    four, _ = acted(SAVN, weights, LearnedLossAdaptation(learning_rate=RATE), observation, action)
    none, fast = acted(SAVN, weights, limit_inner_steps(LearnedLossAdaptation(), 0), observation, action)
    assert fast is None
    np.testing.assert_allclose(two[: 3 * WINDOW], four[: 3 * WINDOW], rtol=1e-5, atol=1e-5)
    assert np.abs(two - four)[3 * WINDOW :].max() > 1e-3
    assert np.abs(none - four)[WINDOW:].max() > 1e-3
