"""Reductions over devices that share the episodes of a seed.

`mean_over_devices` averages a function of the episodes, such as a gradient, over their devices. Inside such a function,
`masked_mean` and `mean_and_std` are statistics over the episodes of all devices. A collective between processes takes
milliseconds per array, whatever its size, so each reduction sends a single flat array. On one device nothing is sent.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec

#: Axes of a mesh of devices: groups of devices for different seeds, and the devices of a group for their episodes.
SEED_AXIS = "seeds"
ENV_AXIS = "envs"


def mean_over_devices(function: Callable[..., Any], *in_specs: Any) -> Callable[..., Any]:
    """Average the results of a function over the devices that share episodes.

    Args:
      function: maps arrays to a pytree of float32 means over its episodes.
      in_specs: sharding of each argument, a pytree prefix as for `jax.shard_map`.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.shape.get(ENV_AXIS, 1) == 1:
        return function

    def averaged_function(*arguments: Any) -> Any:
        flat_result, unravel = ravel_pytree(function(*arguments))
        return unravel(jax.lax.pmean(flat_result, ENV_AXIS))

    return jax.shard_map(averaged_function, in_specs=in_specs, out_specs=PartitionSpec(), check_vma=False)


def masked_mean(values: jax.Array, mask: jax.Array | None = None) -> jax.Array:
    """Mean of the values under a mask, float32 [].

    Inside `mean_over_devices` the values are those of one device. The share under the mask is then that of all devices,
    so that the results average to the mean over all devices.

    Args:
      values: float32 [...].
      mask: bool [...]; None for all values. The mean is 0 where the mask is False everywhere.
    """
    if mask is None:
        return values.mean()

    share = mask.astype(jnp.float32).mean()
    if _is_inside_mean_over_devices():
        share = jax.lax.pmean(share, ENV_AXIS)
    return jnp.where(mask, values, 0.0).mean() / jnp.maximum(share, 1.0 / 2**24)


def mean_and_std(values: jax.Array, mask: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of the values of all devices, float32 [] each.

    Args:
      values: float32 [...]; those of one device inside `mean_over_devices`.
      mask: bool [...], see `masked_mean`.
    """
    # Several devices send both moments as one array.
    if _is_inside_mean_over_devices():
        local_moments = jnp.stack([masked_mean(values, mask), masked_mean(jnp.square(values), mask)])
        mean, mean_square = jax.lax.pmean(local_moments, ENV_AXIS)
        return mean, jnp.sqrt(jnp.maximum(mean_square - jnp.square(mean), 0.0))

    if mask is None:
        return values.mean(), values.std()
    mean = masked_mean(values, mask)
    return mean, jnp.sqrt(masked_mean(jnp.square(values - mean), mask))


def _is_inside_mean_over_devices() -> bool:
    return ENV_AXIS in jax.sharding.get_abstract_mesh().manual_axes
