"""Mean and AUC of the layout gap at each step."""

from collections.abc import Callable

import numpy as np

from jaxnav.evaluation.episodes import clusters_of
from jaxnav.evaluation.statistics import jackknife, training_runs
from jaxnav.study.curves import Curve
from jaxnav.study.ranks import weight_below
from jaxnav.study.tracking import GapTraces


def auc_by_step(shifted: GapTraces, unshifted: GapTraces) -> Curve:
    """Return the AUC of the gap, shifted against unshifted episodes.

    At each step it is over the episodes that still run. Both sides share scenes and policies.

    Args:
      shifted: traces at the greater shift.
      unshifted: of the same policies, settings and number of steps, at the smaller one.

    Returns:
      Leaves [settings, 2, T + 1]; NaN where nothing runs.
    """
    return _by_step(weighted_auc, [shifted, unshifted])


def mean_by_step(traces: GapTraces) -> Curve:
    """Return the mean gap over the episodes that still run.

    Args:
      traces: the gaps.

    Returns:
      Leaves [settings, 2, T + 1]; NaN where nothing runs.
    """
    return _by_step(_weighted_mean, [traces])


def weighted_auc(positive: np.ndarray, negative: np.ndarray, weights: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the area under the ROC curve.

    It is the probability that a positive value exceeds a negative one, ties counted half.

    Args:
      positive, negative: real [P] and [Q].
      weights, others: float [P, R] and [Q, R], of the positive and of the negative values.

    Returns:
      float64 [R]; NaN where the weights of one side are 0.
    """
    wins = np.einsum("pr,pr->r", weights, weight_below(positive, negative, others), dtype=np.float64)
    return _ratio(wins, weights.sum(axis=0, dtype=np.float64) * others.sum(axis=0, dtype=np.float64))


def _weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return means [R] of values [P] weighted by [P, R]."""
    return _ratio((values @ weights).astype(np.float64), weights.sum(axis=0, dtype=np.float64))


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)


def _by_step(statistic: Callable[..., np.ndarray], sides: list[GapTraces]) -> Curve:
    """Return a statistic of all sides at each step.

    An episode walked by a policy counts as its scene does times as the policy does.
    """
    runs, clusters = training_runs(1, len(sides[0].running)), clusters_of([side.episodes for side in sides])
    shape = (runs.weights.shape[1], clusters[0].weights.shape[1])
    weights = [
        np.einsum("nr,ec->nerc", runs.weights, scenes.weights).reshape(*side.running.shape[:2], -1)
        for scenes, side in zip(clusters, sides, strict=True)
    ]
    settings, beliefs, *_, steps = sides[0].gap.shape
    leaves = np.empty((3, settings, beliefs, steps))
    for step in range(steps):
        running = [side.running[..., step] for side in sides]
        counted = [weight[now] for weight, now in zip(weights, running, strict=True)]
        for setting, belief in np.ndindex(settings, beliefs):
            gaps = [side.gap[setting, belief, ..., step][now] for side, now in zip(sides, running, strict=True)]
            interval = jackknife(statistic(*gaps, *counted).reshape(shape), clusters[0], runs)
            leaves[:, setting, belief, step] = interval.mean, interval.low, interval.high
    return Curve(*leaves)
