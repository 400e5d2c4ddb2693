"""The object relation graph (Du et al., ECCV 2020)."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, product
from jaxnav.policies.category_maps import CategoryMaps
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.methods.base import Experience, Method
from jaxnav.policies.spec import PolicySpec


class ObjectRelations(Experience):
    """Relate the detected categories and the goal.

    The table [R^T X | T | g] of K rows, X the appearance and T the boxes of the detected categories, is the experience
    that the layout weights multiply (eq. 7), before the perceptron that reads it. Its first layer is linear: the
    weights multiply what has passed it, which is the same.

    Attributes:
      columns: of T and g; a subclass may have more of its own.
    """

    columns: ClassVar[int] = NUM_FEATURES
    sizes: ClassVar[Mapping[str, int]] = {"relation_layers": 1}

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.edges = Linear(NUM_FEATURES, spec.num_categories, rngs=rngs)
        shape = (self.size(spec, "relation_layers"), spec.num_categories, spec.num_categories)
        self.mix = nnx.Param(nnx.initializers.lecun_normal(batch_axis=0)(rngs.params(), shape))
        self.maps = CategoryMaps(spec.sizes.appearance + self.columns, spec, rngs)
        self.width = self.maps.width

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        return self.relate(features, appearance, weights, features.table)

    def relate(self, features: Features, appearance: jax.Array, weights: jax.Array, table: jax.Array) -> jax.Array:
        """Return the weighted experience of a table [..., K, columns]."""
        relation = jnp.swapaxes(nnx.relu(self.edges(features.table)), -1, -2)
        for kernel in self.mix[...]:
            relation = nnx.relu(product(relation, kernel))
        # R^T X with X = visible * appearance, the appearance already through the first layer of the maps.
        aggregated = product(relation * features.visible[..., None, :], self.maps.project_appearance(appearance))
        return self.maps.finish(weights[..., None] * (aggregated + self.maps.project_rows(table)))


ORG = Method(ObjectRelations)
