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


def student_interval(mean: float, variance: float, degrees: float) -> tuple[float, float, float]:
    """Return a mean with the bounds of Student's t."""
    half = float(t.ppf(0.975, degrees)) * math.sqrt(variance)
    return mean, mean - half, mean + half


def two_way_jackknife_interval(
    statistic: Statistic, scenes: int, seeds: int, arms: int = 1
) -> tuple[float, float, float]:
    """Return a statistic and its interval by two-way jackknife.

    Scenes are of one room type, and each has a floor plan of its own.

    Args:
      statistic: without a scene and without a training run; None where none is left out.
      scenes: number of scenes.
      seeds: training runs of each arm, numbered arm after arm.
      arms: trained apart.
    """
    runs = range(arms * seeds)
    whole = statistic(None, None)

    # Sums of squares of the deviations: by scene, by run, and of what remains for both.
    without_scene = {scene: statistic(scene, None) for scene in range(scenes)}
    without_run = {run: statistic(None, run) for run in runs}
    crossed_squares = 0.0
    for scene in range(scenes):
        for run in runs:
            deviation = statistic(scene, run) - without_scene[scene] - without_run[run] + whole
            crossed_squares += deviation**2
    scene_share = (scenes - 1) / scenes
    run_share = (seeds - 1) / seeds
    by_scene = scene_share * sum((value - whole) ** 2 for value in without_scene.values())
    by_run = run_share * sum((value - whole) ** 2 for value in without_run.values())
    crossed = scene_share * run_share * crossed_squares
    variance = max(by_scene + by_run - crossed, by_scene, by_run)

    # Degrees of freedom by Satterthwaite.
    scene_degrees = scenes - 1
    run_degrees = arms * (seeds - 1)
    spread = by_scene**2 / scene_degrees + by_run**2 / run_degrees + crossed**2 / (scene_degrees * run_degrees)
    degrees = np.clip(variance**2 / spread, min(scene_degrees, run_degrees), scene_degrees + run_degrees)
    return student_interval(whole, variance, float(degrees))
