"""The count of floating-point operations that the benchmarks divide by."""

import importlib.util
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NUM_ROWS, WIDTH, NUM_STEPS = 5, 7, 11


@pytest.fixture(scope="module")
def flops() -> ModuleType:
    spec = importlib.util.spec_from_file_location("_flops", BENCHMARKS / "_flops.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recurrent_loss(weights, inputs, state):
    """Return the loss of a linear recurrence: two products a step."""

    def step(state, entering):
        state = jnp.tanh(entering @ weights + state @ weights)
        return state, None

    return jax.lax.scan(step, state, inputs)[0].sum()


ARGUMENTS = (jnp.ones((WIDTH, WIDTH)), jnp.ones((NUM_STEPS, NUM_ROWS, WIDTH)), jnp.ones((NUM_ROWS, WIDTH)))
PRODUCT_FLOPS = 2 * NUM_ROWS * WIDTH * WIDTH


def test_scan_counts_once_per_iteration(flops):
    jaxpr = jax.make_jaxpr(jax.jit(recurrent_loss))(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == 2 * NUM_STEPS * PRODUCT_FLOPS


def test_gradient_counts_forward_and_backward(flops):
    # Back: by the weights twice and by the state once per step; nobody asks for the gradient by the inputs.
    jaxpr = jax.make_jaxpr(jax.jit(jax.grad(recurrent_loss)))(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == (2 + 3) * NUM_STEPS * PRODUCT_FLOPS


def test_batched_products_count_once_per_entry(flops):
    matrices = jnp.ones((3, NUM_ROWS, WIDTH))
    jaxpr = jax.make_jaxpr(lambda matrix: jnp.einsum("bij,bkj->bik", matrix, matrix))(matrices).jaxpr
    assert flops.matmul_flops(jaxpr) == 3 * 2 * NUM_ROWS * NUM_ROWS * WIDTH


def test_unused_products_do_not_count(flops):
    @jax.jit
    def gradients(weights, inputs, state):
        return jax.grad(recurrent_loss, argnums=(0, 1))(weights, inputs, state)

    jaxpr = jax.make_jaxpr(lambda *arguments: gradients(*arguments)[0])(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == (2 + 3) * NUM_STEPS * PRODUCT_FLOPS
