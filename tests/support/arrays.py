"""Arrays of random numbers."""

import jax


def normal(seed: int, *shape: int) -> jax.Array:
    """Draw normal numbers float32 of a shape."""
    return jax.random.normal(jax.random.key(seed), shape)
