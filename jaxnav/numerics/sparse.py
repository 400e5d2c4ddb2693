"""Batched updates that cost only as much as the members that need them.

`update_where` applies a function to the masked members of a batch, in the forward and in the backward pass, part by
part, and skips parts without any such member.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.numerics.trees import take_rows, tree_where

#: Number of parts of a batch, which are computed one after the other or skipped.
_NUM_PARTS = 8

#: Maps (shared, inputs of some members, state of these members) to their next state.
Function = Callable[[Any, Any, Any], Any]


def update_where(mask: jax.Array, function: Function, shared: Any, inputs: Any, state: Any) -> Any:
    """Update the state of the batch members where `mask` is True.

    Members to update are sorted first and computed in up to eight equal parts, also in reverse mode; parts without any
    such member are skipped, so the cost grows with the number of updates. A batch of odd size is one part.

    Args:
      mask: bool [...].
      function: maps `shared` and the leaves [P, ...] of `inputs` and `state` of P members to their next state, each
        member for itself. In reverse mode gradients reach these three and no other array that the function closes over.
      shared: a pytree of float arrays.
      inputs: leaves [..., ...].
      state: float leaves [..., ...].

    Returns:
      The next state, leaves [..., ...].
    """

    def flatten_batch(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.reshape(math.prod(mask.shape), *leaf.shape[mask.ndim :]), tree)

    # The batch as one axis, [...] -> [B], and back.
    flat_state = _update(function, shared, flatten_batch(mask), flatten_batch(inputs), flatten_batch(state))
    return jax.tree.map(lambda leaf: leaf.reshape(*mask.shape, *leaf.shape[1:]), flat_state)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _update(function: Function, shared: Any, mask: jax.Array, inputs: Any, state: Any) -> Any:
    """Update the state, leaves [B, ...]."""

    def update_part(index: jax.Array, state: Any) -> Any:
        # A part may end with members that are not masked, which keep their state.
        members = take_rows((mask, inputs, state), index)
        return _set_rows(state, index, _update_members(function, shared, *members))

    return _for_each_part(mask, update_part, state)


def _update_members(function: Function, shared: Any, mask: jax.Array, inputs: Any, state: Any) -> Any:
    """Update the members of one part; unmasked members keep their state."""
    next_state = function(shared, inputs, state)
    return tree_where(mask, next_state, state)


def _update_forward(function: Function, *arguments: Any) -> tuple[Any, Any]:
    return _update(function, *arguments), arguments


def _update_backward(function: Function, residuals: Any, output_grad: Any) -> tuple[Any, None, Any, Any]:
    """Recompute each part with masked members and differentiate it."""
    shared, mask, inputs, state = residuals
    float_inputs, other_inputs = _split_floats(inputs)

    def differentiate_part(index: jax.Array, grads: Any) -> Any:
        shared_grad, inputs_grad, state_grad = grads
        members = take_rows((mask, float_inputs, other_inputs, state), index)
        part_mask, part_floats, part_others, part_state = members

        def recompute(shared: Any, part_floats: Any, part_state: Any) -> Any:
            part_inputs = _join_floats(inputs, part_floats, part_others)
            return _update_members(function, shared, part_mask, part_inputs, part_state)

        # Shared gradients add up over the parts; members have rows of their own.
        _, part_vjp = jax.vjp(recompute, shared, part_floats, part_state)
        part_shared_grad, *member_grads = part_vjp(take_rows(state_grad, index))
        shared_grad = jax.tree.map(jnp.add, shared_grad, part_shared_grad)
        return shared_grad, *_set_rows((inputs_grad, state_grad), index, tuple(member_grads))

    # The gradient of an unmasked member's state is that of its output, unchanged.
    zero_grads = jax.tree.map(jnp.zeros_like, (shared, float_inputs))
    grads = _for_each_part(mask, differentiate_part, (*zero_grads, output_grad))
    shared_grad, inputs_grad, state_grad = grads
    return shared_grad, None, _join_floats(inputs, inputs_grad, [None] * len(other_inputs)), state_grad


_update.defvjp(_update_forward, _update_backward)


def _for_each_part(mask: jax.Array, function: Callable[[jax.Array, Any], Any], carry: Any) -> Any:
    """Call `function` with the member indices of every part that has masked members, and with the carry."""
    # Equal parts need a number of parts that divides the batch. Masked members come first.
    part_size = len(mask) // math.gcd(len(mask), _NUM_PARTS)
    masked_first = jnp.argsort(~mask)

    def run_part(part: jax.Array, carry: Any) -> Any:
        return function(jax.lax.dynamic_slice_in_dim(masked_first, part * part_size, part_size), carry)

    # The number of parts is traced, so parts beyond the last masked member cost nothing.
    return jax.lax.fori_loop(0, -(-mask.sum() // part_size), run_part, carry)


def _split_floats(tree: Any) -> tuple[list[jax.Array], list[jax.Array]]:
    """Return the float leaves, which gradients can reach, and the other leaves."""
    leaves = jax.tree.leaves(tree)
    float_leaves = [leaf for leaf in leaves if _is_float(leaf)]
    other_leaves = [leaf for leaf in leaves if not _is_float(leaf)]
    return float_leaves, other_leaves


def _join_floats(tree: Any, floats: Any, others: Any) -> Any:
    """Return a tree like `tree` with the leaves that `_split_floats` separated."""
    # Both iterators advance in the order of the leaves in `tree`.
    float_iterator = iter(floats)
    other_iterator = iter(others)
    return jax.tree.map(lambda leaf: next(float_iterator if _is_float(leaf) else other_iterator), tree)


def _is_float(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _set_rows(tree: Any, index: jax.Array, rows: Any) -> Any:
    return jax.tree.map(lambda leaf, row: leaf.at[index].set(row, unique_indices=True), tree, rows)
