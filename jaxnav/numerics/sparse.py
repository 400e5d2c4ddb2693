"""Work that few members of a batch need at a time."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

_PARTS = 8  # of a batch, that are worked on one after the other, or left out


def where_due(due: jax.Array, function: Callable[[Any], Any], batch: Any) -> Any:
    """Apply a function to the members of a batch that are due.

    They are put first, and a part of the batch without any is left out, so what it costs goes by their number.

    Args:
      due: bool [...].
      function: from one member to arrays.
      batch: leaves [..., ...].

    Returns:
      Leaves [..., ...]; those of members that are not due have no meaning.
    """
    axes, count = due.ndim, math.prod(due.shape)
    parts = math.gcd(count, _PARTS)
    order = jnp.argsort(~due.reshape(count))
    in_parts, back = order.reshape(parts, -1), jnp.argsort(order)

    def divide(leaf: jax.Array) -> jax.Array:
        return leaf.reshape(count, *leaf.shape[axes:])[in_parts]

    def restore(leaf: jax.Array) -> jax.Array:
        return leaf.reshape(count, *leaf.shape[2:])[back].reshape(*due.shape, *leaf.shape[2:])

    apply = jax.checkpoint(jax.vmap(function))

    def one(_: None, part: tuple[jax.Array, Any]) -> tuple[None, Any]:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(apply, part[1]))
        return None, jax.lax.cond(part[0].any(), apply, lambda _: nothing, part[1])

    return jax.tree.map(restore, jax.lax.scan(one, None, jax.tree.map(divide, (due, batch)))[1])
