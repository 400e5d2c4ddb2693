"""Selection between pytrees of arrays, and of their rows."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


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
