"""Layers of a transformer (Vaswani et al., NeurIPS 2017), normalised after each."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear


class Attention(nnx.Module):
    """Add what several heads attend to, and normalise."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs) -> None:
        self.heads = heads
        self.query, self.key, self.value, self.out = (Linear(width, width, rngs=rngs) for _ in range(4))
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(
        self, values: jax.Array, query: jax.Array, key: jax.Array, memory: jax.Array, present: jax.Array | None = None
    ) -> jax.Array:
        """Return the values after they have attended.

        Args:
          values: float32 [..., Q, d], to add to.
          query: float32 [..., Q, d], what asks.
          key, memory: float32 [..., N, d], what is asked and what it answers.
          present: bool [..., N], of which at least one can be attended to; None for all.
        """
        q, k, v = self._split(self.query(query)), self._split(self.key(key)), self._split(self.value(memory))
        scores = self.scores(q, k)
        if present is not None:
            scores = jnp.where(present[..., None, None, :], scores, -jnp.inf)
        answer = jnp.swapaxes(jax.nn.softmax(scores) @ v, -2, -3).reshape(values.shape)
        return self.norm(values + self.out(answer))

    def scores(self, query: jax.Array, key: jax.Array) -> jax.Array:
        """Return how much is attended to what, [..., h, Q, N]."""
        return query @ jnp.swapaxes(key, -1, -2) / np.float32(np.sqrt(query.shape[-1]))

    def _split(self, values: jax.Array) -> jax.Array:
        """Divide [..., N, d] among the heads, [..., h, N, e]."""
        return jnp.swapaxes(values.reshape(*values.shape[:-1], self.heads, -1), -2, -3)


class Averaging(Attention):
    """Attend to everything equally."""

    def scores(self, query: jax.Array, key: jax.Array) -> jax.Array:
        """Return zeros, [..., h, Q, N]."""
        return jnp.zeros_like(super().scores(query, key))


class FeedForward(nnx.Module):
    """Add what a perceptron makes of each row, and normalise."""

    def __init__(self, width: int, hidden: int, rngs: nnx.Rngs) -> None:
        self.inner, self.outer = Linear(width, hidden, rngs=rngs), Linear(hidden, width, rngs=rngs)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, values: jax.Array) -> jax.Array:
        """Take rows [..., N, d] to rows."""
        return self.norm(values + self.outer(nnx.relu(self.inner(values))))
