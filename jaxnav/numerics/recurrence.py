"""The recurrent core: one step, and a whole rollout."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.numerics.product import kernel_gradient


def gru(drive: jax.Array, projected: jax.Array, hidden: jax.Array) -> jax.Array:
    """Take one step of a gated recurrent unit.

    As `flax.nnx.GRUCell` has it (Cho et al., 2014).

    Args:
      drive: float32 [..., 3 H], what the input contributes to reset gate, update gate and candidate.
      projected: float32 [..., 3 H], what the hidden state does: `hidden @ kernel`.
      hidden: float32 [..., H], before the step.

    Returns:
      float32 [..., H], after it.
    """
    (r, z, n), (by_r, by_z, by_n) = (jnp.split(part, 3, axis=-1) for part in (drive, projected))
    reset, update = jax.nn.sigmoid(r + by_r), jax.nn.sigmoid(z + by_z)
    candidate = jnp.tanh(n + reset * by_n)
    return (1.0 - update) * candidate + update * hidden


class Unrolled(NamedTuple):
    """Hold the core along a rollout, leaves [T, B, ...].

    Attributes:
      after: float32 [T, B, H], hidden state after each step, before a reset.
      before: float32 [T, B, H], before it; a constant as to gradients.
      projected: float32 [T, B, 3 H], `before @ kernel`; as to gradients a function of the kernel alone. Together with
        `before` it serves a second decision on the same memory (of fixed value) at the cost of its gates.
    """

    after: jax.Array
    before: jax.Array
    projected: jax.Array


@jax.custom_vjp
def unroll(kernel: jax.Array, drive: jax.Array, ended: jax.Array, hidden: jax.Array) -> Unrolled:
    """Unroll the core over T steps of B episodes.

    The hidden state starts at zero again after each ending.

    Differentiating the loop itself would add up the kernel's gradient step by step, a [H, 3 H] matrix read and written
    T times; here the loop returns what the steps received, and the gradient is one product over T B rows.

    Args:
      kernel: float32 [H, 3 H].
      drive: float32 [T, B, 3 H].
      ended: bool [T, B], the episode ended with this step.
      hidden: float32 [B, H], at the start.

    Returns:
      The states along the rollout. In reverse mode only, and as to gradients as `Unrolled` has it.
    """
    return _unroll(kernel, drive, ended, hidden)[0]


def _unroll(kernel: jax.Array, drive: jax.Array, ended: jax.Array, hidden: jax.Array) -> tuple[Unrolled, Any]:
    def step(before: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        drive, ended = inputs
        projected = before @ kernel
        after, pull = jax.vjp(gru, drive, projected, before)
        return jnp.where(ended[:, None], 0.0, after), (Unrolled(after, before, projected), pull)

    _, (run, pulls) = jax.lax.scan(step, hidden, (drive, ended))
    return run, (kernel, run.before, ended, pulls)


def _unroll_gradient(saved: Any, cotangent: Unrolled) -> tuple[jax.Array, jax.Array, None, jax.Array]:
    kernel, before, ended, pulls = saved

    def step(later: jax.Array, inputs: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        pull, ended, received = inputs
        drive, projected, hidden = pull(received + jnp.where(ended[:, None], 0.0, later))
        return hidden + projected @ kernel.T, (drive, projected)

    nothing = jnp.zeros_like(before[0])
    hidden, (drive, projected) = jax.lax.scan(step, nothing, (pulls, ended, cotangent.after), reverse=True)
    return kernel_gradient(before, projected + cotangent.projected), drive, None, hidden


unroll.defvjp(_unroll, _unroll_gradient)
