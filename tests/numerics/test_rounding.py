"""Rounded numbers: their sums can be undone, and gradients pass."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.numerics.rounding import round_to_grid

VALUES = jnp.asarray(np.random.default_rng(0).normal(scale=300, size=(2, 100_000)), jnp.float32)


def test_sums_are_undone_to_the_bit():
    a, b = round_to_grid(VALUES)
    np.testing.assert_array_equal((a + b) - b, a)
    x, y = VALUES  # as they would not be otherwise
    assert ((x + y) - y != x).mean() > 0.2


def test_the_nearest_multiple_is_taken():
    assert np.abs(round_to_grid(VALUES) - VALUES).max() <= 2.0**-11
    np.testing.assert_array_equal(round_to_grid(VALUES) * 1024 % 1, 0)


def test_the_gradient_is_that_of_the_identity():
    gradient = jax.grad(lambda values: jnp.square(round_to_grid(values)).sum())(VALUES)
    np.testing.assert_array_equal(gradient, 2 * round_to_grid(VALUES))
