"""Means with 95 % intervals."""

import dataclasses
import math

import numpy as np

from jaxnav.evaluation.statistics import Summary


@dataclasses.dataclass(frozen=True)
class Interval:
    """Hold a mean and its 95 % interval.

    All three are NaN where the mean is undefined. `f"{interval:+.1f}"` gives "+1.0 [+0.5, +1.5]".
    """

    mean: float
    low: float
    high: float

    @property
    def defined(self) -> bool:
        """Return whether there is a mean."""
        return not math.isnan(self.mean)

    def __format__(self, spec: str) -> str:
        if not self.defined:
            return "undefined"
        return f"{self.mean:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"

    def __neg__(self) -> "Interval":
        return Interval(-self.mean, -self.high, -self.low)

    def __sub__(self, level: float) -> "Interval":
        return Interval(self.mean - level, self.low - level, self.high - level)

    def __rsub__(self, level: float) -> "Interval":
        return Interval(level - self.mean, level - self.high, level - self.low)


UNDEFINED = Interval(math.nan, math.nan, math.nan)


@dataclasses.dataclass(frozen=True)
class Effect(Interval):
    """Hold the difference between two variants.

    Attributes:
      std: sample standard deviation over training seeds.
    """

    std: float

    @classmethod
    def of(cls, summary: Summary) -> "Effect":
        """Return a summary as an effect."""
        return cls(summary.mean, *summary.ci95, summary.std)


@dataclasses.dataclass(frozen=True)
class Estimate(Interval):
    """Hold a metric of one variant.

    Attributes:
      std: sample standard deviation over training seeds.
      seeds: mean of each training seed.
    """

    std: float
    seeds: tuple[float, ...]

    @classmethod
    def of(cls, summary: Summary, values: np.ndarray) -> "Estimate":
        """Return the estimate of values [S, E] from their summary."""
        return cls(summary.mean, *summary.ci95, summary.std, tuple(values.mean(axis=1).tolist()))


def percentile_interval(values: np.ndarray) -> Interval:
    """Return the percentile interval of a bootstrap.

    Args:
      values: float64 [1 + R], the statistic of the data, then of its resamples; NaN where undefined.
    """
    defined = values[1:][np.isfinite(values[1:])]
    if not (np.isfinite(values[0]) and len(defined)):
        return UNDEFINED
    low, high = np.percentile(defined, (2.5, 97.5)).tolist()
    return Interval(float(values[0]), low, high)
