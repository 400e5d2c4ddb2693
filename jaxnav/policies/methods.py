"""The methods: each says how experience is made from what is seen and sought; nothing else differs between them.

To add one, write a module whose constructor takes `(spec, rngs)`, with an attribute `width` (Z) and a call
`(features, appearance, weights) -> experience [..., Z]`, and name it in `METHODS`.
"""

from typing import Protocol

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.spec import PolicySpec


class Method(Protocol):
    """How experience is made.

    Attributes:
      width: Z, the size of the experience.
    """

    width: int

    def __call__(self, features: Features, appearance: jax.Array, weights: jax.Array) -> jax.Array:
        """Experience float32 [..., Z].

        Args:
          features: what is seen and sought.
          appearance: float32 [K, d], one embedding per category.
          weights: float32 [..., K], how much each category tells about the goal (eq. 7's w x g); ones leave the layout
            out.
        """
        ...


class CategoryMaps(nnx.Module):
    """The same two-layer perceptron for every category, side by side: rows [..., K, M] -> [..., K m].

    A row may be [x A | y], x A a mixture of the categories' appearances A [K, d]. The first layer is linear: A passes
    it once (`looks`) and is mixed after, which spares the product of every row with d rows of the kernel.
    """

    def __init__(self, inputs: int, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.inner = Linear(inputs, spec.sizes.row_hidden, rngs=rngs)
        self.outer = Linear(spec.sizes.row_hidden, spec.sizes.row_outputs, rngs=rngs)
        self.width = spec.num_categories * spec.sizes.row_outputs

    def looks(self, appearance: jax.Array) -> jax.Array:
        """Appearances [K, d] through the first d rows of the first layer, [K, h]."""
        return appearance @ self.inner.kernel[...][: appearance.shape[-1]]

    def read(self, rows: jax.Array) -> jax.Array:
        """Rows [..., K, M] through the last M rows of the first layer, [..., K, h]."""
        return product(rows, self.inner.kernel[...][-rows.shape[-1] :])

    def maps(self, inner: jax.Array) -> jax.Array:
        """What passed the first layer, [..., K, h] and without its bias, through the rest."""
        maps = nnx.relu(self.outer(nnx.relu(biased(inner, self.inner))))
        return maps.reshape(*maps.shape[:-2], -1)

    def __call__(self, rows: jax.Array) -> jax.Array:
        """Maps of the rows of all categories."""
        return self.maps(product(rows, self.inner.kernel[...]))


class NoExperience(nnx.Module):
    """RGB+RL (A3C of the paper): the policy sees detections but models no experience; Z is empty."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.width = 0

    def __call__(self, features: Features, appearance: jax.Array, weights: jax.Array) -> jax.Array:
        """Experience of no width."""
        return jnp.zeros((*weights.shape[:-1], 0), jnp.float32)


class ORG(nnx.Module):
    """Object relation graph (Du et al., ECCV 2020): relations between categories, given their boxes and the goal.

    The table [R^T X | T | g] of K rows, X the appearance and T the boxes of the detected categories, is the experience
    that the layout weights multiply (eq. 7), before the perceptron that reads it. Its first layer is linear: the
    weights multiply what has passed it, which is the same.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.edges = Linear(NUM_FEATURES, spec.num_categories, rngs=rngs)
        shape = (spec.sizes.relation_layers, spec.num_categories, spec.num_categories)
        self.mix = nnx.Param(nnx.initializers.lecun_normal(batch_axis=0)(rngs.params(), shape))
        self.maps = CategoryMaps(spec.sizes.appearance + NUM_FEATURES, spec, rngs)
        self.width = self.maps.width

    def __call__(self, features: Features, appearance: jax.Array, weights: jax.Array) -> jax.Array:
        """Experience from the goal-conditioned relations, each category weighted by the layout."""
        relation = jnp.swapaxes(nnx.relu(self.edges(features.table)), -1, -2)
        for kernel in self.mix[...]:
            relation = nnx.relu(product(relation, kernel))
        # R^T X with X = visible * appearance, the appearance already through the first layer of the maps.
        aggregated = product(relation * features.visible[..., None, :], self.maps.looks(appearance))
        return self.maps.maps(weights[..., None] * (aggregated + self.maps.read(features.table)))


METHODS: dict[str, type[NoExperience] | type[ORG]] = {"rgb": NoExperience, "org": ORG}
