"""Layout gaps beside equation 5's: how surely what was seen does not fit the layout of training."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Signs(NamedTuple):
    """Hold what sightings tell; learned before training.

    Attributes:
      odds: float32 [..., K, K], 0 on and below the diagonal; the log odds that a pair seen together adds for another
        layout than that of training.
      chance: float32 [..., K, K], in [0, 1], 0 on the diagonal; in the layout of training the share of the poses
        showing i that show j too.
    """

    odds: jax.Array
    chance: jax.Array


def seen_together(presence: jax.Array) -> jax.Array:
    """Return which categories views show together.

    Args:
      presence: bool [T, K], the views.

    Returns:
      bool [K, K]; on the diagonal those seen at all.
    """
    return (presence[:, :, None] & presence[:, None, :]).any(axis=0)


def learned_gap(together: jax.Array, odds: jax.Array) -> jax.Array:
    """Return the gap D by learned signs of another layout.

    The pairs seen together so far add up to the log odds z, p = sigmoid(z) is the probability that the layout is not
    that of training (both being as likely before), and D = p. In the paper's form of eq. 2 without a threshold
    experience is then weighed by the probability that it holds.

    Args:
      together: bool [K, K], see `seen_together`.
      odds: float32 [K, K], of `Signs`.

    Returns:
      float32 [], in [0, 1]; 1/2 where nothing was seen together.
    """
    return jax.nn.sigmoid(jnp.where(together, odds, 0.0).sum())


def overdue_gap(together: jax.Array, chance: jax.Array, goal: jax.Array | int) -> jax.Array:
    """Return the gap D that grows as experience fails.

    In the layout of training the views that show category i show the goal with probability q_i. The goal is missed
    beside all categories seen so far, taken as independent, with probability prod_i (1 - q_i). So D = 1 - prod_i
    (1 - q_i) is the probability that it would have been seen by now. Once it has been seen D is 0.

    Args:
      together: bool [K, K], see `seen_together`; only the diagonal is read.
      chance: float32 [K, K], of `Signs`; q_i is the goal's column.
      goal: int [].

    Returns:
      float32 [], in [0, 1].
    """
    seen = jnp.diagonal(together)
    missed = jnp.where(seen, 1 - chance[:, goal], 1.0).prod()
    return jnp.where(seen[goal], 0.0, 1 - missed)


def evidence_gap(prior: jax.Array, alpha: jax.Array) -> jax.Array:
    """Return the gap D by the evidence of an episode.

    It says how far what was seen together falls short of agreeing with the prior. With the expected shares p_i =
    alpha*_i / a_i before and q_i = alpha_i / (a_i + n_i) after n_i sightings, row i agrees by p_i . q_i, the
    probability that one draw of each is alike. For layouts drawn from the prior that has mean p_i . p_i and variance
    n_i v_i / ((a_i + n_i) (a_i + 1)), where v_i is the variance of p_ij, j drawn from p_i. So

      z = sum_i (p_i . p_i - p_i . q_i) / sum_i sqrt(n_i v_i / ((a_i + n_i) (a_i + 1))),

    the denominator being the standard deviation if rows are fully correlated, its upper bound, and D = erf(z / sqrt 2)
    or 0 where z < 0: 2 P - 1, P the probability (normal approximation) that the prior's own layouts agree better.

    Args:
      prior: float32 [K, K], alpha*, 0 on the diagonal.
      alpha: float32 [K, K], the belief, >= alpha*; the diagonal is ignored.

    Returns:
      float32 [], in [0, 1] (1 only by rounding); 0 where nothing was gained, below 0.01 where prior rows are uniform.
    """
    seen = (alpha - prior) * (1 - jnp.eye(len(prior), dtype=jnp.float32))
    a, n = prior.sum(-1), seen.sum(-1)
    p = prior / a[:, None]
    shortfall = (p * p).sum(-1, keepdims=True) - p
    excess = (seen * shortfall).sum(-1) / (a + n)
    deviation = jnp.sqrt(n * (p * shortfall**2).sum(-1) / ((a + n) * (a + 1)))
    # Where rows are uniform both are 0 up to rounding (1e-7), which the bound keeps out of the ratio.
    z = excess.sum() / jnp.maximum(deviation.sum(), 1e-5)
    return jnp.maximum(jax.lax.erf(z * 0.5**0.5), 0)
