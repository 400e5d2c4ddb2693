"""Work for the members of a batch that are due, against work for all of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.numerics.sparse import where_due


def cubes(weight, known, state):
    return {"sum": weight * (known["a"] ** 3).sum() * state["sum"], "rows": weight * known["a"] ** 3 + state["rows"]}


def random_batch(seed, *shape):
    """What is known of each member, with a number that no gradient reaches, and its state."""
    draws = np.random.default_rng(seed)
    a, rows, sums = (jnp.asarray(draws.normal(size=(*shape, *inner)), jnp.float32) for inner in ((3,), (3,), ()))
    return {"a": a, "count": jnp.zeros(shape, jnp.int32)}, {"sum": sums, "rows": rows}


def one_by_one(due, weight, known, state):
    """Change all, and put back what is not due."""
    function = cubes
    for _ in due.shape:
        function = jax.vmap(function, (None, 0, 0))
    after = function(weight, known, state)
    return jax.tree.map(lambda a, b: jnp.where(due.reshape(due.shape + (1,) * (a.ndim - due.ndim)), a, b), after, state)


@functools.partial(jax.jit, static_argnums=0)
def learned(change, due, known, state):
    """The next state, and the gradient by weight, what is known and the state before."""

    def by(weight, a, state):
        after = change(due, weight, known | {"a": a}, state)
        return sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(after)), after

    return jax.value_and_grad(by, argnums=(0, 1, 2), has_aux=True)(2.0, known["a"], state)


def sparsely(due, weight, known, state):
    return where_due(due, cubes, weight, known, state)


def close(due, batch):
    one, other = learned(sparsely, due, *batch), learned(one_by_one, due, *batch)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), one, other)


@given(seed=st.integers(0, 99), due=st.lists(st.booleans(), min_size=16, max_size=16))
def test_those_that_are_due_get_what_all_would(seed, due):
    close(jnp.asarray(due), random_batch(seed, 16))


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_batches_have_any_shape(shape):
    for due in (jnp.ones(shape, bool), jnp.zeros(shape, bool), jnp.arange(np.prod(shape)).reshape(shape) % 2 == 0):
        close(due, random_batch(1, *shape))


def test_runs_side_by_side_have_due_members_of_their_own():
    due = jnp.arange(32).reshape(2, 16) > 27
    known, state = random_batch(2, 2, 16)
    both = jax.vmap(functools.partial(learned, sparsely))(due, known, state)
    for run in range(2):
        alone = learned(one_by_one, *jax.tree.map(lambda leaf, run=run: leaf[run], (due, known, state)))
        jax.tree.map(lambda a, b, run=run: np.testing.assert_allclose(a[run], b, rtol=1e-4, atol=1e-4), both, alone)


@pytest.mark.parametrize("count", [0, 1, 9, 16])
def test_parts_without_any_are_left_out(count):
    """Sixteen members are eight parts of two; what is broken in the others shows only where a part is worked on."""
    due = jnp.arange(16) >= 16 - count
    known, state = random_batch(0, 16)
    broken = {**known, "a": jnp.where(due[:, None], known["a"], jnp.nan)}
    _, (_, by_a, _) = learned(sparsely, due, broken, state)
    touched = np.isnan(by_a).any(axis=-1)
    assert not touched[np.asarray(due)].any()
    assert touched.sum() == count % 2
