"""The product of rows with a kernel, and its gradient."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx


def kernel_gradient(rows: jax.Array, by_result: jax.Array) -> jax.Array:
    """Return the gradient of a kernel, float32 [M, N].

    It is made of the rows [..., M] that met the kernel and the gradient by the result [..., N].

    It is asked for as rows^T g of two matrices. JAX's own rule asks for (g^T rows)^T, for which XLA on a CPU copies
    both operands in transposed order first: two to three times slower where M and N are small.
    """
    count = math.prod(rows.shape[:-1])
    return jnp.einsum("rm,rn->mn", *(array.reshape(count, array.shape[-1]) for array in (rows, by_result)))


@jax.custom_vjp
def product(rows: jax.Array, kernel: jax.Array) -> jax.Array:
    """Return `rows @ kernel`.

    Float32 [..., M] and [M, N] to [..., N]; differentiable in reverse mode only.
    """
    return rows @ kernel


def _product(rows: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return rows @ kernel, (rows, kernel)


def _gradients(saved: tuple[jax.Array, jax.Array], by_result: jax.Array) -> tuple[jax.Array, jax.Array]:
    rows, kernel = saved
    return by_result @ kernel.T, kernel_gradient(rows, by_result)


product.defvjp(_product, _gradients)


def biased(values: jax.Array, layer: nnx.Linear) -> jax.Array:
    """Add a layer's bias [N] to values [..., N].

    Without a bias nothing is added.
    """
    if layer.bias is None:
        return values
    return values + layer.bias[...].reshape((1,) * (values.ndim - 1) + (-1,))


class Linear(nnx.Linear):
    """Apply a linear layer by `product`, in float32."""

    def __call__(self, inputs: jax.Array, out_sharding: Any = None) -> jax.Array:
        """Take inputs [..., M] to [..., N]."""
        return biased(product(inputs, self.kernel[...]), self)
