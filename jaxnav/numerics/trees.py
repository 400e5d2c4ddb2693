"""Selection between pytrees of arrays and of their rows, and the size of pytrees."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")
Rows = TypeVar("Rows")


def tree_where(condition: jax.Array, on_true: Tree, on_false: Tree) -> Tree:
    """Select between two trees of equal structure, as `jnp.where` does between arrays.

    Args:
      condition: bool [] for all leaves, or bool [B] for leaves [B, ...], element by element of the batch.
      on_true, on_false: trees with leaves [...] of equal shapes.
    """

    def select_leaf(true_leaf: jax.Array, false_leaf: jax.Array) -> jax.Array:
        # [B] becomes [B, 1, ...], with the number of axes of the leaf.
        num_new_axes = jnp.ndim(true_leaf) - condition.ndim
        leaf_condition = condition.reshape(condition.shape + (1,) * num_new_axes) if condition.ndim else condition
        return jnp.where(leaf_condition, true_leaf, false_leaf)

    return jax.tree.map(select_leaf, on_true, on_false)


def take_rows(tree: Tree, row_indices: jax.Array) -> Tree:
    """Take the rows `row_indices`, int [B], of leaves [E, ...]."""
    return jax.tree.map(lambda leaf: leaf[row_indices], tree)


def count_array_bytes(tree: Any) -> int:
    """Return the bytes of a tree of arrays, or of their shapes from `jax.eval_shape`."""
    plain_tree = jax.eval_shape(functools.partial(jax.tree.map, _as_plain_array), tree)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(plain_tree))


def _as_plain_array(leaf: jax.Array) -> jax.Array:
    """Return the words of typed PRNG keys, and all other arrays as they are."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def map_selected_rows(
    function: Callable[[Rows], Tree], rows: Rows, is_selected: jax.Array, chunk_size: int = 16
) -> Tree:
    """Apply a function to the selected rows of a batch; all other rows of the result are zeros.

    The selected rows are taken together chunk by chunk, so the time is that of the selected rows alone, up to the last
    chunk. Under `jax.vmap` all chunks of the longest batch are computed.

    Args:
      function: function of one row.
      rows: leaves [B, ...].
      is_selected: bool [B].
      chunk_size: number of rows that are computed at once.

    Returns:
      The results, leaves [B, ...].
    """
    num_rows = len(is_selected)
    chunk_size = min(chunk_size, num_rows)
    one_row = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), rows)
    row_shapes = jax.eval_shape(function, one_row)
    results = jax.tree.map(lambda leaf: jnp.zeros((num_rows, *leaf.shape), leaf.dtype), row_shapes)

    # Selected rows first. The last chunk may hold rows of an earlier chunk, or rows that are not selected.
    order = jnp.argsort(~is_selected)
    num_selected = is_selected.sum()

    def compute_chunk(carry: tuple[jax.Array, Tree]) -> tuple[jax.Array, Tree]:
        start, results = carry
        indices = jax.lax.dynamic_slice(order, (start,), (chunk_size,))
        chunk_results = jax.vmap(function)(take_rows(rows, indices))
        zeros = jax.tree.map(jnp.zeros_like, chunk_results)
        chunk_results = tree_where(is_selected[indices], chunk_results, zeros)
        results = jax.tree.map(lambda leaf, values: leaf.at[indices].set(values), results, chunk_results)
        return start + chunk_size, results

    return jax.lax.while_loop(lambda carry: carry[0] < num_selected, compute_chunk, (jnp.int32(0), results))[1]
