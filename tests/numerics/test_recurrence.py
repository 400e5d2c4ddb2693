"""The recurrent core, against the library's cell and JAX's gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support.arrays import normal

from jaxnav.numerics.recurrence import UnrolledGRU, gru_step, unroll_gru

T, B, H = 7, 5, 4


@pytest.fixture
def rollout():
    ended = jnp.zeros((T, B), bool).at[2, 1].set(True).at[4, :].set(True).at[T - 1, 0].set(True)
    return normal(0, H, 3 * H), normal(1, T, B, 3 * H), ended, normal(2, B, H)


def plain(kernel, drive, ended, hidden):
    """Unroll by definition, in a Python loop.

    A second decision must not move the memory.
    """
    after, before, projected = [], [], []
    for t in range(T):
        before.append(jax.lax.stop_gradient(hidden))
        projected.append(jax.lax.stop_gradient(hidden) @ kernel)
        after.append(gru_step(drive[t], hidden @ kernel, hidden))
        hidden = jnp.where(ended[t][:, None], 0.0, after[-1])
    return UnrolledGRU(jnp.stack(after), jnp.stack(before), jnp.stack(projected))


def test_gru_is_the_librarys_cell():
    cell = nnx.GRUCell(3, H, rngs=nnx.Rngs(0))
    hidden, inputs = normal(3, B, H), normal(4, B, 3)
    expected, _ = cell(hidden, inputs)
    hidden_after = gru_step(cell.dense_i(inputs), hidden @ cell.dense_h.kernel[...], hidden)
    np.testing.assert_allclose(hidden_after, expected, atol=1e-6)


def test_unrolled_values(rollout):
    for one, other in zip(unroll_gru(*rollout), plain(*rollout), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_hidden_state_starts_at_zero_after_an_ending(rollout):
    run = unroll_gru(*rollout)
    assert np.all(run.hidden_before[3, 1] == 0)
    assert np.all(run.hidden_before[5] == 0)
    assert np.all(run.hidden_before[3, 0] != 0)
    np.testing.assert_array_equal(run.hidden_before[1], run.hidden_after[0])


def test_unrolled_gradients(rollout):
    """Check gradients of a loss with a second decision.

    The second decision shares memory and products.
    """
    ended, other = rollout[2], normal(5, T, B, 3 * H)

    def loss(loop, kernel, drive, hidden):
        run = loop(kernel, drive, ended, hidden)
        second = gru_step(other, run.hidden_gates, run.hidden_before)
        return (jnp.sin(3 * run.hidden_after) * normal(6, T, B, H)).sum() + (second**2 * normal(7, T, B, H)).sum()

    given = rollout[0], rollout[1], rollout[3]
    gradients = jax.grad(lambda *args: loss(unroll_gru, *args), argnums=(0, 1, 2))(*given)
    expected = jax.grad(lambda *args: loss(plain, *args), argnums=(0, 1, 2))(*given)
    for one, two in zip(gradients, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)
    without = jax.grad(lambda k: (unroll_gru(k, rollout[1], ended, rollout[3]).hidden_after).sum())(rollout[0])
    assert np.abs(np.asarray(gradients[0] - without)).max() > 0.1  # the second decision does teach the kernel
