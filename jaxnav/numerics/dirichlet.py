"""The divergence of a Dirichlet distribution from itself before an update.

`presence_kl` is what the layout estimator calls (eq. 5); `update_kl` is its general form, for any counts.
"""

import jax
import jax.numpy as jnp

#: Smallest concentration of a category that can be seen; below it a first sighting has an unbounded divergence.
MIN_CONCENTRATION = 1e-2


def _excess(t: jax.Array, log1p_t: jax.Array) -> jax.Array:
    """Return t - log(1 + t), for t > -1.

    Without cancellation: with s = t / (2 + t), log(1 + t) = 2 artanh(s).
    """
    s = t / (2 + t)
    r = s * s
    return jnp.where(jnp.abs(t) < 0.3, s * t - 2 * s * r * (1 / 3 + r * (1 / 5 + r / 7)), t - log1p_t)


def _bregman_remainder(a: jax.Array, c: jax.Array, log_ratio: jax.Array) -> jax.Array:
    """Return what a `_excess`(c / a) leaves of the divergence.

    The divergence is the Bregman one of lnGamma, log_ratio = log((a + c) / a). One step of the recurrence moves a to a
    + 1, where Stirling's series holds; no term exceeds the order of the result.
    """
    b = a + c
    p, q = 1 / (a + 1), 1 / (b + 1)
    log_next = jnp.log1p(c * p)  # log((b + 1) / (a + 1))
    half_log = _excess(-c * q, -log_next) / 2
    t = c * q / a
    shift = t * c / b - (a + 1) * _excess(t, log_ratio - log_next)
    # Divergences of x^-1, x^-3 and x^-5; 1/1680 instead of 1/1260 makes the cut series best over x >= 1.
    cubic = p * p + 2 * p * q + 3 * q * q
    quintic = p**4 + 2 * p**3 * q + 3 * p**2 * q**2 + 4 * p * q**3 + 5 * q**4
    return half_log + shift + c * c * p * q * q * (1 / 12 - cubic / 360 + quintic / 1680)


def update_kl(prior: jax.Array, counts: jax.Array) -> jax.Array:
    """Return KL(Dir(prior + counts) || Dir(prior)) for any counts.

    In nats, and accurate in float32 where differences of lnGamma are not. With g(a, c) = lnGamma(a) - lnGamma(a + c) +
    c psi(a + c), the Bregman divergence of lnGamma, the divergence is sum_j g(a_j, c_j) - g(a_0, N). The leading parts
    of both, a (u - log(1 + u)) with u = c / a, merge into sum_j a_j (v_j - log(1 + v_j)), 1 + v_j = posterior share /
    prior share: no term cancels.

    Args:
      prior: float32 [..., K], concentrations, 0.01 or more; 0 with count 0 leaves an entry out.
      counts: real [..., K], >= 0.

    Returns:
      float32 [...], relative error below 1e-3 (concentrations up to 2e4) wherever the divergence exceeds 1e-6.
    """
    counts = counts.astype(jnp.float32)
    a = jnp.where(prior > 0, prior, 1)
    a_0, n = prior.sum(-1, keepdims=True), counts.sum(-1, keepdims=True)
    log_a, log_0 = jnp.log1p(counts / a), jnp.log1p(n / a_0)
    v = (counts / a - n / a_0) / (1 + n / a_0)
    entries = prior * _excess(v, log_a - log_0) + _bregman_remainder(a, counts, log_a)
    return entries.sum(-1) - _bregman_remainder(a_0, n, log_0)[..., 0]


def presence_kl(prior: jax.Array, counts: jax.Array, increment: int) -> jax.Array:
    """Return `update_kl` where every count is 0 or `increment`.

    Several times faster, for the estimator's inner loop. For whole counts g(a, n) = sum_{i < n} [psi(a + n) - log(a +
    i)]: with a rational form of exp(psi) each term is the log of 1 + a positive number, and an entry's terms are
    multiplied out before the logarithm is taken.

    Args:
      prior: float32 [..., K], concentrations, 0.01 or more; 0 with count 0 leaves an entry out.
      counts: float32 [..., K], 0 or `increment`.
      increment: whole number from 1 to 50; the product overflows at more.

    Returns:
      float32 [...], >= 0; the error is below 2e-5 of the sum of the g(a_j, c_j).
    """
    a = jnp.maximum(prior, MIN_CONCENTRATION)
    x = a + (increment - 1)
    growth = jnp.zeros_like(a)  # exp(g(a, increment)) - 1
    for k in range(increment):
        # exp(psi(x + 1)) = x + P(x) / Q(x): exact to x^-1, fitted to 1.2e-5 of g(a, 1) over a >= 0.01; here P + k Q.
        numerator = ((0.5 + k) * x + (0.87228 + 1.66123 * k)) * x + (0.44703 + 0.79623 * k)
        denominator = (x + 1.66123) * x + 0.79623
        factor = numerator / (denominator * (a + (increment - 1 - k)))
        growth = growth + factor + growth * factor
    seen = counts > 0
    a_0, n = prior.sum(-1), increment * seen.sum(-1).astype(jnp.float32)
    log_0 = jnp.log1p(n / a_0)
    g = jnp.log1p(jnp.where(seen, growth, 0)).sum(-1)
    return jnp.maximum(g - a_0 * _excess(n / a_0, log_0) - _bregman_remainder(a_0, n, log_0), 0)
