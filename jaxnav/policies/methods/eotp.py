"""Attention by goal, previous action and memory (EOTP: Mayo, Hazan and Tal, CVPR 2021)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.adaptation import LearnedSteps
from jaxnav.policies.category_maps import CategoryMaps
from jaxnav.policies.features import Features
from jaxnav.policies.methods.base import Experience, Method
from jaxnav.policies.methods.savn import WithLearnedLoss
from jaxnav.policies.pathways import Memory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import NUM_ACTIONS

_TINY = 1e-12  # below the square of any length


class Rows(NamedTuple):
    """Hold what can be attended to.

    Attributes:
      keys: float32 [..., K, h], the embeddings of the categories' rows, of length 1.
      goal: float32 [..., h], what is sought, of length 1.
      shown: bool [..., K], which categories are detected, and the goal.
      values: float32 [..., K, m], what the embeddings tell, weighted by the layout.
    """

    keys: jax.Array
    goal: jax.Array
    shown: jax.Array
    values: jax.Array


class SpatialAttention(Experience):
    """Attend to the detected categories and the goal.

    The score of a row is a mixture of its cosines to goal, previous action and memory; the memory says in which parts.
    Attention is the softmax over the rows. It and the layout weights multiply the rows' embeddings, of which the
    cosines know the directions alone: weights that came before would be normalised away. What reads an embedding is
    linear: the factors multiply what has passed it, which is the same.
    """

    recurrent = True

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        sizes = spec.sizes
        self.maps = CategoryMaps.of_detections(spec, rngs)
        self.goal = Linear(sizes.appearance, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.action = Linear(NUM_ACTIONS, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.memory = Linear(sizes.hidden, sizes.row_hidden, use_bias=False, rngs=rngs)
        self.parts = Linear(sizes.hidden, 3, bias_init=nnx.initializers.ones, rngs=rngs)
        self.width = self.maps.width

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> Rows:
        """Return the rows; the layout weights multiply their values."""
        rows = biased(self.maps.project_detections(features, appearance), self.maps.inner)
        values = weights[..., None] * product(nnx.relu(rows), self.maps.outer.kernel[...])
        goal = self.goal(features.goal @ appearance)
        return Rows(_directed(rows), _directed(goal), features.visible + features.goal > 0, values)

    def attend(self, encoded: Rows, memory: Memory) -> jax.Array:
        """Return experience, each category's by its attention."""
        return self.maps.conclude(self.attention(encoded, memory)[..., None] * encoded.values)

    def attention(self, encoded: Rows, memory: Memory) -> jax.Array:
        """Return the attention to each category.

        Float32 [..., K]: 0 for what is neither detected nor sought, 1 in all.
        """
        action = self.action(jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32))
        asking = jnp.stack([encoded.goal, _directed(action), _directed(self.memory(memory.hidden))], axis=-2)
        query = (self.parts(memory.hidden)[..., None] * asking).sum(axis=-2)
        score = (encoded.keys @ query[..., None])[..., 0]
        return jax.nn.softmax(jnp.where(encoded.shown, score, -jnp.inf))


class UniformAttention(SpatialAttention):
    """Attend to all of them alike."""

    def attention(self, encoded: Rows, memory: Memory) -> jax.Array:
        """Return equal attention to what is detected or sought."""
        shown = encoded.shown.astype(jnp.float32)
        return shown / shown.sum(axis=-1, keepdims=True)


class AdaptedAttention(WithLearnedLoss, SpatialAttention):
    """Attend to them; a learned loss stands by."""


def _directed(vectors: jax.Array) -> jax.Array:
    """Return vectors [..., h] at length 1; 0 stays 0."""
    return vectors * jax.lax.rsqrt(jnp.square(vectors).sum(axis=-1, keepdims=True) + _TINY)


EOTP = Method(SpatialAttention)
#: EOTP with equal attention: the ablation that it must beat.
UNIFORM = Method(UniformAttention)
#: EOTP that adapts within an episode, as its released agent does.
ADAPTED = Method(AdaptedAttention, adaptation=LearnedSteps())
