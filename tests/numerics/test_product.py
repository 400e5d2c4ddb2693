"""The matrix product with a fast kernel gradient, and its layer, against JAX and Flax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support.numerics import normal_array

from jaxnav.numerics.product import Linear, matmul_rows


@pytest.mark.slow
@pytest.mark.parametrize("width", [9, 0])
@pytest.mark.parametrize("shape", [(), (6,), (2, 3, 5)])
def test_matmul_rows_has_value_and_gradients_of_matmul(shape, width):
    rows = normal_array(8, *shape, width)
    kernel = normal_array(9, width, 4)
    output_grad = normal_array(10, *shape, 4)
    value, pull_back = jax.vjp(matmul_rows, rows, kernel)
    expected_value, expected_pull_back = jax.vjp(jnp.matmul, rows, kernel)
    np.testing.assert_array_equal(value, expected_value)
    for gradient, expected_gradient in zip(pull_back(output_grad), expected_pull_back(output_grad), strict=True):
        np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-5, atol=1e-6)


def test_linear_equals_the_layer_of_flax():
    our_layer = Linear(3, 4, rngs=nnx.Rngs(0))
    flax_layer = nnx.Linear(3, 4, rngs=nnx.Rngs(0))
    assert our_layer.bias is not None
    assert flax_layer.bias is not None
    bias = normal_array(11, 4)
    our_layer.bias[...] = bias
    flax_layer.bias[...] = bias
    inputs = normal_array(12, 2, 3)
    np.testing.assert_array_equal(our_layer(inputs), flax_layer(inputs))
