"""The same small perceptron for every category."""

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.features import NUM_FEATURES, Features
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

    @classmethod
    def of_detections(cls, spec: PolicySpec, rngs: nnx.Rngs) -> "CategoryMaps":
        """Make maps whose rows are those of `project_detections`."""
        return cls(spec.sizes.appearance + NUM_FEATURES, spec, rngs)

    def project_appearance(self, appearance: jax.Array) -> jax.Array:
        """Take appearances [K, d] through the first layer, [K, h]."""
        return appearance @ self.inner.kernel[...][: appearance.shape[-1]]

    def project_rows(self, rows: jax.Array) -> jax.Array:
        """Take rows through the first layer's last M inputs.

        From [..., K, M] to [..., K, h].
        """
        return product(rows, self.inner.kernel[...][-rows.shape[-1] :])

    def project_detections(self, seen: Features, appearance: jax.Array) -> jax.Array:
        """Take what is seen and sought through the first layer.

        A row is the appearance of a category, 0 where it is not detected, and its detection; to [..., K, h].
        """
        shown = self.project_appearance(appearance)
        shown = seen.visible[..., None] * jnp.broadcast_to(shown, (*seen.visible.shape, shown.shape[-1]))
        return shown + self.project_rows(seen.table)

    def finish(self, inner: jax.Array) -> jax.Array:
        """Finish what passed the first layer without its bias.

        From [..., K, h] to [..., K m].
        """
        return self.conclude(product(nnx.relu(biased(inner, self.inner)), self.outer.kernel[...]))

    def conclude(self, outer: jax.Array) -> jax.Array:
        """Finish what passed both layers without the last bias.

        From [..., K, m] to [..., K m].
        """
        maps = nnx.relu(biased(outer, self.outer))
        return maps.reshape(*maps.shape[:-2], -1)
