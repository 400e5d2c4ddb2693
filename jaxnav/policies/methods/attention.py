"""Layers of a transformer (Vaswani et al., NeurIPS 2017), each with a residual and a layer norm after it."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear


class MultiHeadAttention(nnx.Module):
    """Multi-head attention, residual and layer norm."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs) -> None:
        self.heads = heads
        self.query = Linear(width, width, rngs=rngs)
        self.key = Linear(width, width, rngs=rngs)
        self.value = Linear(width, width, rngs=rngs)
        self.out = Linear(width, width, rngs=rngs)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(
        self, values: jax.Array, query: jax.Array, key: jax.Array, memory: jax.Array, present: jax.Array | None = None
    ) -> jax.Array:
        """Add to the values what their queries read, and normalise.

        Args:
          values: float32 [..., Q, d], the residual.
          query: float32 [..., Q, d], inputs of the queries.
          key: float32 [..., N, d], inputs of the keys.
          memory: float32 [..., N, d], inputs of the values that are read.
          present: bool [..., N], True where there is an entry to attend to, at least once; None for all.
        """
        # Project the inputs and divide them among the heads, [..., h, Q or N, d / h].
        queries = self._split_heads(self.query(query))
        keys = self._split_heads(self.key(key))
        head_values = self._split_heads(self.value(memory))

        # Attention weights [..., h, Q, N].
        scores = self.scores(queries, keys)
        if present is not None:
            scores = jnp.where(present[..., None, None, :], scores, -jnp.inf)
        answers = jax.nn.softmax(scores) @ head_values

        # Join the heads, [..., Q, d].
        joined_answers = jnp.swapaxes(answers, -2, -3).reshape(values.shape)
        return self.norm(values + self.out(joined_answers))

    def scores(self, query: jax.Array, key: jax.Array) -> jax.Array:
        """Return attention scores, [..., h, Q, N]."""
        return query @ jnp.swapaxes(key, -1, -2) / np.float32(np.sqrt(query.shape[-1]))

    def _split_heads(self, values: jax.Array) -> jax.Array:
        """Divide [..., N, d] among the heads, [..., h, N, d / h]."""
        return jnp.swapaxes(values.reshape(*values.shape[:-1], self.heads, -1), -2, -3)


class UniformMultiHeadAttention(MultiHeadAttention):
    """Attention with equal weights, for ablations."""

    def scores(self, query: jax.Array, key: jax.Array) -> jax.Array:
        """Return zeros, [..., h, Q, N]."""
        return jnp.zeros_like(super().scores(query, key))


class FeedForward(nnx.Module):
    """Two-layer perceptron on each row, residual and layer norm."""

    def __init__(self, width: int, hidden: int, rngs: nnx.Rngs) -> None:
        self.inner = Linear(width, hidden, rngs=rngs)
        self.outer = Linear(hidden, width, rngs=rngs)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, values: jax.Array) -> jax.Array:
        """Return rows [..., N, d] for rows [..., N, d]."""
        return self.norm(values + self.outer(nnx.relu(self.inner(values))))
