"""Numbers rounded to a grid: exact sums, the nearest multiple, a straight-through gradient."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.numerics.rounding import round_to_grid

VALUES = jnp.asarray(np.random.default_rng(0).normal(scale=300, size=(2, 100_000)), jnp.float32)


def test_round_to_grid_makes_addition_exactly_reversible():
    grid_a, grid_b = round_to_grid(VALUES)
    np.testing.assert_array_equal((grid_a + grid_b) - grid_b, grid_a)

    # Unrounded float32 sums are not reversible.
    raw_a, raw_b = VALUES
    assert ((raw_a + raw_b) - raw_b != raw_a).mean() > 0.2


def test_round_to_grid_gives_the_nearest_multiple_of_the_grid():
    assert np.abs(round_to_grid(VALUES) - VALUES).max() <= 2.0**-11
    np.testing.assert_array_equal(round_to_grid(VALUES) * 1024 % 1, 0)


def test_round_to_grid_has_the_gradient_of_the_identity():
    gradient = jax.grad(lambda values: jnp.square(round_to_grid(values)).sum())(VALUES)
    np.testing.assert_array_equal(gradient, 2 * round_to_grid(VALUES))
