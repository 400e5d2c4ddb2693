"""ORG: the object relation graph, which relates the detected categories to one another.

Source: H. Du, X. Yu and L. Zheng, *Learning Object Relation Graph and Tentative Policy for Visual Navigation*, ECCV
2020; a host of L-sTDE in the paper. (`jaxnav.policies.methods.tpn` adds its tentative policy.)

Kept: relations R between categories are computed from their boxes and the goal, and mix the appearances of the detected
categories. Changed: appearances are learned embeddings of the categories, and a perceptron shared by all categories
reads each row.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, matmul_rows
from jaxnav.policies.features import NUM_FEATURES, CategoryMaps, Features
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.spec import PolicySpec


class ObjectRelations(Experience):
    """Relations between the detected categories and the goal.

    The layout weights multiply (eq. 7) the table [R^T X | T | g] of K rows, with the appearance X and the boxes T of
    the detected categories and the goal g, before a perceptron reads each row. The first layer of the perceptron is
    linear, so the weights multiply its output instead, which is equivalent.

    Attributes:
      columns: number of columns of T and g; a subclass may add columns of its own.
    """

    columns: ClassVar[int] = NUM_FEATURES
    sizes: ClassVar[Mapping[str, int]] = {"relation_layers": 1}

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        # Relations from the boxes and the goal.
        num_categories = spec.num_categories
        self.edges = Linear(NUM_FEATURES, num_categories, rngs=rngs)

        # One kernel [K, K] for each layer of relations.
        kernel_shape = (self.size(spec, "relation_layers"), num_categories, num_categories)
        init_kernels = nnx.initializers.lecun_normal(batch_axis=0)
        self.mix = nnx.Param(init_kernels(rngs.params(), kernel_shape))

        # The perceptron that reads each row.
        self.maps = CategoryMaps(spec.sizes.appearance + self.columns, spec, rngs)
        self.width = self.maps.width

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        return self.relate(features, appearance, weights, features.table)

    def relate(self, features: Features, appearance: jax.Array, weights: jax.Array, table: jax.Array) -> jax.Array:
        """Return the weighted experience of a table [..., K, columns]."""
        # Relations R^T [..., K, K] from the boxes.
        relations = jnp.swapaxes(nnx.relu(self.edges(features.table)), -1, -2)
        for kernel in self.mix[...]:
            relations = nnx.relu(matmul_rows(relations, kernel))

        # R^T X with X = visible * appearance; the appearance has already passed the first layer of the maps.
        visible_relations = relations * features.visible[..., None, :]
        aggregated = matmul_rows(visible_relations, self.maps.project_appearance(appearance))
        return self.maps.finish(weights[..., None] * (aggregated + self.maps.project_rows(table)))


ORG = Method(ObjectRelations, name="org")
