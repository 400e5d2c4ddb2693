"""Arrays of random numbers."""

import jax


def normal_array(seed: int, *shape: int) -> jax.Array:
    """Standard normal numbers, float32 of `shape`."""
    return jax.random.normal(jax.random.key(seed), shape)
