"""Layout gaps other than that of equation 5: scores that the episode's layout differs from that of training.

`learned_gap` adds up learned log odds of the pairs seen together, `overdue_gap` grows as the goal fails to appear where
the training layout would show it, and `evidence_gap` is a z-test of the counts against layouts drawn from the prior.
All handle one episode.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class CooccurrenceEvidence(NamedTuple):
    """Evidence that pairs of categories seen together carry about the layout; learned before training.

    Attributes:
      log_odds: float32 [..., K, K], 0 on and below the diagonal, so that each pair counts once; what a pair seen
        together adds to the log odds of another layout than that of training.
      co_visibility: float32 [..., K, K], in [0, 1], 0 on the diagonal; P(j visible | i visible) over the
        training poses.
    """

    log_odds: jax.Array
    co_visibility: jax.Array


def seen_together(presence: jax.Array) -> jax.Array:
    """Return the pairs of categories that some view shows together.

    Args:
      presence: bool [T, K], the views.

    Returns:
      bool [K, K]; on the diagonal the categories seen at all.
    """
    return (presence[:, :, None] & presence[:, None, :]).any(axis=0)


def learned_gap(co_seen: jax.Array, log_odds: jax.Array) -> jax.Array:
    """Return the gap D as the probability that the layout is not that of training.

    The pairs seen together so far add up to the log odds z (prior odds of 1), and D = sigmoid(z).

    Args:
      co_seen: bool [K, K], see `seen_together`.
      log_odds: float32 [K, K], of `CooccurrenceEvidence`.

    Returns:
      float32 [], in [0, 1]; 1/2 where no pair was seen.
    """
    return jax.nn.sigmoid(jnp.where(co_seen, log_odds, 0.0).sum())


def overdue_gap(co_seen: jax.Array, co_visibility: jax.Array, goal: jax.Array | int) -> jax.Array:
    """Return the gap D as the probability that the goal would have been seen by now in the training layout.

    There the views that show category i show the goal with probability q_i. The goal is missed beside all categories
    seen so far, taken as independent, with probability prod_i (1 - q_i), so D = 1 - prod_i (1 - q_i). Once the goal has
    been seen D is 0.

    Args:
      co_seen: bool [K, K], see `seen_together`; only the diagonal is read.
      co_visibility: float32 [K, K], of `CooccurrenceEvidence`; q_i is the goal's column.
      goal: int [].

    Returns:
      float32 [], in [0, 1].
    """
    is_seen = jnp.diagonal(co_seen)
    miss_prob = jnp.where(is_seen, 1 - co_visibility[:, goal], 1.0).prod()
    return jnp.where(is_seen[goal], 0.0, 1 - miss_prob)


def evidence_gap(prior: jax.Array, alpha: jax.Array) -> jax.Array:
    """Return the gap D by the evidence of an episode: how far its co-occurrences fall short of agreeing with the prior.

    With the expected shares p_i = alpha*_i / a_i before and q_i = alpha_i / (a_i + n_i) after n_i counts, row i agrees
    by p_i . q_i, the probability that one draw of each is alike. For layouts drawn from the prior that has mean p_i .
    p_i and variance n_i v_i / ((a_i + n_i) (a_i + 1)), where v_i is the variance of p_ij, j drawn from p_i. So

      z = sum_i (p_i . p_i - p_i . q_i) / sum_i sqrt(n_i v_i / ((a_i + n_i) (a_i + 1))),

    the denominator being the standard deviation if rows are fully correlated, its upper bound, and D = erf(z / sqrt 2),
    or 0 where z < 0: 2 P - 1, P the probability (normal approximation) that the prior's own layouts agree better.

    Args:
      prior: float32 [K, K], alpha*, 0 on the diagonal.
      alpha: float32 [K, K], the belief, >= alpha*; the diagonal is ignored.

    Returns:
      float32 [], in [0, 1] (1 only by rounding); 0 where no counts were added, below 0.01 where prior rows are uniform.
    """
    counts = (alpha - prior) * (1 - jnp.eye(len(prior), dtype=jnp.float32))
    strength = prior.sum(-1)  # a_i
    num_counts = counts.sum(-1)  # n_i
    share = prior / strength[:, None]  # p_ij

    # Per row: by how much the agreement is short of its mean, and its standard deviation.
    shortfall = (share * share).sum(-1, keepdims=True) - share
    excess = (counts * shortfall).sum(-1) / (strength + num_counts)
    share_variance = (share * shortfall**2).sum(-1)
    deviation = jnp.sqrt(num_counts * share_variance / ((strength + num_counts) * (strength + 1)))

    # Where rows are uniform both are 0 up to rounding (1e-7), which the bound keeps out of the ratio.
    z = excess.sum() / jnp.maximum(deviation.sum(), 1e-5)
    return jnp.maximum(jax.lax.erf(z * 0.5**0.5), 0)
