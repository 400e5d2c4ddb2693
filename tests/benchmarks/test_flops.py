"""Tests of the count of floating-point operations in matrix products, from which the benchmarks compute utilisation."""

import importlib.util
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NUM_ROWS = 5
WIDTH = 7
NUM_STEPS = 11


@pytest.fixture(scope="module")
def flops() -> ModuleType:
    spec = importlib.util.spec_from_file_location("_flops", BENCHMARKS / "_flops.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recurrent_loss(weights, inputs, state):
    """Loss of a linear recurrence with two products a step."""

    def step(state, step_input):
        state = jnp.tanh(step_input @ weights + state @ weights)
        return state, None

    last_state, _ = jax.lax.scan(step, state, inputs)
    return last_state.sum()


ARGUMENTS = (jnp.ones((WIDTH, WIDTH)), jnp.ones((NUM_STEPS, NUM_ROWS, WIDTH)), jnp.ones((NUM_ROWS, WIDTH)))
PRODUCT_FLOPS = 2 * NUM_ROWS * WIDTH * WIDTH


def test_scan_counts_once_per_iteration(flops):
    jaxpr = jax.make_jaxpr(jax.jit(recurrent_loss))(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == 2 * NUM_STEPS * PRODUCT_FLOPS


def test_gradient_counts_forward_and_backward(flops):
    # Backward, each step has three products: two for the gradient by the weights and one for the gradient by the state.
    # The gradient by the inputs is not needed.
    jaxpr = jax.make_jaxpr(jax.jit(jax.grad(recurrent_loss)))(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == (2 + 3) * NUM_STEPS * PRODUCT_FLOPS


def test_batched_products_count_once_per_entry(flops):
    matrices = jnp.ones((3, NUM_ROWS, WIDTH))
    jaxpr = jax.make_jaxpr(lambda matrix: jnp.einsum("bij,bkj->bik", matrix, matrix))(matrices).jaxpr
    assert flops.matmul_flops(jaxpr) == 3 * 2 * NUM_ROWS * NUM_ROWS * WIDTH


def test_unused_products_do_not_count(flops):
    # Only the gradient by the weights is returned, so the products of the gradient by the inputs are unused.
    @jax.jit
    def compute_gradients(weights, inputs, state):
        return jax.grad(recurrent_loss, argnums=(0, 1))(weights, inputs, state)

    jaxpr = jax.make_jaxpr(lambda *arguments: compute_gradients(*arguments)[0])(*ARGUMENTS).jaxpr
    assert flops.matmul_flops(jaxpr) == (2 + 3) * NUM_STEPS * PRODUCT_FLOPS
