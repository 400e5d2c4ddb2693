"""Matrix product of rows with a kernel whose gradient is fast on a CPU.

`matmul_rows` and the layer `Linear` compute the usual product; their kernel gradient avoids two transposed copies.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx


@jax.custom_vjp
def matmul_rows(rows: jax.Array, kernel: jax.Array) -> jax.Array:
    """Return `rows @ kernel`, differentiable in reverse mode only.

    Args:
      rows: float32 [..., M].
      kernel: float32 [M, N].

    Returns:
      float32 [..., N].
    """
    return rows @ kernel


def _matmul_forward(rows: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    # The backward pass needs both operands.
    return rows @ kernel, (rows, kernel)


def _matmul_backward(residuals: tuple[jax.Array, jax.Array], output_grad: jax.Array) -> tuple[jax.Array, jax.Array]:
    # The gradient of the rows is JAX's own; only that of the kernel has a faster form.
    rows, kernel = residuals
    return output_grad @ kernel.T, kernel_gradient(rows, output_grad)


matmul_rows.defvjp(_matmul_forward, _matmul_backward)


def kernel_gradient(rows: jax.Array, output_grad: jax.Array) -> jax.Array:
    """Return the gradient of a kernel as rows^T g, summed over all leading axes.

    JAX's own rule computes (g^T rows)^T, for which XLA on a CPU first copies both operands in transposed order: two to
    three times slower where M and N are small.

    Args:
      rows: float32 [..., M], left operand of the product.
      output_grad: float32 [..., N], gradient with respect to the product.

    Returns:
      float32 [M, N].
    """
    # Merge all leading axes, so that one product sums over them: [..., M] -> [R, M] and [..., N] -> [R, N].
    num_rows = math.prod(rows.shape[:-1])
    flat_rows = rows.reshape(num_rows, rows.shape[-1])
    flat_grad = output_grad.reshape(num_rows, output_grad.shape[-1])
    return jnp.einsum("rm,rn->mn", flat_rows, flat_grad)


def add_bias(values: jax.Array, layer: nnx.Linear) -> jax.Array:
    """Return values [..., N] plus the layer's bias [N], if the layer has one."""
    if layer.bias is None:
        return values
    # An explicit shape, because rank promotion may be an error.
    return values + layer.bias[...].reshape((1,) * (values.ndim - 1) + (-1,))


class Linear(nnx.Linear):
    """Linear layer in float32, `Linear(M, N, rngs=rngs)`; its kernel gradient is fast on a CPU."""

    def __call__(self, inputs: jax.Array, out_sharding: Any = None) -> jax.Array:
        """Map inputs [..., M] to [..., N]."""
        return add_bias(matmul_rows(inputs, self.kernel[...]), self)
