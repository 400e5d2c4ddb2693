"""Means and paired differences with 95 % intervals over scenes and training runs.

Results are crossed: every training run meets the same episodes, and episodes of one scene resemble each other. An
interval asks whether other training runs in other scenes of these room types would agree, so its units are scenes and
runs, not episodes. A jackknife recomputes the statistic without each scene, without each run and without both. The
variance is that of a crossed design, with the degrees of freedom of Satterthwaite (1946). For means of equally many
episodes per scene, this is the analysis of variance of the crossed random-effects model. See docs/statistics.md.

`mean_interval` and `paired_difference` cover results by run and episode. For other statistics, compute one replicate
for each column of the weights of `scene_clusters` and `run_clusters`, and pass them to `jackknife_interval`.
`SharedDesign` does so for several conditions that share scenes and runs.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from jaxnav.errors import InputError
from jaxnav.scenes.scene import floor_plan_name

#: Scenes give an interval from this many degrees of freedom on: three scenes, or more with several room types.
MIN_SCENE_DEGREES = 2

#: Correlations beyond this count as this, because Fisher's z of 1 is infinite.
_MAX_CORRELATION = 1 - 1e-12


@dataclasses.dataclass(frozen=True)
class Interval:
    """A statistic and its 95 % interval.

    `f"{interval:+.1f}"` gives "+1.0 [+0.5, +1.5]", "+1.0 [-]" without bounds and "-" without a mean.

    Attributes:
      mean: the statistic; NaN if undefined.
      low, high: bounds; NaN with too few scenes or training runs.
      std: standard deviation (ddof = 1) over training runs; NaN for fewer than two.
      seeds: the statistic of each training run; empty if not recorded.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan
    std: float = math.nan
    seeds: tuple[float, ...] = ()

    @property
    def has_bounds(self) -> bool:
        """True if the interval has bounds."""
        return not math.isnan(self.low)

    def __format__(self, spec: str) -> str:
        if math.isnan(self.mean):
            return "-"
        bounds = f"{self.low:{spec}}, {self.high:{spec}}" if self.has_bounds else "-"
        return f"{self.mean:{spec}} [{bounds}]"

    # Mirrored and shifted intervals serve verdicts, which read the bounds alone: `std` and `seeds` are left out.

    def __neg__(self) -> "Interval":
        return Interval(-self.mean, -self.high, -self.low)

    def __sub__(self, level: float) -> "Interval":
        return Interval(self.mean - level, self.low - level, self.high - level)

    def __rsub__(self, level: float) -> "Interval":
        return Interval(level - self.mean, level - self.high, level - self.low)  # -interval + level would give -0.0

    def to_json(self) -> dict[str, Any]:
        """Convert to JSON; undefined values are null."""
        interval_data: dict[str, Any] = {
            "mean": _nan_to_null(self.mean),
            "std": _nan_to_null(self.std),
            "ci95": [self.low, self.high] if self.has_bounds else None,
        }
        if self.seeds:
            interval_data["seeds"] = list(self.seeds)
        return interval_data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Interval":
        """Read an interval from JSON; `std` and `seeds` may be missing."""
        low, high = data["ci95"] or (None, None)
        return cls(
            mean=_null_to_nan(data["mean"]),
            low=_null_to_nan(low),
            high=_null_to_nan(high),
            std=_null_to_nan(data.get("std")),
            seeds=tuple(data.get("seeds", ())),
        )


def _nan_to_null(value: float) -> float | None:
    return None if math.isnan(value) else value


def _null_to_nan(value: float | None) -> float:
    return math.nan if value is None else value


class Clusters(NamedTuple):
    """Leave-one-out weights of N items in C clusters.

    Attributes:
      weights: float64 [N, 1 + C], weight of each item. Column 0 holds ones. In column 1 + c, the items of cluster c
        weigh 0, and the remaining items of its stratum weigh more, so that the stratum keeps its weight.
      scale: float64 [C], (n - 1) / n for a cluster of a stratum of n clusters.
      degrees_of_freedom: number of clusters minus number of strata.
    """

    weights: np.ndarray
    scale: np.ndarray
    degrees_of_freedom: float


def mean_interval(values: np.ndarray, scenes: Clusters, *, trained: bool = True) -> Interval:
    """Compute the mean of results with its interval.

    Args:
      values: bool, int or float [S, E], finite, by training run and episode.
      scenes: clusters of the E episodes.
      trained: True if rows are training runs; False if they are repetitions, which are averaged.

    Raises:
      InputError: wrong or empty shapes, or NaN or infinite values.
    """
    values = _as_finite_results("values", values, scenes)

    # Repetitions are no units of the interval, so they are averaged away and only scenes are left out.
    if not trained:
        return jackknife_interval(values.mean(axis=0) @ scenes.weights / values.shape[1], scenes)
    return _mean_over_runs(values, scenes)


def paired_difference(
    reference: np.ndarray, compared: np.ndarray, scenes: Clusters, *, same_runs: bool = False, trained: bool = True
) -> Interval:
    """Compute the mean of `compared - reference` on the same episodes.

    Both sides share the scenes, so that the difficulty of a scene cancels.

    Args:
      reference: bool, int or float [S1, E], finite.
      compared: [S2, E]; S2 must be S1 with `same_runs`, and for fixed policies.
      scenes: clusters of the E episodes.
      same_runs: True if row s of both sides is the same network (sTDE against no removal). Otherwise, the two sides
        were trained separately: `std` is sqrt(std_reference^2 + std_compared^2), and there are no `seeds`.
      trained: True to generalize to other training runs; False for the interval of these policies in other scenes.

    Raises:
      InputError: see `mean_interval`; or the shapes differ with `same_runs`, or without `trained`.
    """
    # With fixed policies, or with the same networks, the differences themselves are results [S, E].
    if not trained or same_runs:
        reference, compared = _as_paired_results(reference, compared, scenes)
        difference = compared - reference
        return _mean_over_runs(difference, scenes) if trained else mean_interval(difference, scenes, trained=False)

    # Separate runs: the difference is one mean over the runs of both sides, with the reference negated. Every run is
    # scaled by the number of runs over those of its side, so that both sides count as much.
    reference = _as_finite_results("reference", reference, scenes)
    compared = _as_finite_results("compared", compared, scenes)
    num_runs = len(reference) + len(compared)
    runs = run_clusters(len(reference), len(compared))
    if len(reference) != len(compared):
        runs = runs._replace(degrees_of_freedom=_welch_degrees(reference.mean(axis=1), compared.mean(axis=1)))
    signed_results = np.concatenate([-reference * (num_runs / len(reference)), compared * (num_runs / len(compared))])
    replicates = runs.weights.T @ signed_results @ scenes.weights / signed_results.size
    combined_std = math.hypot(_std(reference.mean(axis=1)), _std(compared.mean(axis=1)))
    return jackknife_interval(replicates, scenes, runs, std=combined_std)


def _welch_degrees(first_means: np.ndarray, second_means: np.ndarray) -> float:
    """Degrees of freedom of the difference between two sides with different numbers of runs (Welch, 1947).

    Pooled degrees would count on the quiet side of many runs for the variance of the other. With equal numbers of runs,
    pooled degrees are robust to different variances.

    Args:
      first_means, second_means: mean of each run, [S1] and [S2].

    Returns:
      At least the degrees of the smaller side; 0 if a side has a single run, which shows no variance.
    """
    if min(len(first_means), len(second_means)) < 2:
        return 0.0
    first_variance = first_means.var(ddof=1) / len(first_means)
    second_variance = second_means.var(ddof=1) / len(second_means)
    if first_variance + second_variance == 0.0:
        return float(len(first_means) + len(second_means) - 2)
    squares = first_variance**2 / (len(first_means) - 1) + second_variance**2 / (len(second_means) - 1)
    return float((first_variance + second_variance) ** 2 / squares)


def interquartile_mean(values: np.ndarray, scenes: Clusters, *, trained: bool = True) -> Interval:
    """Compute the interquartile mean of results with its interval.

    Each training run has a mean in each floor plan. The interquartile mean is the mean of the middle half of these, so
    that a few very good or very bad runs and homes do not decide (Agarwal et al., 2021, with floor plans as tasks).

    Args:
      values: bool, int or float [S, E], finite, by training run and episode.
      scenes: clusters of the E episodes.
      trained: True if rows are training runs; False if they are repetitions, which count as one.

    Raises:
      InputError: see `mean_interval`.
    """
    values = _as_finite_results("values", values, scenes)
    plan_means = _means_by_cluster(values if trained else values.mean(axis=0, keepdims=True), scenes)
    num_runs, num_plans = plan_means.shape
    scene_weights = _cluster_weights(scenes)  # [C, 1 + C]

    def trimmed_mean(run_weights: np.ndarray, plan_weights: np.ndarray) -> float:
        weights = np.outer(run_weights, plan_weights).ravel()
        if not weights.any():
            return math.nan  # nothing is left of a single run or floor plan

        # Of the sorted weights, those between the first and the last quarter of the total count.
        order = np.argsort(plan_means, axis=None)
        weights_below = np.cumsum(weights[order]) / weights.sum()
        inner_weights = np.diff(np.clip(weights_below, 0.25, 0.75), prepend=0.25)
        return float(plan_means.ravel()[order] @ inner_weights / inner_weights.sum())

    # Leave out one run, one floor plan, or both.
    runs = run_clusters(num_runs)
    replicates = np.empty((runs.weights.shape[1], 1 + num_plans))
    for run_column in range(replicates.shape[0]):
        for plan_column in range(1 + num_plans):
            replicates[run_column, plan_column] = trimmed_mean(
                runs.weights[:, run_column], scene_weights[:, plan_column]
            )
    return jackknife_interval(replicates if trained else replicates[0], scenes, runs if trained else None)


def probability_of_improvement(
    reference: np.ndarray, compared: np.ndarray, scenes: Clusters, *, same_runs: bool = False, trained: bool = True
) -> Interval:
    """Compute the probability that a run of `compared` is better than a run of `reference` on a random floor plan.

    Runs are compared by their mean results on the floor plan, and ties count half (Agarwal et al., 2021). A value of
    0.5 means that neither is better. Large differences on a few floor plans count no more than small ones.

    Args:
      reference: bool, int or float [S, E], finite.
      compared: the same shape.
      scenes: clusters of the E episodes.
      same_runs: True if row s of both sides is the same network, which is then compared with itself alone.
      trained: True to generalize to other training runs; False for the interval of these policies in other scenes.

    Raises:
      InputError: see `paired_difference`.
    """
    reference, compared = _as_paired_results(reference, compared, scenes)
    reference_means = _means_by_cluster(reference, scenes)
    compared_means = _means_by_cluster(compared, scenes)
    num_runs, num_plans = reference_means.shape

    # Which run of either side is better on each floor plan, [S, S, C].
    difference = compared_means[None, :] - reference_means[:, None]
    is_better = (difference > 0) + 0.5 * (difference == 0)
    scene_weights = _cluster_weights(scenes)
    if same_runs:
        own_pairs = is_better[np.arange(num_runs), np.arange(num_runs)]  # [S, C]
        runs = run_clusters(num_runs)
        replicates = runs.weights.T @ own_pairs @ scene_weights / (num_runs * num_plans)
    else:
        runs = run_clusters(num_runs, num_runs)
        reference_weights = runs.weights[:num_runs]
        compared_weights = runs.weights[num_runs:]
        weighted_sums = np.einsum(
            "rj,sj,rsc,ck->jk", reference_weights, compared_weights, is_better, scene_weights, optimize=True
        )
        replicates = weighted_sums / (num_runs**2 * num_plans)
    return jackknife_interval(replicates if trained else replicates[0], scenes, runs if trained else None)


def jackknife_interval(
    replicates: np.ndarray,
    scenes: Clusters,
    runs: Clusters | None = None,
    *,
    std: float = math.nan,
    seeds: tuple[float, ...] = (),
) -> Interval:
    """Compute the interval of a statistic from its leave-one-out replicates.

    Args:
      replicates: float64 [1 + R, 1 + C], the statistic under each column of the weights of runs and scenes; [1 + C]
        for a statistic that does not depend on training runs.
      scenes: the C scenes.
      runs: the R training runs; None for a statistic that does not depend on them.
      std, seeds: see `Interval`; returned unchanged.
    """
    # Without enough scenes, or with a single run, there is an estimate but no interval.
    replicates = np.atleast_2d(replicates)
    estimate = float(replicates[0, 0])
    too_few_runs = runs is not None and runs.degrees_of_freedom < 1
    if scenes.degrees_of_freedom < MIN_SCENE_DEGREES or too_few_runs:
        return Interval(estimate, std=std, seeds=seeds)

    # The first row leaves out scenes only, the first column runs only.
    scene_variance = float(scenes.scale @ (replicates[0, 1:] - estimate) ** 2)
    total_variance = scene_variance
    total_degrees = float(scenes.degrees_of_freedom)
    if runs is not None:
        run_variance = float(runs.scale @ (replicates[1:, 0] - estimate) ** 2)

        # Both variances contain the interaction of scenes and runs, so one copy is subtracted.
        interaction_effects = replicates[1:, 1:] - replicates[1:, :1] - replicates[:1, 1:] + estimate
        interaction_variance = float(runs.scale @ interaction_effects**2 @ scenes.scale)

        # The difference can fall below either variance by chance; the greater of both is then used.
        total_variance = max(scene_variance + run_variance - interaction_variance, scene_variance, run_variance)
        total_degrees = _satterthwaite_degrees(
            total_variance,
            (scene_variance, run_variance, interaction_variance),
            (scenes.degrees_of_freedom, runs.degrees_of_freedom, scenes.degrees_of_freedom * runs.degrees_of_freedom),
        )

    # Quantile of Student's t for a two-sided interval of 95 %.
    half_width = float(stdtrit(total_degrees, 0.975)) * math.sqrt(total_variance)
    return Interval(estimate, estimate - half_width, estimate + half_width, std=std, seeds=seeds)


def correlation_interval(replicates: np.ndarray, scenes: Clusters, runs: Clusters | None = None) -> Interval:
    """Compute the interval of a correlation from its leave-one-out replicates.

    The jackknife is that of Fisher's z, the inverse hyperbolic tangent of the correlation, so the interval stays within
    -1 and 1.

    Args:
      replicates, scenes, runs: as in `jackknife_interval`; replicates are in [-1, 1].
    """
    # A correlation of 1, as that of two points, has no finite z.
    fisher_z = np.arctanh(np.clip(replicates, -_MAX_CORRELATION, _MAX_CORRELATION))
    interval = jackknife_interval(fisher_z, scenes, runs)
    return Interval(math.tanh(interval.mean), math.tanh(interval.low), math.tanh(interval.high))


def scene_clusters(plans: np.ndarray, rooms: np.ndarray, counts: np.ndarray | None = None) -> Clusters:
    """Cluster items by floor plan, within room types.

    A room type with a single floor plan shows no variance; if there is one, all room types form one stratum.

    Args:
      plans: [N], floor plan of each item.
      rooms: [N], room type of each item.
      counts: [N], weight of each item; None for equal weights.
    """
    fewest_plans = min(len(set(plans[rooms == room])) for room in set(rooms.tolist()))
    return leave_one_out(plans, None if fewest_plans < 2 else rooms, counts)


def run_clusters(*runs_by_arm: int) -> Clusters:
    """Cluster items by training run, within arms; each argument is the number of runs of an arm."""
    return leave_one_out(np.arange(sum(runs_by_arm)), np.repeat(np.arange(len(runs_by_arm)), runs_by_arm))


def leave_one_out(labels: np.ndarray, strata: np.ndarray | None = None, counts: np.ndarray | None = None) -> Clusters:
    """Compute the weights that leave out one cluster at a time.

    Args:
      labels: [N], cluster of each item.
      strata: [N], stratum of each item, equal within a cluster; None for a single stratum.
      counts: [N], weight of each item; None for equal weights.
    """
    # Number clusters and strata; the stratum of a cluster is that of its first item.
    labels = np.asarray(labels)
    counts = np.ones(len(labels)) if counts is None else counts
    strata = np.zeros(len(labels), int) if strata is None else np.unique(strata, return_inverse=True)[1]
    clusters, first_item, cluster_of_item = np.unique(labels, return_index=True, return_inverse=True)
    stratum_of_cluster = strata[first_item]

    # Which items share the stratum of each cluster, and which belong to the cluster itself, [N, C].
    in_stratum = strata[:, None] == stratum_of_cluster
    in_cluster = cluster_of_item[:, None] == np.arange(len(clusters))

    # Without a cluster, the remaining items of its stratum are scaled up to the weight of the whole stratum.
    stratum_weight = counts @ in_stratum
    remaining_weight = counts @ (in_stratum & ~in_cluster)
    scale_up = np.divide(stratum_weight, remaining_weight, out=np.zeros(len(clusters)), where=remaining_weight > 0)
    weights_without = np.where(in_cluster, 0.0, np.where(in_stratum, scale_up, 1.0))

    # Each stratum loses one degree of freedom to its mean.
    stratum_size = np.bincount(stratum_of_cluster)[stratum_of_cluster]
    return Clusters(
        weights=np.concatenate([np.ones((len(labels), 1)), weights_without], axis=1),
        scale=(stratum_size - 1) / stratum_size,
        degrees_of_freedom=len(clusters) - len(np.unique(stratum_of_cluster)),
    )


def _means_by_cluster(values: np.ndarray, scenes: Clusters) -> np.ndarray:
    """Average results [S, E] over the episodes of each cluster, float64 [S, C]."""
    # A column leaves out exactly the items of its cluster.
    in_cluster = (scenes.weights[:, 1:] == 0.0).astype(np.float64)
    return values @ in_cluster / in_cluster.sum(axis=0)


def _cluster_weights(scenes: Clusters) -> np.ndarray:
    """Leave-one-out weights of clusters that count alike, float64 [C, 1 + C]; see `Clusters`."""
    first_items = np.argmax(scenes.weights[:, 1:] == 0.0, axis=0)
    weights = scenes.weights[first_items]
    total_weights = weights.sum(axis=0)
    return weights * len(weights) / np.where(total_weights > 0.0, total_weights, 1.0)


def _mean_over_runs(values: np.ndarray, scenes: Clusters) -> Interval:
    """Compute the mean of results [S, E] whose rows are training runs of one arm."""
    runs = run_clusters(len(values))
    replicates = runs.weights.T @ values @ scenes.weights / values.size
    run_means = values.mean(axis=1)
    return jackknife_interval(replicates, scenes, runs, std=_std(run_means), seeds=tuple(run_means.tolist()))


def _as_paired_results(reference: np.ndarray, compared: np.ndarray, scenes: Clusters) -> tuple[np.ndarray, np.ndarray]:
    """Convert two sides of a comparison to float64 [S, E], and check that their shapes are equal."""
    reference = _as_finite_results("reference", reference, scenes)
    compared = _as_finite_results("compared", compared, scenes)
    if reference.shape != compared.shape:
        raise InputError(
            f"reference has shape {reference.shape} and compared has shape {compared.shape}; evaluate both on equal "
            "runs and episodes"
        )
    return reference, compared


def _as_finite_results(name: str, values: np.ndarray, scenes: Clusters) -> np.ndarray:
    """Convert results to float64 [S, E] and check shape and values."""
    # Shape first, then values: NaN must not pass unseen into a mean.
    values = np.asarray(values, np.float64)
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; give [runs, episodes] with at least one of each")
    if values.shape[1] != len(scenes.weights):
        raise InputError(
            f"{name} has {values.shape[1]} episodes, but `scenes` has {len(scenes.weights)}; give equally many"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{name} contains NaN or infinite values; give every episode a finite value")
    return values


def _std(means: np.ndarray) -> float:
    return float(means.std(ddof=1)) if len(means) > 1 else math.nan


def _satterthwaite_degrees(variance: float, parts: tuple[float, ...], degrees: tuple[float, ...]) -> float:
    """Approximate the degrees of freedom of a sum of variances."""
    # (sum of variances)^2 / sum of (variance^2 / its degrees of freedom), never below the fewest.
    spread_sum = sum(
        part_variance**2 / part_degrees for part_variance, part_degrees in zip(parts, degrees, strict=True)
    )
    fewest_degrees = float(min(degrees))
    return max(variance**2 / spread_sum, fewest_degrees) if spread_sum > 0 else fewest_degrees


class SharedDesign(NamedTuple):
    """Scenes and training runs that several conditions share.

    A replicate leaves out a floor plan, or a training run, of all conditions at once.

    Attributes:
      names: [N], names of all scenes, sorted.
      plans, rooms: [N], floor plan and room type of each scene.
      scenes: clusters of the scenes.
      runs: clusters of the training runs.
    """

    names: tuple[str, ...]
    plans: np.ndarray
    rooms: np.ndarray
    scenes: Clusters
    runs: Clusters

    @classmethod
    def from_conditions(
        cls, conditions: Sequence[tuple[Sequence[str], Sequence[str]]], num_seeds: int
    ) -> "SharedDesign":
        """Collect the scenes of all conditions.

        Args:
          conditions: for each condition, the names of its scenes and their room types.
          num_seeds: number of training runs.
        """
        # A scene that occurs in several conditions is one scene.
        room_by_name: dict[str, str] = {}
        for scene_names, room_types in conditions:
            room_by_name.update(zip(scene_names, room_types, strict=True))

        # Sorted, so that `jackknife_means` can find a scene by bisection.
        all_names = tuple(sorted(room_by_name))
        scene_plans = np.array(list(map(floor_plan_name, all_names)))
        scene_rooms = np.array([room_by_name[name] for name in all_names])
        return cls(
            all_names, scene_plans, scene_rooms, scene_clusters(scene_plans, scene_rooms), run_clusters(num_seeds)
        )

    def jackknife_means(
        self, sums: np.ndarray, weights: np.ndarray, names: Sequence[str], *, trained: bool = True
    ) -> np.ndarray:
        """Compute the leave-one-out means of a measure in one condition.

        Args:
          sums: float64 [S, N], the measure summed over the episodes of each scene, by training run; [1, N] for a
            measure without training.
          weights: [N], number of episodes of each scene.
          names: [N], names of the scenes.
          trained: True if the measure depends on the training run.

        Returns:
          float64 [1 + R, 1 + C], or [1 + C] for a measure without training; NaN if no episode is left.
        """
        # Scenes of other conditions weigh 0 here, but are left out in a column of their own.
        scene_index = np.searchsorted(self.names, names)
        counts = np.bincount(scene_index, weights, len(self.names))
        scene_weights = scene_clusters(self.plans, self.rooms, counts).weights[scene_index]  # [N, 1 + C]

        # A replicate that leaves out all episodes of the condition is NaN.
        total_weight = np.broadcast_to(weights @ scene_weights, (len(sums), scene_weights.shape[1]))
        means = divide_or_nan(sums @ scene_weights, total_weight)
        return self.runs.weights.T @ means / len(means) if trained else means[0]

    def interval(self, means: np.ndarray) -> Interval:
        """Compute the interval of a statistic from replicates as returned by `jackknife_means`."""
        return jackknife_interval(means, self.scenes, None if means.ndim == 1 else self.runs)


def weight_below(values: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum the weights of all `others` that lie below each value, counting ties half.

    With `others = values` these are ranks: midranks minus one half if all weights are 1.

    Args:
      values: real [P].
      others: real [Q].
      weights: float [Q, R], weights of `others`.

    Returns:
      [P, R], with the dtype of the weights.
    """
    # Cumulative weights in the order of `others`; entry q is the weight of the q smallest.
    sorting_order = np.argsort(others)
    sorted_others = others[sorting_order]
    weight_up_to = np.concatenate([np.zeros_like(weights[:1]), np.cumsum(weights[sorting_order], axis=0)])  # [Q + 1, R]

    # The mean of both bounds counts ties half.
    num_less = np.searchsorted(sorted_others, values, "left")
    num_less_or_equal = np.searchsorted(sorted_others, values, "right")
    return (weight_up_to[num_less] + weight_up_to[num_less_or_equal]) / 2


def divide_or_nan(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Divide, giving NaN where the denominator is not positive; both arrays have the same shape."""
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)
