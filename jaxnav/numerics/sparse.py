"""Work that few members of a batch need at a time."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

_PARTS = 8  # of a batch, that are worked on one after the other, or left out

#: From what all members share, what is known of one and its state to its next state.
Function = Callable[[Any, Any, Any], Any]


def where_due(due: jax.Array, function: Function, shared: Any, known: Any, state: Any) -> Any:
    """Change the state of those members of a batch that are due.

    They are put first, and parts of the batch without any are left out. Other members are neither read nor written, in
    reverse mode neither, so what it costs goes by the number that is due.

    Args:
      due: bool [...].
      function: from `shared` and leaves of `known` and `state` without a batch to the next state. In reverse mode
        gradients reach these three, and nothing else that it holds.
      shared: a pytree of float arrays.
      known: leaves [..., ...].
      state: float leaves [..., ...].

    Returns:
      The state, leaves [..., ...].
    """

    def flat(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.reshape(math.prod(due.shape), *leaf.shape[due.ndim :]), tree)

    after = _apply(function, shared, flat(due), flat(known), flat(state))
    return jax.tree.map(lambda leaf: leaf.reshape(*due.shape, *leaf.shape[1:]), after)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _apply(function: Function, shared: Any, due: jax.Array, known: Any, state: Any) -> Any:
    """Change the state, leaves [B, ...]."""

    def work(index: jax.Array, state: Any) -> Any:
        given = _take((due, known, state), index)
        return _put(state, index, _changed(function, shared, *given))

    return _for_each_part(due, work, state)


def _changed(function: Function, shared: Any, due: jax.Array, known: Any, state: Any) -> Any:
    """Change a part of a batch; those that are not due keep their state."""
    after = jax.vmap(function, (None, 0, 0))(shared, known, state)
    return jax.tree.map(lambda a, b: jnp.where(jnp.expand_dims(due, [*range(1, a.ndim)]), a, b), after, state)


def _apply_forward(function: Function, *given: Any) -> tuple[Any, Any]:
    return _apply(function, *given), given


def _apply_gradient(function: Function, given: Any, received: Any) -> tuple[Any, None, Any, Any]:
    """Change the parts again, and go back through that."""
    shared, due, known, state = given
    numbers, others = _divide(known)

    def work(index: jax.Array, sums: Any) -> Any:
        by_shared, by_numbers, by_state = sums
        due_now, numbers_now, others_now, state_now = _take((due, numbers, others, state), index)

        def again(shared: Any, numbers: Any, state: Any) -> Any:
            return _changed(function, shared, due_now, _join(known, numbers, others_now), state)

        shares, *places = jax.vjp(again, shared, numbers_now, state_now)[1](_take(by_state, index))
        return jax.tree.map(jnp.add, by_shared, shares), *_put((by_numbers, by_state), index, tuple(places))

    zeros = jax.tree.map(jnp.zeros_like, (shared, numbers))
    by_shared, by_numbers, by_state = _for_each_part(due, work, (*zeros, received))
    return by_shared, None, _join(known, by_numbers, [None] * len(others)), by_state


_apply.defvjp(_apply_forward, _apply_gradient)


def _for_each_part(due: jax.Array, work: Callable[[jax.Array, Any], Any], carry: Any) -> Any:
    """Work on the parts with members that are due, of which `work` gets the indices."""
    size = len(due) // math.gcd(len(due), _PARTS)
    order = jnp.argsort(~due)

    def part(number: jax.Array, carry: Any) -> Any:
        return work(jax.lax.dynamic_slice_in_dim(order, number * size, size), carry)

    return jax.lax.fori_loop(0, -(-due.sum() // size), part, carry)


def _divide(tree: Any) -> tuple[list[jax.Array], list[jax.Array]]:
    """Return the leaves that gradients can reach, and the others."""
    leaves = jax.tree.leaves(tree)
    return [leaf for leaf in leaves if _is_real(leaf)], [leaf for leaf in leaves if not _is_real(leaf)]


def _join(tree: Any, numbers: Any, others: Any) -> Any:
    """Return a tree of the leaves that `_divide` divided."""
    numbers, others = iter(numbers), iter(others)
    return jax.tree.map(lambda leaf: next(numbers if _is_real(leaf) else others), tree)


def _is_real(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _take(tree: Any, index: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _put(tree: Any, index: jax.Array, members: Any) -> Any:
    return jax.tree.map(lambda leaf, new: leaf.at[index].set(new, unique_indices=True), tree, members)
