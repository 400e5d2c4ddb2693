"""Scene priors: a graph convolution over what is known of categories (Yang et al., ICLR 2019)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.methods.base import Experience, Knowledge, Method, Percept
from jaxnav.policies.methods.graphs import learn_graph, learn_permuted
from jaxnav.policies.spec import PolicySpec


@dataclasses.dataclass(frozen=True)
class GraphTracker:
    """Hand the graph on; nothing is remembered."""

    def init(self, knowledge: Knowledge) -> Any:
        """Return an empty note."""
        return ()

    def update(self, note: Any, knowledge: Knowledge, percept: Percept) -> Any:
        """Return the empty note."""
        return note

    def read(self, note: Any, knowledge: Knowledge, goal: jax.Array) -> jax.Array:
        """Return the graph, float32 [K, K]."""
        return knowledge.method["mixing"]


class GraphConvolution(Experience):
    """Convolve what is detected and sought over a graph.

    A node holds a category's embedding, detected or not, its detection and the goal's flag. Three layers without biases
    leave one number a category, which the layout weights multiply (eq. 7). The last is linear: with a single output a
    ReLU may be 0 everywhere from the start, and so for good.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        hidden = spec.sizes.row_hidden
        self.named = Linear(spec.sizes.appearance, hidden, use_bias=False, rngs=rngs)
        self.seen = Linear(NUM_FEATURES, hidden, use_bias=False, rngs=rngs)
        self.second = Linear(hidden, hidden, use_bias=False, rngs=rngs)
        self.third = Linear(hidden, 1, use_bias=False, rngs=rngs)
        self.width = spec.num_categories

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: jax.Array) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        nodes = self.seen(features.table)
        nodes = nnx.relu(reading @ (nodes + jnp.broadcast_to(self.named(appearance), nodes.shape)))
        nodes = nnx.relu(reading @ self.second(nodes))
        return weights * (reading @ self.third(nodes))[..., 0]


SP = Method(GraphConvolution, tracker=GraphTracker(), learn=learn_graph)
#: SP with its graph's edges permuted: the ablation that it must beat.
PERMUTED = dataclasses.replace(SP, learn=learn_permuted)
