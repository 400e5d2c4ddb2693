"""Random arrays, and the Dirichlet divergence in float64."""

import jax
import numpy as np
from scipy.special import digamma


def normal_array(seed: int, *shape: int) -> jax.Array:
    """Return standard normal numbers, float32 of `shape`."""
    return jax.random.normal(jax.random.key(seed), shape)


def exact_kl(prior, counts) -> np.ndarray:
    """Return the divergence of a Dirichlet posterior from its prior.

    lnGamma(a + n) - lnGamma(a) is the sum of log(a + i), so no large terms cancel.

    Args:
      prior: [..., K], concentrations.
      counts: whole numbers [..., K].

    Returns:
      float64 [...].
    """
    concentrations = np.asarray(prior, np.float64)
    whole_counts = np.asarray(counts, np.int64)
    entry_sum = _bregman_divergence(concentrations, whole_counts).sum(-1)
    return entry_sum - _bregman_divergence(concentrations.sum(-1), whole_counts.sum(-1))


def _bregman_divergence(a: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return g(a, n) = sum_{i < n} [psi(a + n) - log(a + i)]."""
    steps = np.arange(max(n.max(), 1))
    log_ratios = np.log((a + n)[..., None] / (a[..., None] + steps)) * (steps < n[..., None])
    return log_ratios.sum(-1) + n * (digamma(a + n) - np.log(a + n))
