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


def average(values: jax.Array, counted: jax.Array | None = None) -> jax.Array:
    """Return the mean float32 [] of those values [...] that count.

    Args:
      values: float32 [...]; within `averaged` a device's share.
      counted: bool [...], which of them; None for all. 0 where none of all devices counts.
    """
    if counted is None:
        return values.mean()
    share = counted.astype(jnp.float32).mean()
    if EPISODES in jax.sharding.get_abstract_mesh().manual_axes:
        share = jax.lax.pmean(share, EPISODES)
    return jnp.where(counted, values, 0.0).mean() / jnp.maximum(share, 1.0 / 2**24)


def moments(values: jax.Array, counted: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Return mean and deviation of the values of all devices.

    Float32 [...] to float32 [] each; within `averaged` the values are a device's share. `counted` is as in `average`.
    """
    if EPISODES not in jax.sharding.get_abstract_mesh().manual_axes:
        if counted is None:
            return values.mean(), values.std()
        mean = average(values, counted)
        return mean, jnp.sqrt(average(jnp.square(values - mean), counted))
    mean, square = jax.lax.pmean(jnp.stack([average(values, counted), average(jnp.square(values), counted)]), EPISODES)
    return mean, jnp.sqrt(jnp.maximum(square - jnp.square(mean), 0.0))
