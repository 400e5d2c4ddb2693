"""Functions of the selected rows of a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.numerics.trees import map_selected_rows


@pytest.mark.parametrize("num_selected", [0, 1, 3, 4, 7])
def test_selected_rows_are_computed_and_the_rest_are_zeros(num_selected):
    """Seven rows in chunks of three: the last chunk overlaps the one before it."""
    is_selected = np.zeros(7, bool)
    is_selected[np.random.default_rng(num_selected).permutation(7)[:num_selected]] = True
    numbers = np.arange(1.0, 8.0, dtype=np.float32)
    rows = {"number": jnp.asarray(numbers), "pair": jnp.asarray(numbers[:, None] * [1.0, 2.0], jnp.float32)}

    def add_up(row):
        return row["number"] ** 2, row["pair"].sum() + 1.0

    squares, sums = jax.jit(lambda rows, mask: map_selected_rows(add_up, rows, mask, chunk_size=3))(rows, is_selected)
    np.testing.assert_array_equal(squares, np.where(is_selected, numbers**2, 0.0))
    np.testing.assert_array_equal(sums, np.where(is_selected, 3 * numbers + 1, 0.0))
