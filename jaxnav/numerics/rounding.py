"""Rounding that lets sums be undone."""

import jax
import jax.numpy as jnp

_STEP = 2.0**-10


@jax.custom_jvp
def rounded(values: jax.Array) -> jax.Array:
    """Round to multiples of 2**-10, with the identity's gradient.

    Float32 sums of such numbers below 2**13 are exact, so that (a + b) - b is a.

    Args:
      values: float32 [...].
    """
    return jnp.round(values / _STEP) * _STEP


rounded.defjvps(lambda tangent, result, values: tangent)
