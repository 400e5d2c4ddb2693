"""Alternative layout gaps: scores of how far the episode's layout differs from the training layout.

`learned_gap` adds up learned log odds of the pairs seen together, `surprise_gap` those of pairs seen near each other in
one view or several. `overdue_gap` grows as the goal fails to appear where the training layout would show it, and
`evidence_gap` is a z-test of the counts against layouts drawn from the prior.
All functions take the arrays of a single episode.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

#: Distances within which two categories count as near each other, metres.
NEAR_DISTANCES = (1.0, 2.0, 4.0, float("inf"))
#: Thresholds on the number of views with a relation; each is one feature. High ones guard against false alarms.
NEAR_VIEW_COUNTS = (1, 3, 8, 20)
#: R, the number of relations that are counted for a pair: near within each distance, and visible in one view.
NUM_SIGHTING_RELATIONS = len(NEAR_DISTANCES) + 1
#: F, the number of features of a pair.
NUM_NEAR_FEATURES = NUM_SIGHTING_RELATIONS * len(NEAR_VIEW_COUNTS)
#: Counts stop here: above the highest threshold, and within uint8.
_MAX_VIEW_COUNT = 200


class CooccurrenceEvidence(NamedTuple):
    """Evidence that pairs of categories seen together carry about the layout; learned before training.

    Attributes:
      log_odds: float32 [..., K, K], added to the log odds that the layout is not the training layout when a pair has
        been seen together; 0 on and below the diagonal, so that each pair counts once.
      co_visibility: float32 [..., K, K], in [0, 1], 0 on the diagonal; P(j visible | i visible) over the
        training poses.
      near_log_odds: float32 [..., F, K, K], log odds of the F features of `near_features`, used by `surprise_gap`; None
        in runs of earlier versions.
    """

    log_odds: jax.Array
    co_visibility: jax.Array
    near_log_odds: jax.Array | None = None


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
    return _shift_probability(co_seen, log_odds)


def _shift_probability(is_reached: jax.Array, log_odds: jax.Array) -> jax.Array:
    """Probability that the layout is not that of training, from features bool [...] with log odds float32 [...]."""
    return jax.nn.sigmoid(jnp.where(is_reached, log_odds, 0.0).sum())


class PairSightings(NamedTuple):
    """Where the categories were seen in one episode, and how often pairs of them were near each other.

    Attributes:
      offsets: float32 [K, 2], metres from the agent to the last detection of each category, along the axes of the
        compass.
      is_seen: bool [K], whether a category has been detected.
      counts: uint8 [R, K, K], at most 200. For each of `NEAR_DISTANCES`, the number of views that showed at least one
        of two categories while their last known places were within the distance; last, of views that showed both.
    """

    offsets: jax.Array
    is_seen: jax.Array
    counts: jax.Array

    @staticmethod
    def init(num_categories: int) -> "PairSightings":
        """Sightings before the first view."""
        counts_shape = (NUM_SIGHTING_RELATIONS, num_categories, num_categories)
        return PairSightings(
            offsets=jnp.zeros((num_categories, 2), jnp.float32),
            is_seen=jnp.zeros(num_categories, bool),
            counts=jnp.zeros(counts_shape, jnp.uint8),
        )

    def update(self, is_visible: jax.Array, offsets: jax.Array, motion: jax.Array) -> "PairSightings":
        """Add a view.

        Args:
          is_visible: bool [K], categories detected in the view.
          offsets: float32 [K, 2], metres from the agent to each detection, along the axes of the compass; read only
            for the visible categories.
          motion: float32 [2], metres that the agent has moved since the last view, along the same axes.
        """
        # Earlier detections move with the agent's frame; new ones replace them.
        offsets = jnp.where(is_visible[:, None], offsets, self.offsets - motion[None])
        is_seen = self.is_seen | is_visible

        # A view counts for the pairs of which it shows at least one category.
        distance = jnp.linalg.norm(offsets[:, None] - offsets[None], axis=-1)  # [K, K]
        is_counted = (is_visible[:, None] | is_visible[None]) & is_seen[:, None] & is_seen[None]
        is_near = is_counted[None] & (distance[None] <= jnp.array(NEAR_DISTANCES)[:, None, None])
        is_together = is_visible[:, None] & is_visible[None]
        is_related = jnp.concatenate([is_near, is_together[None]]) & (self.counts < _MAX_VIEW_COUNT)  # [R, K, K]
        return PairSightings(offsets, is_seen, self.counts + is_related.astype(jnp.uint8))


def near_features(counts: jax.Array) -> jax.Array:
    """Features of the counts of `PairSightings`: at least so many views with each relation.

    Args:
      counts: uint8 [..., R, K, K].

    Returns:
      bool [..., F, K, K], F = R times the number of `NEAR_VIEW_COUNTS`.
    """
    # [..., R, thresholds, K, K]
    is_reached = jnp.stack([counts >= threshold for threshold in NEAR_VIEW_COUNTS], axis=-3)
    return is_reached.reshape(*counts.shape[:-3], -1, *counts.shape[-2:])


def surprise_gap(counts: jax.Array, near_log_odds: jax.Array) -> jax.Array:
    """Return the gap D as the probability that the layout is not that of training, from where things were seen.

    The features of all pairs add up to the log odds z (prior odds of 1), and D = sigmoid(z). In contrast to
    `learned_gap`, pairs that are never in one view count too: odometry gives the distance of their detections.

    Args:
      counts: uint8 [R, K, K], of `PairSightings`.
      near_log_odds: float32 [F, K, K], of `CooccurrenceEvidence`.

    Returns:
      float32 [], in [0, 1]; 1/2 where no pair was seen.
    """
    return _shift_probability(near_features(counts), near_log_odds)


def overdue_gap(co_seen: jax.Array, co_visibility: jax.Array, goal: jax.Array | int) -> jax.Array:
    """Return the gap D as the probability that the goal would have been seen by now in the training layout.

    In the training layout, a view that shows category i also shows the goal with probability q_i. If these events are
    independent, the goal is missed next to every category seen so far with probability prod_i (1 - q_i), so
    D = 1 - prod_i (1 - q_i). D is 0 once the goal has been seen.

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
    """Return the gap D as a z-test of whether the episode's co-occurrences agree with the prior.

    Row i has the prior mean p_i = alpha*_i / a_i (a_i is the sum of the row) and, after n_i counts, the posterior mean
    q_i = alpha_i / (a_i + n_i). Their agreement is p_i . q_i, the probability that one draw from each is equal. Under
    layouts drawn from the prior, the agreement has mean p_i . p_i and variance n_i v_i / ((a_i + n_i) (a_i + 1)), where
    v_i is the variance of p_ij for j drawn from p_i. So

      z = sum_i (p_i . p_i - p_i . q_i) / sum_i sqrt(n_i v_i / ((a_i + n_i) (a_i + 1))).

    The denominator adds standard deviations, an upper bound that fully correlated rows reach. The gap is
    D = max(erf(z / sqrt 2), 0) = max(2 P - 1, 0), where P is the probability (normal approximation) that a layout drawn
    from the prior agrees better.

    Args:
      prior: float32 [K, K], alpha*, 0 on the diagonal.
      alpha: float32 [K, K], the belief, >= alpha*; the diagonal is ignored.

    Returns:
      float32 [], in [0, 1] (1 only by rounding); 0 where no counts were added, below 0.01 where prior rows are uniform.
    """
    counts = (alpha - prior) * (1 - jnp.eye(len(prior), dtype=jnp.float32))
    prior_sum = prior.sum(-1)  # a_i
    num_counts = counts.sum(-1)  # n_i
    prior_share = prior / prior_sum[:, None]  # p_ij

    # Per row: shortfall of the agreement, p_i . p_i - p_i . q_i, and its standard deviation.
    entry_shortfall = (prior_share * prior_share).sum(-1, keepdims=True) - prior_share
    row_shortfall = (counts * entry_shortfall).sum(-1) / (prior_sum + num_counts)
    share_variance = (prior_share * entry_shortfall**2).sum(-1)
    row_std = jnp.sqrt(num_counts * share_variance / ((prior_sum + num_counts) * (prior_sum + 1)))

    # With uniform rows, numerator and denominator are 0 up to rounding (1e-7); the lower bound avoids 0 / 0.
    z = row_shortfall.sum() / jnp.maximum(row_std.sum(), 1e-5)
    return jnp.maximum(jax.lax.erf(z * 0.5**0.5), 0)
