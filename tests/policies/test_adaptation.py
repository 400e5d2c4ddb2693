"""Adaptation by a learned loss equals gradient steps on the full kernels of each episode."""

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
    zero_output_changes,
)
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.network import bind
from jaxnav.policies.pathways import PolicyInputs, mask_experience
from jaxnav.scenes.task import NUM_ACTIONS

#: Four windows of six steps and what follows them.
NUM_STEPS = 27
LEARNING_RATE = 0.05
NUM_CATEGORIES = tiny.SPEC.num_categories
FAST_LAYERS = ("fuse", "core", "actor")
SAVN = dataclasses.replace(tiny.SPEC, method=find_method("savn"), method_sizes=())
SPECS = {
    "savn": SAVN,
    "gated": dataclasses.replace(SAVN, done_gate=True),
    "streams": dataclasses.replace(SAVN, decision="streams", direct="goal"),
    "eotp": dataclasses.replace(SAVN, method=find_method("jaxnav.policies.methods.eotp:ADAPTED")),
}


def random_episode(seed, *batch_shape):
    """Observations and actions of 27 steps, leaves [27, *batch_shape, ...]."""
    rng = np.random.default_rng(seed)
    shape = (NUM_STEPS, *batch_shape)
    row = tiny.BANK.rows[rng.integers(0, len(tiny.BANK.rows), shape)]
    goal = rng.integers(0, NUM_CATEGORIES, shape)
    action = rng.integers(0, NUM_ACTIONS, shape)
    return Observation(jnp.asarray(row), jnp.asarray(goal)), jnp.asarray(action, jnp.int32)


def run_package(spec, weights, adaptation, observation, action, cut=0):
    """Logits and fast weights of the package along given actions, leaves [27, *batch_shape, ...].

    Gradients only reach the decisions from `cut` on, as in a rollout that begins there.
    """
    policy = bind(spec, weights)
    policy.adaptation = adaptation
    batch_shape = action.shape[1:]
    layout_weights = jnp.ones((*batch_shape, NUM_CATEGORIES))

    def step(memory, observation_and_action):
        observation, action = observation_and_action
        pathways = policy.pathways(PolicyInputs(observation, layout_weights), memory)
        decision = policy.decide(pathways, memory)
        return decision.next_state(action), (decision.logits, decision.fast)

    use_experience = None if spec.decision == "fused" else jnp.ones(batch_shape)
    memory = policy.initial_memory(batch_shape)._replace(use_experience=use_experience)
    before, after = (tiny.leaves_at((observation, action), part) for part in (slice(cut), slice(cut, None)))
    memory, earlier_outputs = jax.lax.stop_gradient(jax.lax.scan(step, memory, before))
    _, outputs = jax.lax.scan(step, memory, after)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), earlier_outputs, outputs)


def run_reference(spec, weights, observation, action, order=2, cut=0):
    """Logits [27, A] of one episode by the rule of SAVN's code.

    After each of the first four windows, every kernel of this episode takes one gradient step of the learned loss,
    computed by autodiff, along the recorded pathways and from the hidden state before the window. `order` 2: the step
    is differentiated through everything. `order` 1: only through the parameters of the learned loss. `order` 0: the
    step is a constant. State from before `cut` is a constant: the changes of the kernels, the memory and the inputs of
    the window.
    """
    fast_weights = weights
    memory = bind(spec, weights).initial_memory()
    window = []
    logits = []
    for time in range(len(action)):
        if time == cut:
            change = jax.tree.map(jnp.subtract, fast_weights, weights)
            fast_weights = jax.tree.map(jnp.add, weights, jax.lax.stop_gradient(change))
            memory, window, logits = jax.lax.stop_gradient((memory, window, logits))

        # Act with the present kernels.
        policy = bind(spec, fast_weights)
        step_observation = tiny.leaves_at(observation, time)
        pathways = policy.pathways(PolicyInputs(step_observation, jnp.ones(NUM_CATEGORIES)), memory)
        window.append((pathways, memory))
        decision = policy.decide_with_changes(pathways, memory)
        logits.append(decision.logits)
        memory = decision.next_state(action[time])
        if len(window) < WINDOW:
            continue

        # Take a step at the end of each of the first four windows.
        if time < 4 * WINDOW:
            fast_weights = descend(spec, fast_weights, weights["method"], window, order)
        window = []
    return jnp.stack(logits)


def descend(spec, fast_weights, method_weights, window, order):
    """The parameters after one gradient step of the learned loss on a window."""
    start_weights, loss_window = fast_weights, window
    if order < 2:
        start_weights, loss_window = jax.lax.stop_gradient((fast_weights, window))
    loss = functools.partial(window_loss, spec, loss_window, method_weights)
    gradient = jax.grad(loss)({name: start_weights[name] for name in FAST_LAYERS})
    if order == 0:
        gradient = jax.lax.stop_gradient(gradient)
    layers = {name: fast_weights[name] for name in FAST_LAYERS}
    return fast_weights | jax.tree.map(lambda weight, slope: weight - LEARNING_RATE * slope, layers, gradient)


def window_loss(spec, window, method_weights, fast_layers):
    """The learned loss of a window that is acted again; with streams the direct stream acts alone."""
    policy = bind(spec, tiny.random_params(0, spec) | fast_layers | {"method": method_weights})
    use_experience = None if spec.decision == "fused" else jnp.float32(0.0)
    _, first_memory = window[0]
    hidden = first_memory.hidden
    rows = []
    for pathways, memory in window:
        masked_pathways = mask_experience(pathways, use_experience)
        decision = policy.decide_with_changes(masked_pathways, memory._replace(hidden=hidden))
        hidden = decision.hidden
        direct_hidden = hidden[: policy.hidden_width]
        probs = jax.nn.softmax(policy.action_logits(direct_hidden, pathways.gate))
        rows.append(jnp.concatenate([direct_hidden, probs]))
    return cast(HasLearnedLoss, policy.experience).learned_loss(jnp.stack(rows))


# The rule


@pytest.mark.exhaustive
@pytest.mark.parametrize("spec_name", SPECS)
def test_adaptation_by_factors_equals_gradient_steps_on_whole_kernels(spec_name):
    """The sum of factors, of rank 24, is the change that autodiff makes to the full kernels of the episode."""
    spec = SPECS[spec_name]
    observation, action = random_episode(0)
    weights = tiny.random_params(0, spec)
    adaptation = LearnedLossAdaptation(learning_rate=LEARNING_RATE)
    run_adapted = jax.jit(functools.partial(run_package, spec, weights, adaptation))
    logits, fast = run_adapted(observation, action)
    expected = jax.jit(functools.partial(run_reference, spec))(weights, observation, action)
    np.testing.assert_allclose(logits, expected, rtol=2e-4, atol=2e-4)

    # Adaptation changes every step after the first window, and none in it.
    plain_logits, _ = run_package(spec, weights, None, observation, action)
    np.testing.assert_allclose(logits[:WINDOW], plain_logits[:WINDOW], rtol=1e-5, atol=1e-5)
    assert np.abs(logits - plain_logits)[WINDOW:].max(axis=1).min() > 1e-4

    # The rank is at most 24.
    for factors in fast.layer_changes.values():
        is_factor_used = np.abs(factors.outputs[-1]).max(axis=-1) > 0
        assert is_factor_used.sum() == 4 * WINDOW


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [1, 2])
def test_training_gradient_of_adaptation_has_the_configured_order(order):
    observation, action = random_episode(1)
    weights = tiny.random_params(0, SAVN)
    adaptation = LearnedLossAdaptation(learning_rate=LEARNING_RATE, second_order=order == 2)
    logit_weights = jnp.asarray(np.random.default_rng(2).normal(size=(NUM_STEPS, NUM_ACTIONS)), jnp.float32)

    def package_loss(weights):
        logits, _ = run_package(SAVN, weights, adaptation, observation, action)
        return (logit_weights * logits).sum()

    def reference_loss(weights, order):
        return (logit_weights * run_reference(SAVN, weights, observation, action, order)).sum()

    gradient = jax.jit(jax.grad(package_loss))(weights)
    reference_gradient = jax.jit(jax.grad(reference_loss), static_argnums=1)
    scale = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(gradient))
    chex.assert_trees_all_close(gradient, reference_gradient(weights, order), rtol=2e-3, atol=1e-4 * scale)

    # The parameters of the learned loss have a gradient.
    loss_gradients = jax.tree.leaves(gradient["method"]["learned_loss"])
    assert max(np.abs(leaf).max() for leaf in loss_gradients) > 1e-3

    # Negative controls: the orders differ, and a constant step teaches the loss nothing.
    other_gradient = reference_gradient(weights, 3 - order)
    assert np.abs(other_gradient["fuse"]["kernel"] - gradient["fuse"]["kernel"]).max() > 1e-3 * scale
    for leaf in jax.tree.leaves(reference_gradient(weights, 0)["method"]):
        assert not np.asarray(leaf).any()


@pytest.mark.slow
def test_training_gradient_from_the_middle_of_a_window_reaches_its_stored_inputs():
    """The rollout begins after nine decisions, the fourth of the second window, and ends after its inner step."""
    observation, action = tiny.leaves_at(random_episode(7), slice(15))
    weights = tiny.random_params(0, SAVN)
    adaptation = LearnedLossAdaptation(learning_rate=LEARNING_RATE)
    logit_weights = jnp.asarray(np.random.default_rng(2).normal(size=(15, NUM_ACTIONS)), jnp.float32)

    def package_loss(weights, cut):
        return (logit_weights * run_package(SAVN, weights, adaptation, observation, action, cut)[0]).sum()

    def reference_loss(weights, cut):
        return (logit_weights * run_reference(SAVN, weights, observation, action, cut=cut)).sum()

    gradient = jax.jit(jax.grad(package_loss), static_argnums=1)(weights, 9)
    expected = jax.jit(jax.grad(reference_loss), static_argnums=1)(weights, 9)
    scale = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(gradient))
    chex.assert_trees_all_close(gradient, expected, rtol=2e-3, atol=1e-4 * scale)

    # Negative control: a cut elsewhere gives another gradient.
    other_gradient = jax.jit(jax.grad(package_loss), static_argnums=1)(weights, 6)
    assert np.abs(other_gradient["fuse"]["kernel"] - gradient["fuse"]["kernel"]).max() > 1e-3 * scale


@pytest.mark.slow
def test_learned_loss_is_the_norm_of_two_causal_convolutions():
    loss = LearnedLoss(nnx.Rngs(params=0))
    rows = np.random.default_rng(0).normal(size=(WINDOW, 9)).astype(np.float32)

    def convolve(entries, layer, distance):
        """Convolve entries [C, L] by taps [2, C, D], the earlier one first, and apply a leaky ReLU."""
        taps = np.asarray(layer.kernel[...]).reshape(2, len(entries), -1)
        earlier_entries = np.pad(entries, ((0, 0), (distance, 0)))[:, : entries.shape[1]]
        earlier_outputs = np.einsum("cl,cd->dl", earlier_entries, taps[0])
        present_outputs = np.einsum("cl,cd->dl", entries, taps[1])
        outputs = earlier_outputs + present_outputs + np.asarray(layer.bias[...])[:, None]
        return np.where(outputs > 0, outputs, 0.01 * outputs)

    expected = np.linalg.norm(convolve(convolve(rows, loss.first, 1), loss.second, 2))
    np.testing.assert_allclose(loss(jnp.asarray(rows)), expected, rtol=1e-5)


# Episodes


@pytest.mark.slow
def test_each_episode_of_a_batch_adapts_as_it_does_alone():
    episodes = random_episode(3, 16)
    adaptation = LearnedLossAdaptation(learning_rate=LEARNING_RATE)
    run_adapted = jax.jit(functools.partial(run_package, SAVN, tiny.random_params(0, SAVN), adaptation))
    logits, _ = run_adapted(*episodes)

    # Replacing episode 5 changes the logits of episode 5 only.
    changed_episodes = jax.tree.map(lambda leaf: leaf.at[:, 5].set(leaf[:, 6]), episodes)
    changed_logits, _ = run_adapted(*changed_episodes)
    is_other_episode = np.arange(16) != 5
    np.testing.assert_array_equal(changed_logits[:, is_other_episode], logits[:, is_other_episode])
    assert np.abs(changed_logits[:, 5] - logits[:, 5]).max() > 0.1

    # An episode alone.
    single_logits, _ = run_adapted(*tiny.leaves_at(episodes, slice(None), 2))
    np.testing.assert_allclose(single_logits, logits[:, 2], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_adaptation_steps_only_at_the_ends_of_the_first_four_windows():
    adaptation = LearnedLossAdaptation(learning_rate=LEARNING_RATE)
    run_adapted = jax.jit(functools.partial(run_package, SAVN, tiny.random_params(0, SAVN), adaptation))
    _, fast = run_adapted(*random_episode(4))
    outputs = np.asarray(fast.layer_changes["hidden_gates"].outputs)
    previous_outputs = np.concatenate([np.zeros_like(outputs[:1]), outputs[:-1]])
    is_step = (outputs != previous_outputs).reshape(NUM_STEPS, -1).any(axis=1)
    assert (np.flatnonzero(is_step) + 1).tolist() == [6, 12, 18, 24]


@pytest.mark.slow
def test_replay_window_repeats_the_decisions_of_the_window():
    """Deciding again along a window ends in what the agent decided and remembers."""
    policy = bind(SAVN, tiny.random_params(0, SAVN))

    def step(memory, observation_and_action):
        observation, action = observation_and_action
        inputs = PolicyInputs(observation, jnp.ones(NUM_CATEGORIES))
        decision = policy.decide(policy.pathways(inputs), memory)
        return decision.next_state(action), (memory, decision)

    # Two windows; the second one comes after the first step and before the second.
    first_two_windows = tiny.leaves_at(random_episode(5), slice(2 * WINDOW))
    _, (memories, decisions) = jax.lax.scan(step, policy.initial_memory(), first_two_windows)
    last_memory, last_decision = tiny.leaves_at((memories, decisions), -1)

    # Replay the second window with the changes of the first step and no further ones.
    layer_changes = last_memory.fast.layer_changes
    window = last_decision.fast.window
    rows, layer_inputs = replay_window(policy, window, layer_changes, zero_output_changes(layer_changes))

    last_probs = jax.nn.softmax(last_decision.logits)
    np.testing.assert_allclose(rows[:, : policy.hidden_width], decisions.hidden[WINDOW:], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows[-1, policy.hidden_width :], last_probs, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(layer_inputs["hidden_gates"], memories.hidden[WINDOW:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("spec_name", SPECS)
def test_initial_fast_weights_have_no_empty_arrays(spec_name):
    """Checkpoints hold no empty arrays, though experience may have no width."""
    spec = SPECS[spec_name]

    def make_memory():
        return bind(spec, tiny.random_params(0, spec)).initial_memory((3,))

    for leaf in jax.tree.leaves(jax.eval_shape(make_memory).fast):
        assert leaf.size > 0


# Fewer steps


def test_limit_inner_steps_reduces_the_steps_of_an_adaptation():
    adaptation = METHODS["savn"].adaptation
    assert limit_inner_steps(adaptation, 0) is None
    assert limit_inner_steps(adaptation, 2) == LearnedLossAdaptation(inner_steps=2)


@pytest.mark.parametrize("inner_steps", [5, -1])
def test_limit_inner_steps_refuses_more_steps_than_windows(inner_steps):
    with pytest.raises(InputError, match=rf"inner_steps is {inner_steps}.*4 windows of 6"):
        limit_inner_steps(METHODS["savn"].adaptation, inner_steps)


def test_limit_inner_steps_refuses_a_method_that_adapts_in_another_way():
    with pytest.raises(InputError, match=r"inner_steps is 1.*give 0"):
        limit_inner_steps(METHODS["tpn"].adaptation, 1)


def test_learned_loss_adaptation_refuses_zero_steps():
    with pytest.raises(InputError, match=r"LearnedLossAdaptation: inner_steps is 0.*give 1"):
        LearnedLossAdaptation(inner_steps=0)


@pytest.mark.exhaustive
def test_adaptation_with_two_steps_takes_the_first_two_of_four():
    weights = tiny.random_params(0, SAVN)
    observation, action = random_episode(6)
    two_steps = LearnedLossAdaptation(inner_steps=2, learning_rate=LEARNING_RATE)
    four_steps = LearnedLossAdaptation(learning_rate=LEARNING_RATE)
    no_steps = limit_inner_steps(LearnedLossAdaptation(), 0)
    logits_of_two, _ = run_package(SAVN, weights, two_steps, observation, action)
    logits_of_four, _ = run_package(SAVN, weights, four_steps, observation, action)
    logits_of_none, fast_of_none = run_package(SAVN, weights, no_steps, observation, action)

    assert fast_of_none is None
    np.testing.assert_allclose(logits_of_two[: 3 * WINDOW], logits_of_four[: 3 * WINDOW], rtol=1e-5, atol=1e-5)
    assert np.abs(logits_of_two - logits_of_four)[3 * WINDOW :].max() > 1e-3
    assert np.abs(logits_of_none - logits_of_four)[WINDOW:].max() > 1e-3
