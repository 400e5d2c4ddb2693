"""The products against JAX's and the library's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support.arrays import normal

from jaxnav.numerics.product import Linear, matmul_rows


@pytest.mark.parametrize("width", [9, 0])
@pytest.mark.parametrize("shape", [(), (6,), (2, 3, 5)])
def test_product_has_jaxs_gradients(shape, width):
    rows, kernel, by_result = normal(8, *shape, width), normal(9, width, 4), normal(10, *shape, 4)
    value, pull = jax.vjp(matmul_rows, rows, kernel)
    expected, expected_pull = jax.vjp(jnp.matmul, rows, kernel)
    np.testing.assert_array_equal(value, expected)
    for one, two in zip(pull(by_result), expected_pull(by_result), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-6)


def test_linear_is_the_librarys():
    ours, theirs = Linear(3, 4, rngs=nnx.Rngs(0)), nnx.Linear(3, 4, rngs=nnx.Rngs(0))
    assert ours.bias is not None
    assert theirs.bias is not None
    ours.bias[...] = theirs.bias[...] = normal(11, 4)
    np.testing.assert_array_equal(ours(normal(12, 2, 3)), theirs(normal(12, 2, 3)))
