"""Work for the members of a batch that are due, against work for all of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.numerics.sparse import where_due


def cubes(weight, member):
    return {"sum": weight * (member["a"] ** 3).sum(), "rows": weight * member["a"] ** 3 + member["b"]}


def random_batch(seed, *shape):
    draws = np.random.default_rng(seed)
    return {name: jnp.asarray(draws.normal(size=(*shape, *own)), jnp.float32) for name, own in (("a", (3,)), ("b", ()))}


def total(new, due):
    """A number that all results of members that are due enter."""
    kept = jax.tree.map(lambda leaf: jnp.where(due.reshape(due.shape + (1,) * (leaf.ndim - due.ndim)), leaf, 0.0), new)
    return sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(kept)), kept


@functools.partial(jax.jit, static_argnums=2)
def learned(due, batch, everyone):
    """Results, 0 where not due, and the gradient by weight and batch."""

    def by(weight, batch):
        function = functools.partial(cubes, weight)
        if not everyone:
            return total(where_due(due, function, batch), due)
        for _ in due.shape:
            function = jax.vmap(function)
        return total(function(batch), due)

    return jax.value_and_grad(by, argnums=(0, 1), has_aux=True)(2.0, batch)


def close(due, batch):
    one, other = learned(due, batch, False), learned(due, batch, True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), one, other)


@given(seed=st.integers(0, 99), due=st.lists(st.booleans(), min_size=16, max_size=16))
def test_those_that_are_due_get_what_all_would(seed, due):
    close(jnp.asarray(due), random_batch(seed, 16))


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_batches_have_any_shape(shape):
    for due in (jnp.ones(shape, bool), jnp.zeros(shape, bool), jnp.arange(np.prod(shape)).reshape(shape) % 2 == 0):
        close(due, random_batch(1, *shape))


@pytest.mark.parametrize("count", [0, 1, 9, 16])
def test_parts_without_any_are_left_out(count):
    """Sixteen members are eight parts of two: whoever shares no part with one that is due gets nothing."""
    due = jnp.arange(16) >= 16 - count
    worked = np.asarray(where_due(due, functools.partial(cubes, 1.0), random_batch(0, 16))["sum"] != 0)
    assert worked[np.asarray(due)].all()
    assert worked.sum() == 2 * -(-count // 2)
