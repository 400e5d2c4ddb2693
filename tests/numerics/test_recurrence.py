"""The recurrent core against the cell of Flax and the gradients of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support.numerics import normal_array

from jaxnav.numerics.recurrence import UnrolledGRU, gru_step, unroll_gru

NUM_STEPS, BATCH, HIDDEN = 7, 5, 4


@pytest.fixture
def rollout():
    """Kernel [H, 3H], input gates [T, B, 3H], episode endings [T, B] and the first hidden state [B, H]."""
    ended = jnp.zeros((NUM_STEPS, BATCH), bool).at[2, 1].set(True).at[4, :].set(True).at[NUM_STEPS - 1, 0].set(True)
    kernel = normal_array(0, HIDDEN, 3 * HIDDEN)
    input_gates = normal_array(1, NUM_STEPS, BATCH, 3 * HIDDEN)
    return kernel, input_gates, ended, normal_array(2, BATCH, HIDDEN)


def unroll_by_definition(kernel, input_gates, ended, hidden):
    """Unroll in a Python loop; no gradient of a second decision reaches the hidden states."""
    hidden_after = []
    hidden_before = []
    hidden_gates = []
    for step in range(NUM_STEPS):
        hidden_before.append(jax.lax.stop_gradient(hidden))
        hidden_gates.append(jax.lax.stop_gradient(hidden) @ kernel)
        next_hidden = gru_step(input_gates[step], hidden @ kernel, hidden)
        hidden_after.append(next_hidden)
        hidden = jnp.where(ended[step][:, None], 0.0, next_hidden)
    return UnrolledGRU(jnp.stack(hidden_after), jnp.stack(hidden_before), jnp.stack(hidden_gates))


@pytest.mark.slow
def test_gru_step_equals_the_cell_of_flax():
    cell = nnx.GRUCell(3, HIDDEN, rngs=nnx.Rngs(0))
    hidden = normal_array(3, BATCH, HIDDEN)
    inputs = normal_array(4, BATCH, 3)
    expected_hidden, _ = cell(hidden, inputs)
    next_hidden = gru_step(cell.dense_i(inputs), hidden @ cell.dense_h.kernel[...], hidden)
    np.testing.assert_allclose(next_hidden, expected_hidden, atol=1e-6)


def test_unroll_gru_equals_a_loop_of_single_steps(rollout):
    for unrolled_part, expected_part in zip(unroll_gru(*rollout), unroll_by_definition(*rollout), strict=True):
        np.testing.assert_allclose(unrolled_part, expected_part, atol=1e-6)


def test_unroll_gru_starts_from_zero_after_an_ending(rollout):
    unrolled = unroll_gru(*rollout)
    assert np.all(unrolled.hidden_before[3, 1] == 0)
    assert np.all(unrolled.hidden_before[5] == 0)
    assert np.all(unrolled.hidden_before[3, 0] != 0)
    np.testing.assert_array_equal(unrolled.hidden_before[1], unrolled.hidden_after[0])


@pytest.mark.slow
def test_unroll_gru_has_the_gradients_of_the_loop_with_a_second_decision(rollout):
    """The second decision uses the hidden states and their products with the kernel."""
    kernel, input_gates, ended, first_hidden = rollout
    second_gates = normal_array(5, NUM_STEPS, BATCH, 3 * HIDDEN)
    first_weights = normal_array(6, NUM_STEPS, BATCH, HIDDEN)
    second_weights = normal_array(7, NUM_STEPS, BATCH, HIDDEN)

    def loss(unroll, kernel, input_gates, first_hidden):
        unrolled = unroll(kernel, input_gates, ended, first_hidden)
        second_hidden = gru_step(second_gates, unrolled.hidden_gates, unrolled.hidden_before)
        first_loss = (jnp.sin(3 * unrolled.hidden_after) * first_weights).sum()
        return first_loss + (second_hidden**2 * second_weights).sum()

    # Both ways of unrolling have the same gradients.
    gradient_of_loss = jax.grad(loss, argnums=(1, 2, 3))
    gradients = gradient_of_loss(unroll_gru, kernel, input_gates, first_hidden)
    expected_gradients = gradient_of_loss(unroll_by_definition, kernel, input_gates, first_hidden)
    for gradient, expected_gradient in zip(gradients, expected_gradients, strict=True):
        np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-4, atol=1e-5)

    # The second decision reaches the kernel: without it, the gradient differs.
    def loss_of_first_decision(kernel):
        return (jnp.sin(3 * unroll_gru(kernel, input_gates, ended, first_hidden).hidden_after) * first_weights).sum()

    first_gradient = jax.grad(loss_of_first_decision)(kernel)
    assert np.abs(np.asarray(gradients[0] - first_gradient)).max() > 0.1


@pytest.mark.slow
def test_gradients_of_unroll_gru_without_compilation(rollout):
    def loss(kernel):
        return jnp.sin(unroll_gru(kernel, *rollout[1:]).hidden_after).sum()

    expected_gradient = jax.grad(loss)(rollout[0])
    with jax.disable_jit():
        np.testing.assert_allclose(jax.grad(loss)(rollout[0]), expected_gradient, rtol=1e-5, atol=1e-6)
