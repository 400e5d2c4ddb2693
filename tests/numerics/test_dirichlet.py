"""The Dirichlet divergence of equation 5 in float32 against an exact value."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import digamma as digamma_float32
from jax.scipy.special import gammaln as gammaln_float32
from scipy.special import digamma, gammaln
from support.numerics import exact_kl

from jaxnav.numerics.dirichlet import counts_kl, presence_kl

NUM_ROWS = 4000


def random_priors_and_counts(seed: int, num_categories: int) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield the kind of numbers, the prior float32 [R, K] from 0.01 to 2e4 and the counts [R, K] from 0 to 3."""
    rng = np.random.default_rng(seed)
    shape = (NUM_ROWS, num_categories)
    row_scale = np.exp(rng.uniform(np.log(1e-2), np.log(2e4), (NUM_ROWS, 1)))
    sparse_counts = rng.integers(0, 4, shape) * (rng.random(shape) < rng.random((NUM_ROWS, 1)))
    full_counts = rng.integers(1, 4, shape)
    near_one = np.exp(rng.normal(size=shape) * 10 ** rng.uniform(-6, -1, (NUM_ROWS, 1)))
    small_or_large = np.where(rng.random(shape) < 0.5, rng.uniform(0.01, 0.05, shape), np.maximum(row_scale, 1))
    log_uniform = np.exp(rng.uniform(np.log(1e-2), np.log(2e4), shape))
    kinds = {
        "log-uniform": (log_uniform, sparse_counts),
        "extremes": (small_or_large, sparse_counts),
        "near-proportional": (full_counts * near_one * row_scale / 3, full_counts),
        "proportional": (row_scale * np.ones(num_categories), np.ones(shape, int) * rng.integers(1, 4, (NUM_ROWS, 1))),
    }
    for kind, (prior, counts) in kinds.items():
        yield kind, np.clip(prior, 1e-2, 2e4).astype(np.float32), counts


def textbook_kl_float32(prior, counts):
    """The divergence as differences of lnGamma, in float32."""
    posterior = prior + counts
    posterior_sum = posterior.sum(-1, keepdims=True)
    terms = gammaln_float32(prior) - gammaln_float32(posterior)
    terms += counts * (digamma_float32(posterior) - digamma_float32(posterior_sum))
    return gammaln_float32(posterior.sum(-1)) - gammaln_float32(prior.sum(-1)) + terms.sum(-1)


def test_textbook_formula_in_float32_has_relative_errors_above_one():
    """Negative control: without the form of `presence_kl`, float32 loses every digit."""
    worst_error = 0.0
    for _, prior, counts in random_priors_and_counts(22, 22):
        exact = exact_kl(prior, counts)
        values = np.asarray(jax.jit(textbook_kl_float32)(prior, counts.astype(np.float32)))
        is_large = exact > 1e-6
        relative_errors = np.abs(values[is_large] / exact[is_large] - 1)
        worst_error = max(worst_error, relative_errors.max())
    assert worst_error > 1


def test_exact_kl_equals_the_textbook_formula_in_float64():
    rng = np.random.default_rng(0)
    prior = rng.uniform(0.05, 30, (200, 8))
    counts = rng.integers(0, 4, (200, 8))
    posterior = prior + counts
    expected = gammaln(posterior.sum(-1)) - gammaln(prior.sum(-1)) + (gammaln(prior) - gammaln(posterior)).sum(-1)
    expected += (counts * (digamma(posterior) - digamma(posterior.sum(-1, keepdims=True)))).sum(-1)
    np.testing.assert_allclose(exact_kl(prior, counts), expected, rtol=1e-8, atol=1e-12)


def sum_of_entry_divergences(prior: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Sum over categories of g(a_j, c_j): each entry beside a second one that is too large to matter."""
    total = np.zeros(len(prior))
    for entry, entry_counts in zip(prior.T, counts.T, strict=True):
        pair = np.stack([entry, np.full_like(entry, 1e9)], -1)
        pair_counts = np.stack([entry_counts, 0 * entry_counts], -1)
        total += exact_kl(pair, pair_counts)
    return total


@pytest.mark.parametrize("increment", [1, 2, 5])
def test_presence_kl_is_accurate_in_float32(increment):
    rng = np.random.default_rng(increment)
    for kind, prior, drawn_counts in random_priors_and_counts(increment, 22):
        # Half of the sightings, each with the increment.
        counts = increment * (drawn_counts > 0) * (rng.random(drawn_counts.shape) < 0.5)
        values = jax.jit(presence_kl, static_argnums=2)(prior, counts.astype(np.float32), increment)

        # The error is bounded relative to the terms that are summed.
        absolute_error = np.abs(values - np.maximum(exact_kl(prior, counts), 0))
        error = absolute_error / np.maximum(sum_of_entry_divergences(prior, counts), 1e-30)
        assert error.max() < 2e-5, kind


@pytest.mark.slow
@pytest.mark.parametrize("max_count", [1, 3, 40])
def test_counts_kl_is_accurate_in_float32(max_count):
    """Counts from 0 to 1, 3 and 40 in one row, and priors up to the sums of a million random views."""
    rng = np.random.default_rng(max_count)
    for kind, prior, drawn_counts in random_priors_and_counts(max_count, 22):
        counts = (drawn_counts > 0) * rng.integers(1, max_count + 1, drawn_counts.shape)
        scale = np.float32(1.0 if kind == "extremes" else 50.0)
        values = jax.jit(counts_kl)(scale * prior, counts.astype(np.float32))
        entry_sum = sum_of_entry_divergences(scale * prior, counts)
        error = np.abs(values - np.maximum(exact_kl(scale * prior, counts), 0)) / np.maximum(entry_sum, 1e-30)
        assert error.max() < 4e-5, kind
        # Concentrations of 1 and more, as in a prior that starts with one sighting of each pair.
        assert error[(scale * prior >= 1).all(axis=-1)].max(initial=0) < 1e-5, kind


@pytest.mark.slow
def test_counts_kl_follows_worked_arithmetic():
    """KL(Dir(6, 3) || Dir(6, 2)) = ln 4 + psi(3) - psi(9), and two counts at once for Dir(3, 1) against Dir(1, 1)."""
    np.testing.assert_allclose(counts_kl(jnp.array([6.0, 2]), jnp.array([0.0, 1])), 0.168437, rtol=1e-5)
    # lnGamma(4) - lnGamma(2) - lnGamma(3) + lnGamma(1) + 2 (psi(3) - psi(4)) = ln 6 - ln 2 - 2 / 3.
    np.testing.assert_allclose(counts_kl(jnp.ones(2), jnp.array([2.0, 0])), np.log(3) - 2 / 3, rtol=1e-5)
    # An excluded entry changes nothing.
    np.testing.assert_allclose(counts_kl(jnp.array([0.0, 1, 1]), jnp.array([0.0, 2, 0])), np.log(3) - 2 / 3, rtol=1e-5)


@pytest.mark.parametrize("increment", [1, 5])
def test_counts_kl_equals_presence_kl_for_equal_counts(increment):
    for _, prior, drawn_counts in random_priors_and_counts(7, 8):
        counts = (increment * (drawn_counts > 0)).astype(np.float32)
        expected = jax.jit(presence_kl, static_argnums=2)(prior, counts, increment)
        difference = np.abs(jax.jit(counts_kl)(prior, counts) - expected)
        assert (difference <= 6e-5 * sum_of_entry_divergences(prior, counts.astype(int)) + 1e-30).all()


@pytest.mark.slow
def test_presence_kl_sums_over_the_last_axis_only():
    rng = np.random.default_rng(0)
    prior = jnp.asarray(rng.uniform(0.1, 5, (3, 4, 6)), jnp.float32)
    counts = jnp.asarray(rng.random((3, 4, 6)) < 0.5, jnp.float32)
    by_row = presence_kl(prior.reshape(12, 6), counts.reshape(12, 6), 1)
    np.testing.assert_allclose(presence_kl(prior, counts, 1), by_row.reshape(3, 4), rtol=1e-6)
