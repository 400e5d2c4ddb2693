"""The divergence of equation 5 in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import digamma, gammaln
from support.dirichlet import exact_kl

from jaxnav.numerics.dirichlet import presence_kl


def draws(seed: int, k: int, n: int = 4000):
    """Yield name, prior [n, k] and counts [n, k].

    Priors are from 0.01 to 2e4, counts from 0 to 3.
    """
    rng = np.random.default_rng(seed)
    scale = np.exp(rng.uniform(np.log(1e-2), np.log(2e4), (n, 1)))
    sparse = rng.integers(0, 4, (n, k)) * (rng.random((n, k)) < rng.random((n, 1)))
    full = rng.integers(1, 4, (n, k))
    near = np.exp(rng.normal(size=(n, k)) * 10 ** rng.uniform(-6, -1, (n, 1)))
    extremes = np.where(rng.random((n, k)) < 0.5, rng.uniform(0.01, 0.05, (n, k)), np.maximum(scale, 1))
    kinds = {
        "log-uniform": (np.exp(rng.uniform(np.log(1e-2), np.log(2e4), (n, k))), sparse),
        "extremes": (extremes, sparse),
        "near-proportional": (full * near * scale / 3, full),
        "proportional": (scale * np.ones(k), np.ones((n, k), int) * rng.integers(1, 4, (n, 1))),
    }
    for name, (prior, counts) in kinds.items():
        yield name, np.clip(prior, 1e-2, 2e4).astype(np.float32), counts


def worst_error(function, k: int) -> float:
    errors = []
    for name, prior, counts in draws(k, k):
        exact = exact_kl(prior, counts)
        value = np.asarray(jax.jit(function)(prior, counts.astype(np.float32)))
        large = exact > 1e-6
        errors.append(np.abs(value[large] / exact[large] - 1).max())
        print(f"K = {k}, {name}: worst relative error {errors[-1]:.1e}")
    return max(errors)


def test_differences_of_lgamma_are_inaccurate():
    """Check that the textbook formula in float32 has relative errors above 1.

    It does by orders of magnitude: the negative control.
    """
    from jax.scipy.special import digamma as psi
    from jax.scipy.special import gammaln as lgamma

    def textbook(a, c):
        b = a + c
        entries = lgamma(a) - lgamma(b) + c * (psi(b) - psi(b.sum(-1, keepdims=True)))
        return lgamma(b.sum(-1)) - lgamma(a.sum(-1)) + entries.sum(-1)

    assert worst_error(textbook, 22) > 1


def test_reference_agrees_with_the_textbook_formula_in_float64():
    rng = np.random.default_rng(0)
    a, c = rng.uniform(0.05, 30, (200, 8)), rng.integers(0, 4, (200, 8))
    b = a + c
    textbook = gammaln(b.sum(-1)) - gammaln(a.sum(-1)) + (gammaln(a) - gammaln(b)).sum(-1)
    textbook += (c * (digamma(b) - digamma(b.sum(-1, keepdims=True)))).sum(-1)
    np.testing.assert_allclose(exact_kl(a, c), textbook, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("increment", [1, 2, 5])
def test_presence_kl_is_accurate_in_float32(increment):
    rng = np.random.default_rng(increment)
    for name, prior, counts in draws(increment, 22):
        counts = increment * (counts > 0) * (rng.random(counts.shape) < 0.5)
        total = sum(
            exact_kl(np.stack([a, np.full_like(a, 1e9)], -1), np.stack([c, 0 * c], -1))
            for a, c in zip(prior.T, counts.T, strict=True)
        )  # g(a, c): the rest of the Dirichlet is too large to matter
        value = jax.jit(presence_kl, static_argnums=2)(prior, counts.astype(np.float32), increment)
        error = np.abs(value - np.maximum(exact_kl(prior, counts), 0)) / np.maximum(total, 1e-30)
        print(f"increment {increment}, {name}: worst error {error.max():.1e} of the sum of g")
        assert error.max() < 2e-5


def test_rows_of_a_batch_of_matrices_are_rows():
    """Categories are the last axis, however many there are before it."""
    draw = np.random.default_rng(0)
    prior = jnp.asarray(draw.uniform(0.1, 5, (3, 4, 6)), jnp.float32)
    counts = jnp.asarray(draw.random((3, 4, 6)) < 0.5, jnp.float32)
    rows = presence_kl(prior.reshape(12, 6), counts.reshape(12, 6), 1)
    np.testing.assert_allclose(presence_kl(prior, counts, 1), rows.reshape(3, 4), rtol=1e-6)
