"""EOTP: spatial attention by goal, previous action and memory.

Source: B. Mayo, T. Hazan and A. Tal, *Visual Navigation with Spatial Attention*, CVPR 2021, and its released code; a
host of L-sTDE in the paper.

Kept: entries, goal, previous action and memory are embedded with length 1; the score of an entry is a mixture of its
cosines to goal, action and memory, with shares that the memory sets; attention is the softmax of the scores and
multiplies the embeddings before their normalisation. Changed: the entries are the detected categories and the goal, not
49 places of an image, the previous action is one-hot, and one more layer reads the attended entries. The released agent
also adapts by a learned loss, as `ADAPTED` does; `EOTP` does not adapt.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, add_bias, matmul_rows
from jaxnav.policies.adaptation import LearnedLossAdaptation
from jaxnav.policies.features import CategoryMaps, Features
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.methods.savn import LearnedLossExperience
from jaxnav.policies.pathways import PolicyState
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import NUM_ACTIONS

_TINY = 1e-12  # below the square of any length; keeps the gradient at 0 finite


class AttentionEntries(NamedTuple):
    """Entries of the attention, one per category.

    Attributes:
      keys: float32 [..., K, h], the embeddings of the categories' rows, of length 1.
      goal: float32 [..., h], the embedding of the goal, of length 1.
      can_attend: bool [..., K], True for the detected categories and the goal.
      values: float32 [..., K, m], outputs of the rows, weighted by the layout.
    """

    keys: jax.Array
    goal: jax.Array
    can_attend: jax.Array
    values: jax.Array


class SpatialAttention(Experience):
    """Attention to the detected categories and the goal.

    Attention and the layout weights multiply the embeddings of the rows. The weights cannot enter earlier, because
    cosines only depend on the directions of the embeddings and would normalise a factor away. The layer that reads an
    embedding is linear, so both factors multiply its output instead, which is equivalent.
    """

    reads_memory = True

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        sizes = spec.sizes
        self.maps = CategoryMaps.for_detections(spec, rngs)
        self.goal = Linear(sizes.appearance, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.action = Linear(NUM_ACTIONS, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.memory = Linear(sizes.hidden, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.parts = Linear(sizes.hidden, 3, bias_init=nnx.initializers.ones, rngs=rngs)
        self.width = self.maps.width

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> AttentionEntries:
        """Return the entries, their values weighted by the layout."""
        # Rows [..., K, h] are the keys and, after the second layer of the maps, the values [..., K, m].
        rows = add_bias(self.maps.project_detections(features, appearance), self.maps.inner)
        values = weights[..., None] * matmul_rows(nnx.relu(rows), self.maps.outer.kernel[...])

        # Keys and goal have length 1, so that their products are cosines.
        goal_embedding = self.goal(features.goal @ appearance)
        return AttentionEntries(
            keys=_normalize(rows),
            goal=_normalize(goal_embedding),
            can_attend=features.visible + features.goal > 0,
            values=values,
        )

    def attend(self, encoded: AttentionEntries, memory: PolicyState) -> jax.Array:
        """Return experience: the values, each multiplied by its attention."""
        attention = self.attention_weights(encoded, memory)
        return self.maps.finish_outputs(attention[..., None] * encoded.values)

    def attention_weights(self, encoded: AttentionEntries, memory: PolicyState) -> jax.Array:
        """Return the attention to each category, float32 [..., K].

        The weights sum to 1 and are 0 for categories that are neither detected nor the goal.
        """
        # Three queries [..., 3, h]: goal, previous action and memory.
        action_one_hot = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        action_query = _normalize(self.action(action_one_hot))
        memory_query = _normalize(self.memory(memory.hidden))
        queries = jnp.stack([encoded.goal, action_query, memory_query], axis=-2)

        # The mixture of cosines is the cosine to the mixture of queries.
        query_shares = self.parts(memory.hidden)
        mixed_query = (query_shares[..., None] * queries).sum(axis=-2)
        scores = (encoded.keys @ mixed_query[..., None])[..., 0]
        return jax.nn.softmax(jnp.where(encoded.can_attend, scores, -jnp.inf))


class UniformAttention(SpatialAttention):
    """Equal attention to the detected categories and the goal."""

    def attention_weights(self, encoded: AttentionEntries, memory: PolicyState) -> jax.Array:
        """Return equal attention to the detected categories and the goal."""
        can_attend = encoded.can_attend.astype(jnp.float32)
        return can_attend / can_attend.sum(axis=-1, keepdims=True)


class AdaptedAttention(LearnedLossExperience, SpatialAttention):
    """Spatial attention, with a learned loss for the adaptation."""


def _normalize(vectors: jax.Array) -> jax.Array:
    """Scale vectors [..., h] to length 1; a zero vector stays zero."""
    return vectors * jax.lax.rsqrt(jnp.square(vectors).sum(axis=-1, keepdims=True) + _TINY)


EOTP = Method(SpatialAttention, name="eotp")
#: Ablation: EOTP with equal attention.
UNIFORM = Method(UniformAttention)
#: EOTP that adapts within an episode, as its released agent does.
ADAPTED = Method(AdaptedAttention, adaptation=LearnedLossAdaptation())
