"""Updates of the masked members of a batch equal updates of all members that are undone outside the mask."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.numerics.sparse import update_where


def cubic_update(weight, inputs, state):
    """Next state of some members: a number and a vector that depend on weight, input and state."""
    cubes = inputs["a"] ** 3
    return {"sum": weight * cubes.sum(axis=-1) * state["sum"], "rows": weight * cubes + state["rows"]}


def random_batch(seed, *shape):
    """Inputs and states of a batch of a shape; the inputs hold integers, which have no gradient."""
    rng = np.random.default_rng(seed)
    values = jnp.asarray(rng.normal(size=(*shape, 3)), jnp.float32)
    rows = jnp.asarray(rng.normal(size=(*shape, 3)), jnp.float32)
    sums = jnp.asarray(rng.normal(size=shape), jnp.float32)
    inputs = {"a": values, "count": jnp.zeros(shape, jnp.int32)}
    return inputs, {"sum": sums, "rows": rows}


def update_masked(mask, weight, inputs, state):
    return update_where(mask, cubic_update, weight, inputs, state)


def update_all_then_restore(mask, weight, inputs, state):
    """Update all members, and restore those outside the mask."""
    next_state = cubic_update(weight, inputs, state)

    def select(new_leaf, old_leaf):
        leaf_mask = mask.reshape(mask.shape + (1,) * (new_leaf.ndim - mask.ndim))
        return jnp.where(leaf_mask, new_leaf, old_leaf)

    return jax.tree.map(select, next_state, state)


@functools.partial(jax.jit, static_argnums=0)
def update_and_gradients(update, mask, inputs, state):
    """Next state, and the gradients of its sum of squares with respect to weight, inputs and previous state."""

    def loss(weight, values, state):
        next_state = update(mask, weight, inputs | {"a": values}, state)
        sum_of_squares = sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(next_state))
        return sum_of_squares, next_state

    return jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(2.0, inputs["a"], state)


def assert_trees_close(tree, expected_tree):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), tree, expected_tree)


def check_update_where(mask, batch):
    masked_result = update_and_gradients(update_masked, mask, *batch)
    expected_result = update_and_gradients(update_all_then_restore, mask, *batch)
    assert_trees_close(masked_result, expected_result)


@given(seed=st.integers(0, 99), mask=st.lists(st.booleans(), min_size=16, max_size=16))
def test_update_where_equals_updating_all_and_restoring_the_rest(seed, mask):
    check_update_where(jnp.asarray(mask), random_batch(seed, 16))


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_update_where_takes_batches_of_any_shape(shape):
    even_members = jnp.arange(np.prod(shape)).reshape(shape) % 2 == 0
    for mask in (jnp.ones(shape, bool), jnp.zeros(shape, bool), even_members):
        check_update_where(mask, random_batch(1, *shape))


def take_run(tree, run_index):
    """Arrays of one of several runs, whose index is the leading axis."""
    return jax.tree.map(lambda leaf: leaf[run_index], tree)


def test_update_where_under_vmap_uses_the_mask_of_each_run():
    mask = jnp.arange(32).reshape(2, 16) > 27  # no member of the first run, four of the second
    inputs, state = random_batch(2, 2, 16)
    batched_result = jax.vmap(functools.partial(update_and_gradients, update_masked))(mask, inputs, state)
    for run_index in range(2):
        run_arguments = take_run((mask, inputs, state), run_index)
        expected_result = update_and_gradients(update_all_then_restore, *run_arguments)
        assert_trees_close(take_run(batched_result, run_index), expected_result)


@pytest.mark.parametrize("count", [0, 1, 9, 16])
def test_update_where_skips_parts_without_a_masked_member(count):
    """Sixteen members are eight parts of two; a NaN outside the mask spreads only within a part that is computed."""
    mask = jnp.arange(16) >= 16 - count
    inputs, state = random_batch(0, 16)
    broken_inputs = {**inputs, "a": jnp.where(mask[:, None], inputs["a"], jnp.nan)}
    _, (_, input_gradient, _) = update_and_gradients(update_masked, mask, broken_inputs, state)

    # With an odd count one unmasked member shares its part with a masked one, and is computed with it.
    is_broken = np.isnan(input_gradient).any(axis=-1)
    assert not is_broken[np.asarray(mask)].any()
    assert is_broken.sum() == count % 2
