"""Gated recurrent unit: one step, and a whole rollout with resets.

`unroll_gru` has a hand-written gradient, so that the kernel's gradient is one matrix product over all steps.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.numerics.product import kernel_gradient


def gru_step(input_gates: jax.Array, hidden_gates: jax.Array, hidden: jax.Array) -> jax.Array:
    """Compute one step of a gated recurrent unit, as `flax.nnx.GRUCell` does (Cho et al., 2014).

    Args:
      input_gates: float32 [..., 3 H], what the input contributes to reset gate, update gate and candidate.
      hidden_gates: float32 [..., 3 H], what the hidden state contributes: `hidden @ kernel`.
      hidden: float32 [..., H], hidden state before the step.

    Returns:
      float32 [..., H], hidden state after the step.
    """
    # The contributions to reset gate, update gate and candidate, [..., H] each.
    input_reset, input_update, input_candidate = jnp.split(input_gates, 3, axis=-1)
    hidden_reset, hidden_update, hidden_candidate = jnp.split(hidden_gates, 3, axis=-1)

    # The reset gate weights the old state in the candidate, the update gate mixes both.
    reset = jax.nn.sigmoid(input_reset + hidden_reset)
    update = jax.nn.sigmoid(input_update + hidden_update)
    candidate = jnp.tanh(input_candidate + reset * hidden_candidate)
    return (1.0 - update) * candidate + update * hidden


class UnrolledGRU(NamedTuple):
    """Recurrent core along a rollout of T steps of B episodes.

    Attributes:
      hidden_after: float32 [T, B, H], hidden state after each step, before a reset.
      hidden_before: float32 [T, B, H], hidden state before each step; a constant for gradients.
      hidden_gates: float32 [T, B, 3 H], `hidden_before @ kernel`; for gradients a function of the kernel alone. With
        `hidden_before`, a second decision on the same memory (of fixed value) costs only its gates.
    """

    hidden_after: jax.Array
    hidden_before: jax.Array
    hidden_gates: jax.Array


@jax.custom_vjp
def unroll_gru(kernel: jax.Array, input_gates: jax.Array, ended: jax.Array, hidden: jax.Array) -> UnrolledGRU:
    """Unroll the core over T steps of B episodes; each ended episode restarts from a zero hidden state.

    Differentiating the loop itself would add up the kernel's gradient step by step, reading and writing a [H, 3 H]
    matrix T times. Instead the backward loop returns the gradient of every step's gates, and the kernel's gradient is
    one product over T B rows. Differentiable in reverse mode only, with the gradients described in `UnrolledGRU`.

    Args:
      kernel: float32 [H, 3 H].
      input_gates: float32 [T, B, 3 H].
      ended: bool [T, B], True where an episode ended with this step.
      hidden: float32 [B, H], hidden state at the start.

    Returns:
      The states along the rollout.
    """
    return _unroll_forward(kernel, input_gates, ended, hidden)[0]


def _unroll_forward(
    kernel: jax.Array, input_gates: jax.Array, ended: jax.Array, hidden: jax.Array
) -> tuple[UnrolledGRU, Any]:
    def step(hidden_before: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        # Take the gradient function of every step now, so that the backward pass repeats no gate.
        input_gates, ended = inputs
        hidden_gates = hidden_before @ kernel
        hidden_after, step_vjp = jax.vjp(gru_step, input_gates, hidden_gates, hidden_before)

        # An ended episode starts again from zeros.
        next_hidden = jnp.where(ended[:, None], 0.0, hidden_after)
        return next_hidden, (UnrolledGRU(hidden_after, hidden_before, hidden_gates), step_vjp)

    # Scan over time; the leaves of `step_vjps` are those of the single steps, stacked to [T, ...]. With JAX_DISABLE_JIT
    # a scan is a Python loop, which cannot stack the gradient functions of its steps.
    with jax.disable_jit(False):
        _, (unrolled, step_vjps) = jax.lax.scan(step, hidden, (input_gates, ended))
    return unrolled, (kernel, unrolled.hidden_before, ended, step_vjps)


def _unroll_backward(residuals: Any, output_grad: UnrolledGRU) -> tuple[jax.Array, jax.Array, None, jax.Array]:
    kernel, hidden_before, ended, step_vjps = residuals

    def step(next_grad: jax.Array, inputs: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        # A reset stops the gradient from the following episode.
        step_vjp, ended, after_grad = inputs
        gate_grads = step_vjp(after_grad + jnp.where(ended[:, None], 0.0, next_grad))
        input_gates_grad, hidden_gates_grad, hidden_grad = gate_grads
        return hidden_grad + hidden_gates_grad @ kernel.T, (input_gates_grad, hidden_gates_grad)

    # Go backwards in time; the kernel's gradient is then one product over all steps.
    zero_grad = jnp.zeros_like(hidden_before[0])
    backward_inputs = (step_vjps, ended, output_grad.hidden_after)
    hidden_grad, gate_grads = jax.lax.scan(step, zero_grad, backward_inputs, reverse=True)
    input_gates_grad, hidden_gates_grad = gate_grads
    kernel_grad = kernel_gradient(hidden_before, hidden_gates_grad + output_grad.hidden_gates)
    return kernel_grad, input_gates_grad, None, hidden_grad


unroll_gru.defvjp(_unroll_forward, _unroll_backward)
