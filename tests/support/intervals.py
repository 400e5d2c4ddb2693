"""Intervals worked out another way: variances by hand, plain loops."""

import math
from collections.abc import Callable

import numpy as np
from scipy.stats import t

from jaxnav.evaluation.statistics import Interval

Statistic = Callable[[int | None, int | None], float]


def bounds(interval: Interval) -> tuple[float, float, float]:
    """Return mean, low and high."""
    return interval.mean, interval.low, interval.high


def around(mean: float, variance: float, degrees: float) -> tuple[float, float, float]:
    """Return a mean with the bounds of Student's t."""
    half = float(t.ppf(0.975, degrees)) * math.sqrt(variance)
    return mean, mean - half, mean + half


def left_out(statistic: Statistic, scenes: int, seeds: int, arms: int = 1) -> tuple[float, float, float]:
    """Return a statistic and its interval by two-way jackknife.

    Scenes are of one room type, and each has a floor plan of its own.

    Args:
      statistic: without a scene and without a training run; None where none is left out.
      scenes: number of scenes.
      seeds: training runs of each arm, numbered arm after arm.
      arms: trained apart.
    """
    whole, runs = statistic(None, None), range(arms * seeds)
    alone = {scene: statistic(scene, None) for scene in range(scenes)}
    trained = {run: statistic(None, run) for run in runs}
    crossed = [statistic(scene, run) - alone[scene] - trained[run] + whole for scene in range(scenes) for run in runs]
    few, many = (scenes - 1) / scenes, (seeds - 1) / seeds
    by_scene = few * sum((value - whole) ** 2 for value in alone.values())
    by_run = many * sum((value - whole) ** 2 for value in trained.values())
    both = few * many * sum(value**2 for value in crossed)
    variance = max(by_scene + by_run - both, by_scene, by_run)
    of_scenes, of_runs = scenes - 1, arms * (seeds - 1)
    spread = by_scene**2 / of_scenes + by_run**2 / of_runs + both**2 / (of_scenes * of_runs)
    degrees = np.clip(variance**2 / spread, min(of_scenes, of_runs), of_scenes + of_runs)
    return around(whole, variance, float(degrees))
