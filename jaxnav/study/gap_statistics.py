"""Mean and AUC of the layout gap at each step."""

from collections.abc import Callable

import numpy as np

from jaxnav.study.bootstrap import RESAMPLES, scene_draws, stratified_draws, weight_below
from jaxnav.study.curves import Curve
from jaxnav.study.intervals import percentile_interval
from jaxnav.study.tracking import GapTraces


def auc_by_step(
    shifted: GapTraces, unshifted: GapTraces, generator: np.random.Generator, resamples: int = RESAMPLES
) -> Curve:
    """Return the AUC of the gap, shifted against unshifted episodes.

    At each step it is over the episodes that still run. A resample draws scenes within each room type, twins together,
    and policies, which both sides share.

    Args:
      shifted: traces at the greater shift.
      unshifted: of the same policies, settings and number of steps, at the smaller one.
      generator: source of the resamples.
      resamples: their number.

    Returns:
      Leaves [settings, 2, T + 1]; NaN where nothing runs.
    """
    return _by_step(weighted_auc, [shifted, unshifted], generator, resamples)


def mean_by_step(traces: GapTraces, generator: np.random.Generator, resamples: int = RESAMPLES) -> Curve:
    """Return the mean gap over the episodes that still run.

    Args:
      traces: the gaps.
      generator: source of the resamples, drawn as in `auc_by_step`.
      resamples: their number.

    Returns:
      Leaves [settings, 2, T + 1]; NaN where nothing runs.
    """
    return _by_step(_weighted_mean, [traces], generator, resamples)


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


def _by_step(
    statistic: Callable[..., np.ndarray], sides: list[GapTraces], generator: np.random.Generator, resamples: int
) -> Curve:
    """Return a statistic of all sides at each step.

    The weight of an episode in a resample is how often its scene is drawn times how often its policy is.
    """
    policies = stratified_draws(np.zeros(len(sides[0].running)), generator, resamples).astype(np.float32)
    draws = [
        policies[:, None] * scenes for scenes in scene_draws([side.episodes for side in sides], generator, resamples)
    ]
    settings, beliefs, *_, steps = sides[0].gap.shape
    leaves = np.empty((3, settings, beliefs, steps))
    for step in range(steps):
        running = [side.running[..., step] for side in sides]
        weights = [draw[runs] for draw, runs in zip(draws, running, strict=True)]
        for setting, belief in np.ndindex(settings, beliefs):
            gaps = [side.gap[setting, belief, ..., step][runs] for side, runs in zip(sides, running, strict=True)]
            interval = percentile_interval(statistic(*gaps, *weights))
            leaves[:, setting, belief, step] = interval.mean, interval.low, interval.high
    return Curve(*leaves)
