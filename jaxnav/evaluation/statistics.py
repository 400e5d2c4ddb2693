"""Statistics with 95 % intervals over scenes and training runs.

Results are crossed: every training run meets the same episodes, and the episodes of a scene are alike. An interval asks
whether other training runs, in other scenes of these room types, would agree, so its units are scenes and runs, not
episodes. A statistic is computed again without each scene, without each run and without both: a jackknife. Its
variance is that of a crossed design, its degrees of freedom those of Satterthwaite (1946). For means of equally many
episodes a scene it is the analysis of variance of the crossed random-effects model. See docs/statistics.md.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from jaxnav.errors import InputError

#: Degrees of freedom below which scenes give no interval: three scenes, or more where there are room types.
LEAST_SCENES = 2


@dataclasses.dataclass(frozen=True)
class Interval:
    """Hold a statistic and its 95 % interval.

    `f"{interval:+.1f}"` gives "+1.0 [+0.5, +1.5]", "+1.0 [-]" without bounds and "-" without a mean.

    Attributes:
      mean: the statistic; NaN where it is undefined.
      low, high: bounds; NaN where scenes or training runs are too few for them.
      std: standard deviation (ddof = 1) over training runs; NaN for fewer than two.
      seeds: the statistic of each training run, where it is kept.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan
    std: float = math.nan
    seeds: tuple[float, ...] = ()

    @property
    def bounded(self) -> bool:
        """Return whether there are bounds."""
        return not math.isnan(self.low)

    def __format__(self, spec: str) -> str:
        if math.isnan(self.mean):
            return "-"
        return f"{self.mean:{spec}} [{f'{self.low:{spec}}, {self.high:{spec}}' if self.bounded else '-'}]"

    def __neg__(self) -> "Interval":
        return Interval(-self.mean, -self.high, -self.low)

    def __sub__(self, level: float) -> "Interval":
        return Interval(self.mean - level, self.low - level, self.high - level)

    def __rsub__(self, level: float) -> "Interval":
        return Interval(level - self.mean, level - self.high, level - self.low)  # 0 without a sign

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON; what is undefined is null."""
        mean, low, high, std = (None if math.isnan(x) else x for x in (self.mean, self.low, self.high, self.std))
        kept = {"seeds": list(self.seeds)} if self.seeds else {}
        return {"mean": mean, "std": std, "ci95": [low, high] if self.bounded else None, **kept}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Interval":
        """Return it from JSON; `std` and `seeds` may be missing."""
        mean, std, *bounds = (
            math.nan if x is None else x for x in (data["mean"], data.get("std"), *(data["ci95"] or (None, None)))
        )
        return cls(mean, *bounds, std=std, seeds=tuple(data.get("seeds", ())))


class Clusters(NamedTuple):
    """Hold which of N items are left out together.

    Attributes:
      weights: float64 [N, 1 + C], how much each item counts: 1 in column 0; without cluster c in column 1 + c, where
        the others of its stratum count the more, so that a stratum keeps its weight.
      scale: float64 [C], (n - 1) / n for a cluster of a stratum of n.
      degrees: of freedom, clusters less strata.
    """

    weights: np.ndarray
    scale: np.ndarray
    degrees: int


def leave_one_out(labels: np.ndarray, strata: np.ndarray | None = None, counts: np.ndarray | None = None) -> Clusters:
    """Leave out one cluster after the other.

    Args:
      labels: [N], cluster of each item.
      strata: [N], stratum of each item, the same in all of a cluster; None for a single one.
      counts: [N], how much each item weighs; None for equal ones.
    """
    labels = np.asarray(labels)
    strata = np.zeros(len(labels), int) if strata is None else np.unique(strata, return_inverse=True)[1]
    clusters, first, of = np.unique(labels, return_index=True, return_inverse=True)
    stratum = strata[first]
    inside, together = strata[:, None] == stratum, of[:, None] == np.arange(len(clusters))  # [N, C]
    counts = np.ones(len(labels)) if counts is None else counts
    items, others = counts @ inside, counts @ (inside & ~together)
    gained = np.divide(items, others, out=np.zeros(len(clusters)), where=others > 0)
    left = np.where(together, 0.0, np.where(inside, gained, 1.0))
    size = np.bincount(stratum)[stratum]
    return Clusters(
        weights=np.concatenate([np.ones((len(labels), 1)), left], axis=1),
        scale=(size - 1) / size,
        degrees=len(clusters) - len(np.unique(stratum)),
    )


def scene_clusters(plans: np.ndarray, rooms: np.ndarray, counts: np.ndarray | None = None) -> Clusters:
    """Leave out scenes, by floor plan and within room types.

    A single floor plan of a room type shows no variance; where there is one, all room types are one stratum.

    Args:
      plans: [N], floor plan of each item.
      rooms: [N], room type of each item.
      counts: [N], how much each item weighs; None for equal ones.
    """
    alone = min(len(set(plans[rooms == room])) for room in set(rooms.tolist())) < 2
    return leave_one_out(plans, None if alone else rooms, counts)


def training_runs(arms: int, seeds: int) -> Clusters:
    """Leave out training runs; items are [arms * seeds]."""
    return leave_one_out(np.arange(arms * seeds), np.repeat(np.arange(arms), seeds))


def jackknife(replicates: np.ndarray, scenes: Clusters, runs: Clusters | None = None, **known: Any) -> Interval:
    """Return the interval of a statistic.

    Args:
      replicates: float64 [1 + R, 1 + C], the statistic under each column of the weights of runs and scenes; [1 + C]
        where no training varies.
      scenes: the C scenes.
      runs: the R training runs; None where no training varies.
      known: `std` and `seeds` of the interval.
    """
    grid = np.atleast_2d(replicates)
    whole = float(grid[0, 0])
    if scenes.degrees < LEAST_SCENES or (runs is not None and runs.degrees < 1):
        return Interval(whole, **known)
    by_scene = float(scenes.scale @ (grid[0, 1:] - whole) ** 2)
    variance, degrees = by_scene, float(scenes.degrees)
    if runs is not None:
        by_run = float(runs.scale @ (grid[1:, 0] - whole) ** 2)
        crossed = grid[1:, 1:] - grid[1:, :1] - grid[:1, 1:] + whole
        # What scenes and runs do together is in both variances, so one of the two is taken off.
        both = float(runs.scale @ crossed**2 @ scenes.scale)
        variance = max(by_scene + by_run - both, by_scene, by_run)
        degrees = _satterthwaite(
            variance,
            (by_scene, by_run, both),
            (scenes.degrees, runs.degrees, scenes.degrees * runs.degrees),
        )
    half = float(stdtrit(degrees, 0.975)) * math.sqrt(variance)
    return Interval(whole, whole - half, whole + half, **known)


def summary(values: np.ndarray, scenes: Clusters, *, trained: bool = True) -> Interval:
    """Return the mean of results with its interval.

    Args:
      values: bool, int or float [S, E], finite, by training run and episode.
      scenes: of the E episodes.
      trained: whether rows are training runs; else they are repetitions, of which the mean is taken.

    Raises:
      InputError: wrong or empty shapes, or NaN or infinite values.
    """
    values = _checked("values", values, scenes)
    if not trained:
        return jackknife(values.mean(axis=0) @ scenes.weights / values.shape[1], scenes)
    return _mean(values, scenes, training_runs(1, len(values)), values.mean(axis=1))


def paired_difference(
    a: np.ndarray, b: np.ndarray, scenes: Clusters, *, same_runs: bool = False, trained: bool = True
) -> Interval:
    """Return the mean of `b - a` on the same episodes.

    Both share the scenes, so that their difficulty cancels.

    Args:
      a: bool, int or float [S, E], finite; the reference.
      b: the same shape; what is compared with it.
      scenes: of the E episodes.
      same_runs: whether row s of both is the same network (sTDE against no removal). If not, the runs of a and b were
        trained apart: `std` is sqrt(std_a^2 + std_b^2), and there are no `seeds`.
      trained: whether other training runs count; else the interval is that of these policies in other scenes.

    Raises:
      InputError: as `summary`, or shapes of `a` and `b` that differ.
    """
    a, b = _checked("a", a, scenes), _checked("b", b, scenes)
    if a.shape != b.shape:
        raise InputError(f"a {a.shape} and b {b.shape} differ in shape; evaluate both on the same runs and episodes")
    if not trained:
        return summary(b - a, scenes, trained=False)
    if same_runs:
        return _mean(b - a, scenes, training_runs(1, len(a)), (b - a).mean(axis=1))
    runs = training_runs(2, len(a))
    std = math.hypot(_std(a.mean(axis=1)), _std(b.mean(axis=1)))
    return dataclasses.replace(_mean(2.0 * np.concatenate([-a, b]), scenes, runs, None), std=std)


def _mean(values: np.ndarray, scenes: Clusters, runs: Clusters, seeds: np.ndarray | None) -> Interval:
    replicates = runs.weights.T @ values @ scenes.weights / values.size
    known = {} if seeds is None else {"std": _std(seeds), "seeds": tuple(seeds.tolist())}
    return jackknife(replicates, scenes, runs, **known)


def _checked(name: str, values: np.ndarray, scenes: Clusters) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; give [runs, episodes] with at least one of each")
    if values.shape[1] != len(scenes.weights):
        raise InputError(
            f"{name} has {values.shape[1]} episodes and scenes {len(scenes.weights)}; give as many of each"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds NaN or infinite results; give every episode a finite value")
    return values


def _std(means: np.ndarray) -> float:
    return float(means.std(ddof=1)) if len(means) > 1 else math.nan


def _satterthwaite(variance: float, parts: tuple[float, ...], degrees: tuple[int, ...]) -> float:
    """Return the degrees of freedom of a sum of variances."""
    spread = sum(part**2 / of for part, of in zip(parts, degrees, strict=True))
    least = float(min(degrees))
    return max(variance**2 / spread, least) if spread > 0 else least
