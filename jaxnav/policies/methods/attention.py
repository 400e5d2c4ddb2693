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
        self,
        residual: jax.Array,
        query_inputs: jax.Array,
        key_inputs: jax.Array,
        value_inputs: jax.Array,
        is_present: jax.Array | None = None,
    ) -> jax.Array:
        """Attend from the queries to the entries, add the residual, and normalise.

        Args:
          residual: float32 [..., Q, d], added to the answers.
          query_inputs: float32 [..., Q, d], projected to the queries.
          key_inputs: float32 [..., N, d], projected to the keys of the entries.
          value_inputs: float32 [..., N, d], projected to the values of the entries.
          is_present: bool [..., N], True for entries to attend to, at least one; None for all entries.

        Returns:
          float32 [..., Q, d].
        """
        # Project the inputs and divide them among the heads, [..., h, Q or N, d / h].
        queries = self._split_heads(self.query(query_inputs))
        keys = self._split_heads(self.key(key_inputs))
        values = self._split_heads(self.value(value_inputs))

        # Attention weights [..., h, Q, N], which are 0 for absent entries.
        scores = self.scores(queries, keys)
        if is_present is not None:
            scores = jnp.where(is_present[..., None, None, :], scores, -jnp.inf)
        answers = jax.nn.softmax(scores) @ values

        # Join the heads, [..., Q, d].
        joined_answers = jnp.swapaxes(answers, -2, -3).reshape(residual.shape)
        return self.norm(residual + self.out(joined_answers))

    def scores(self, queries: jax.Array, keys: jax.Array) -> jax.Array:
        """Return attention scores, [..., h, Q, N]."""
        return queries @ jnp.swapaxes(keys, -1, -2) / np.float32(np.sqrt(queries.shape[-1]))

    def _split_heads(self, projected: jax.Array) -> jax.Array:
        """Divide [..., N, d] among the heads, [..., h, N, d / h]."""
        return jnp.swapaxes(projected.reshape(*projected.shape[:-1], self.heads, -1), -2, -3)


class UniformMultiHeadAttention(MultiHeadAttention):
    """Attention with equal weights, for ablations."""

    def scores(self, queries: jax.Array, keys: jax.Array) -> jax.Array:
        """Return zeros, [..., h, Q, N]."""
        return jnp.zeros_like(super().scores(queries, keys))


class FeedForward(nnx.Module):
    """Two-layer perceptron on each row, residual and layer norm."""

    def __init__(self, width: int, hidden: int, rngs: nnx.Rngs) -> None:
        self.inner = Linear(width, hidden, rngs=rngs)
        self.outer = Linear(hidden, width, rngs=rngs)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, rows: jax.Array) -> jax.Array:
        """Return rows [..., N, d] for rows [..., N, d]."""
        return self.norm(rows + self.outer(nnx.relu(self.inner(rows))))
