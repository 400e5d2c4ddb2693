"""ORG: the object relation graph, which relates the detected categories to one another.

Source: H. Du, X. Yu and L. Zheng, *Learning Object Relation Graph and Tentative Policy for Visual Navigation*, ECCV
2020, and its released code; a host of L-sTDE in the paper. (`jaxnav.policies.methods.tpn` adds its tentative policy.)

Kept: relations between categories are computed from their boxes and the goal, transposed, and mixed over the
categories; their transpose mixes the appearances of the detected categories; a perceptron shared by all categories
reads the rows of aggregated appearance, box and goal. Changed: appearances are learned embeddings of the categories,
the mixing layers have no biases, and the perceptron is smaller.
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

    With the appearance X [K, d] and the boxes T [K, F] of the detected categories and the goal g [K],

        R = ReLU([T | g] E + b)^T          [K, K], the edges
        R = ReLU(R M_l)  for each layer l  [K, K], mixed over the categories of the second axis
        Z = perceptron(w g * [R^T X | T | g])  row by row, [K, m]

    where the layout weights w g [K] multiply the rows (eq. 7). The first layer of the perceptron is linear, so the
    weights multiply its output before the bias, which is equivalent.

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
        """Return experience float32 [..., K m], each category weighted by the layout."""
        return self.relate(features, appearance, weights, features.table)

    def relate(self, features: Features, appearance: jax.Array, weights: jax.Array, table: jax.Array) -> jax.Array:
        """Return the weighted experience of a table.

        Args:
          features: detections, leaves [..., K, ...].
          appearance: float32 [K, d], X before undetected categories are masked.
          weights: float32 [..., K], layout weights w g, not negative.
          table: float32 [..., K, columns], the columns beside R^T X.

        Returns:
          float32 [..., K m], the maps of all categories side by side.
        """
        # Edges ReLU([T | g] E + b)^T, then ReLU(R M) for each mixing layer: relations R [..., K, K].
        relations = jnp.swapaxes(nnx.relu(self.edges(features.table)), -1, -2)
        for kernel in self.mix[...]:
            relations = nnx.relu(matmul_rows(relations, kernel))

        # Aggregated appearance R^T X with X = visible * appearance [K, d], which has passed the first layer of the
        # perceptron before the aggregation: [..., K, h].
        visible_relations = jnp.swapaxes(relations, -1, -2) * features.visible[..., None, :]
        aggregated = matmul_rows(visible_relations, self.maps.project_appearance(appearance))
        return self.maps.finish(weights[..., None] * (aggregated + self.maps.project_rows(table)))


ORG = Method(ObjectRelations, name="org")
