"""Updates of the masked members of a batch, against updates of all of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.numerics.sparse import update_where


def cubes(weight, inputs, state):
    return {"sum": weight * (inputs["a"] ** 3).sum() * state["sum"], "rows": weight * inputs["a"] ** 3 + state["rows"]}


def random_batch(seed, *shape):
    """What is known of each member, with a number that no gradient reaches, and its state."""
    draws = np.random.default_rng(seed)
    a, rows, sums = (jnp.asarray(draws.normal(size=(*shape, *inner)), jnp.float32) for inner in ((3,), (3,), ()))
    return {"a": a, "count": jnp.zeros(shape, jnp.int32)}, {"sum": sums, "rows": rows}


def one_by_one(mask, weight, inputs, state):
    """Update all members, and restore those that are not in the mask."""
    function = cubes
    for _ in mask.shape:
        function = jax.vmap(function, (None, 0, 0))
    after = function(weight, inputs, state)
    return jax.tree.map(
        lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b), after, state
    )


@functools.partial(jax.jit, static_argnums=0)
def update_and_gradients(change, mask, inputs, state):
    """The next state, and the gradients by weight, inputs and previous state."""

    def by(weight, a, state):
        after = change(mask, weight, inputs | {"a": a}, state)
        return sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(after)), after

    return jax.value_and_grad(by, argnums=(0, 1, 2), has_aux=True)(2.0, inputs["a"], state)


def sparsely(mask, weight, inputs, state):
    return update_where(mask, cubes, weight, inputs, state)


def close(mask, batch):
    one, other = update_and_gradients(sparsely, mask, *batch), update_and_gradients(one_by_one, mask, *batch)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), one, other)


@given(seed=st.integers(0, 99), mask=st.lists(st.booleans(), min_size=16, max_size=16))
def test_those_that_are_due_get_what_all_would(seed, mask):
    close(jnp.asarray(mask), random_batch(seed, 16))


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_batches_have_any_shape(shape):
    for mask in (jnp.ones(shape, bool), jnp.zeros(shape, bool), jnp.arange(np.prod(shape)).reshape(shape) % 2 == 0):
        close(mask, random_batch(1, *shape))


def test_runs_side_by_side_have_due_members_of_their_own():
    mask = jnp.arange(32).reshape(2, 16) > 27
    inputs, state = random_batch(2, 2, 16)
    both = jax.vmap(functools.partial(update_and_gradients, sparsely))(mask, inputs, state)
    for run in range(2):
        alone = update_and_gradients(one_by_one, *jax.tree.map(lambda leaf, run=run: leaf[run], (mask, inputs, state)))
        jax.tree.map(lambda a, b, run=run: np.testing.assert_allclose(a[run], b, rtol=1e-4, atol=1e-4), both, alone)


@pytest.mark.parametrize("count", [0, 1, 9, 16])
def test_parts_without_any_are_left_out(count):
    """Sixteen members are eight parts of two; what is broken in the others shows only where a part is worked on."""
    mask = jnp.arange(16) >= 16 - count
    inputs, state = random_batch(0, 16)
    broken = {**inputs, "a": jnp.where(mask[:, None], inputs["a"], jnp.nan)}
    _, (_, by_a, _) = update_and_gradients(sparsely, mask, broken, state)
    touched = np.isnan(by_a).any(axis=-1)
    assert not touched[np.asarray(mask)].any()
    assert touched.sum() == count % 2
