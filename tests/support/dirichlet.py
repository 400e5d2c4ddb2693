"""The Dirichlet divergence in float64."""

import numpy as np
from scipy.special import digamma


def exact_kl(prior, counts) -> np.ndarray:
    """Return the divergence of a posterior from its prior.

    lnGamma(a + n) - lnGamma(a) is the sum of log(a + i), so no large terms cancel.
    """
    a, c = np.asarray(prior, np.float64), np.asarray(counts, np.int64)
    a_0, n = a.sum(-1), c.sum(-1)

    def g(x, m):
        steps = np.arange(max(m.max(), 1))
        logs = np.log((x + m)[..., None] / (x[..., None] + steps)) * (steps < m[..., None])
        return logs.sum(-1) + m * (digamma(x + m) - np.log(x + m))

    return g(a, c).sum(-1) - g(a_0, n)
