"""Shares: what devices that share the episodes of a seed compute together.

An exchange between processes takes milliseconds per array, whatever its size; so a gradient and all that is told of it
are exchanged as one array. One device exchanges nothing.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec

#: The axes of a mesh of devices.
SEEDS, EPISODES = "seeds", "episodes"


def averaged(function: Callable[..., Any], *places: Any) -> Callable[..., Any]:
    """Average a function over the devices that share episodes.

    Args:
      function: from arrays to a tree of float32 means over its episodes.
      places: of each argument's leaves (or prefixes of its tree), as `jax.shard_map` takes them.
    """
    if jax.sharding.get_abstract_mesh().shape.get(EPISODES, 1) == 1:
        return function

    def average(*arguments: Any) -> Any:
        flat, tree = ravel_pytree(function(*arguments))
        return tree(jax.lax.pmean(flat, EPISODES))

    return jax.shard_map(average, in_specs=places, out_specs=PartitionSpec(), check_vma=False)


def moments(values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return mean and deviation of the values of all devices.

    Float32 [...] to float32 [] each; within `averaged` the values are a device's share.
    """
    if EPISODES not in jax.sharding.get_abstract_mesh().manual_axes:
        return values.mean(), values.std()
    mean, square = jax.lax.pmean(jnp.stack([values.mean(), jnp.square(values).mean()]), EPISODES)
    return mean, jnp.sqrt(jnp.maximum(square - jnp.square(mean), 0.0))
