"""The same small perceptron for every category."""

import jax
from flax import nnx

from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.spec import PolicySpec


class CategoryMaps(nnx.Module):
    """Apply a two-layer perceptron to every category.

    Rows [..., K, M] become maps [..., K m], category by category. A row may be [x A | y], x A a mixture of the
    categories' appearances A [K, d]. The first layer is linear: A passes it once (`project_appearance`) and is mixed
    after, which spares the product of every row with d rows of the kernel.
    """

    def __init__(self, inputs: int, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.inner = Linear(inputs, spec.sizes.row_hidden, rngs=rngs)
        self.outer = Linear(spec.sizes.row_hidden, spec.sizes.row_outputs, rngs=rngs)
        self.width = spec.num_categories * spec.sizes.row_outputs

    def project_appearance(self, appearance: jax.Array) -> jax.Array:
        """Take appearances [K, d] through the first layer, [K, h]."""
        return appearance @ self.inner.kernel[...][: appearance.shape[-1]]

    def project_rows(self, rows: jax.Array) -> jax.Array:
        """Take rows through the first layer's last M inputs.

        From [..., K, M] to [..., K, h].
        """
        return product(rows, self.inner.kernel[...][-rows.shape[-1] :])

    def finish(self, inner: jax.Array) -> jax.Array:
        """Finish what passed the first layer without its bias.

        From [..., K, h] to [..., K m].
        """
        maps = nnx.relu(self.outer(nnx.relu(biased(inner, self.inner))))
        return maps.reshape(*maps.shape[:-2], -1)
