"""The recurrent core and the products, against the library's layers and JAX's own gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxnav.numerics.product import Linear, product
from jaxnav.numerics.recurrence import Unrolled, gru, unroll

T, B, H = 7, 5, 4


def drawn(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


@pytest.fixture
def rollout():
    ended = jnp.zeros((T, B), bool).at[2, 1].set(True).at[4, :].set(True).at[T - 1, 0].set(True)
    return drawn(0, H, 3 * H), drawn(1, T, B, 3 * H), ended, drawn(2, B, H)


def plain(kernel, drive, ended, hidden):
    """The definition, a Python loop that autodiff sees through; a second decision must not move the memory."""
    after, before, projected = [], [], []
    for t in range(T):
        before.append(jax.lax.stop_gradient(hidden))
        projected.append(jax.lax.stop_gradient(hidden) @ kernel)
        after.append(gru(drive[t], hidden @ kernel, hidden))
        hidden = jnp.where(ended[t][:, None], 0.0, after[-1])
    return Unrolled(jnp.stack(after), jnp.stack(before), jnp.stack(projected))


def test_gru_is_the_librarys_cell():
    cell = nnx.GRUCell(3, H, rngs=nnx.Rngs(0))
    hidden, inputs = drawn(3, B, H), drawn(4, B, 3)
    expected, _ = cell(hidden, inputs)
    found = gru(cell.dense_i(inputs), hidden @ cell.dense_h.kernel[...], hidden)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_unrolled_values(rollout):
    for found, expected in zip(unroll(*rollout), plain(*rollout), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_hidden_state_starts_at_zero_after_an_ending(rollout):
    run = unroll(*rollout)
    assert np.all(run.before[3, 1] == 0)
    assert np.all(run.before[5] == 0)
    assert np.all(run.before[3, 0] != 0)
    np.testing.assert_array_equal(run.before[1], run.after[0])


def test_unrolled_gradients(rollout):
    """Of a loss on the states and on a second decision that shares memory and products."""
    ended, other = rollout[2], drawn(5, T, B, 3 * H)

    def loss(loop, kernel, drive, hidden):
        run = loop(kernel, drive, ended, hidden)
        second = gru(other, run.projected, run.before)
        return (jnp.sin(3 * run.after) * drawn(6, T, B, H)).sum() + (second**2 * drawn(7, T, B, H)).sum()

    given = rollout[0], rollout[1], rollout[3]
    found = jax.grad(lambda *args: loss(unroll, *args), argnums=(0, 1, 2))(*given)
    expected = jax.grad(lambda *args: loss(plain, *args), argnums=(0, 1, 2))(*given)
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)
    without = jax.grad(lambda k: (unroll(k, rollout[1], ended, rollout[3]).after).sum())(rollout[0])
    assert np.abs(np.asarray(found[0] - without)).max() > 0.1  # the second decision does teach the kernel


@pytest.mark.parametrize("width", [9, 0])
@pytest.mark.parametrize("shape", [(), (6,), (2, 3, 5)])
def test_product_has_jaxs_gradients(shape, width):
    rows, kernel, by_result = drawn(8, *shape, width), drawn(9, width, 4), drawn(10, *shape, 4)
    value, pull = jax.vjp(product, rows, kernel)
    expected, expected_pull = jax.vjp(jnp.matmul, rows, kernel)
    np.testing.assert_array_equal(value, expected)
    for one, two in zip(pull(by_result), expected_pull(by_result), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-6)


def test_linear_is_the_librarys():
    ours, theirs = Linear(3, 4, rngs=nnx.Rngs(0)), nnx.Linear(3, 4, rngs=nnx.Rngs(0))
    ours.bias[...] = theirs.bias[...] = drawn(11, 4)
    np.testing.assert_array_equal(ours(drawn(12, 2, 3)), theirs(drawn(12, 2, 3)))
