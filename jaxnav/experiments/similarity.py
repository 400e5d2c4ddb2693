"""Success and gain against layout similarity (Figs. 4 and 5).

A point is a goal category in a scene. Its similarity is the cosine between the category's co-occurrence in the scene
and in the prior, which are rows of `expected_cooccurrence`. `compute_similarity_points` collects the points;
`relate_success_to_similarity` and `relate_gain_to_similarity` correlate results with their similarity. Correlations and
slopes weigh each point by its number of episodes. Intervals are over scenes and training runs. `success_rows` and
`gain_rows` put both into the result table, from which `success_of_table` and `gain_of_table` read them back.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.similarity import expected_cooccurrence
from jaxnav.evaluation.statistics import Interval, correlation_interval, jackknife_interval, run_clusters, weight_below
from jaxnav.experiments.table import Curve, ResultRow, ResultTable


class SuccessBySimilarity(NamedTuple):
    """Success against layout similarity (Fig. 4), of P points.

    Attributes:
      episodes: int [P], number of episodes.
      similarity: float64 [P], in [0, 1].
      success: float64 [P], success rate over episodes and seeds, 0 to 1.
      pearson, spearman: correlation of success and similarity.
    """

    episodes: np.ndarray
    similarity: np.ndarray
    success: np.ndarray
    pearson: Interval
    spearman: Interval


class GainBySimilarity(NamedTuple):
    """Gain of a variant against layout similarity (Fig. 5), of C goal categories.

    Attributes:
      categories: [C], names.
      similarity: float64 [C], mean over the category's episodes that have a similarity, in [0, 1].
      baseline: float64 [C], SR of the baseline in these episodes, in percent.
      gain: float64 [C], SR of the variant minus SR of the baseline, in points.
      slope: of gain on similarity, points per 0.1.
      pearson: correlation of gain and similarity.
    """

    categories: tuple[str, ...]
    similarity: np.ndarray
    baseline: np.ndarray
    gain: np.ndarray
    slope: Interval
    pearson: Interval


class SimilarityPoints(NamedTuple):
    """P points (scene, category) with a similarity.

    Attributes:
      category, scene: int [P], indices.
      num_episodes: int [P].
      similarity: float64 [P], in [0, 1].
      member: bool [P, E], True for the episodes of each point.
      episodes: the E episodes.
    """

    category: np.ndarray
    scene: np.ndarray
    num_episodes: np.ndarray
    similarity: np.ndarray
    member: np.ndarray
    episodes: EpisodeList

    def means(self, values: np.ndarray) -> np.ndarray:
        """Average values [E, ...] over the episodes of each point, [P, ...]."""
        return ((self.member @ values.astype(np.float64)).T / self.num_episodes).T


def compute_similarity_points(episodes: EpisodeList, counts: np.ndarray, prior: np.ndarray) -> SimilarityPoints:
    """Compare the surroundings of each goal category with those in training.

    Args:
      episodes: the E episodes, in N scenes.
      counts: real [N, K, K], see `jaxnav.evaluation.similarity.cooccurrence_counts`.
      prior: real [N, K, K], counts or concentrations of each scene's room type in training.
    """
    # Distinct pairs (scene, goal category), and the pair of each episode.
    num_categories = counts.shape[-1]
    pair_of_episode = episodes.scene * num_categories + episodes.goal
    distinct_pairs, pair_index, num_episodes = np.unique(pair_of_episode, return_inverse=True, return_counts=True)
    scene_index, category_index = np.divmod(distinct_pairs, num_categories)

    # Cosine of the rows of scene and prior; undefined if either shows the category with no other.
    scene_rows = expected_cooccurrence(counts)[scene_index, category_index]  # [pairs, K]
    prior_rows = expected_cooccurrence(prior)[scene_index, category_index]
    row_products = (scene_rows * prior_rows).sum(axis=-1)
    norm_products = np.sqrt((scene_rows**2).sum(axis=-1) * (prior_rows**2).sum(axis=-1))
    valid_pairs = np.flatnonzero(norm_products > 0)

    return SimilarityPoints(
        category=category_index[valid_pairs],
        scene=scene_index[valid_pairs],
        num_episodes=num_episodes[valid_pairs],
        similarity=row_products[valid_pairs] / norm_products[valid_pairs],
        member=valid_pairs[:, None] == pair_index,
        episodes=episodes,
    )


def relate_success_to_similarity(points: SimilarityPoints, success: np.ndarray) -> SuccessBySimilarity:
    """Correlate success with layout similarity.

    Args:
      points: points with a similarity.
      success: bool or float [S, E], by training run and episode.
    """
    # Leave-one-out weights of the points, and their success without each run.
    scenes = points.episodes.clusters()
    runs = run_clusters(len(success))
    weights = points.member @ scenes.weights  # [P, 1 + C]
    success_rates = points.means(success.T @ runs.weights / len(success))  # [P, 1 + R]

    # Replicates [1 + R, 1 + C] of both correlations; Spearman's is Pearson's of the ranks.
    similarity_ranks = weight_below(points.similarity, points.similarity, weights)
    pearson_replicates = []
    spearman_replicates = []
    for rates in success_rates.T:
        _, correlation = _slope_and_pearson(points.similarity[:, None], rates[:, None], weights)
        pearson_replicates.append(correlation)
        _, rank_correlation = _slope_and_pearson(similarity_ranks, weight_below(rates, rates, weights), weights)
        spearman_replicates.append(rank_correlation)

    return SuccessBySimilarity(
        episodes=points.num_episodes,
        similarity=points.similarity,
        success=success_rates[:, 0],
        pearson=correlation_interval(np.stack(pearson_replicates), scenes, runs),
        spearman=correlation_interval(np.stack(spearman_replicates), scenes, runs),
    )


def relate_gain_to_similarity(
    points: SimilarityPoints, baseline: np.ndarray, variant: np.ndarray, categories: Sequence[str]
) -> GainBySimilarity:
    """Correlate a variant's gain with layout similarity, by category.

    Args:
      points: points with a similarity.
      baseline, variant: bool or float [S, E], success by training run and episode; trained separately.
      categories: [K], names.
    """
    # Both arms were trained separately, so a replicate leaves out one run of either arm.
    scenes = points.episodes.clusters()
    runs = run_clusters(len(baseline), len(baseline))

    # Points are averaged by category, weighted by their episodes.
    weights = points.member @ scenes.weights  # [P, 1 + C]
    category = np.unique(points.category)
    in_category = (category[:, None] == points.category).astype(np.float64)  # [categories, P]
    category_weights = in_category @ weights  # [categories, 1 + C]

    def category_means(values: np.ndarray) -> np.ndarray:
        """Average values [P] by category, [categories, 1 + C]; 0 in a replicate without the category's only scene."""
        sums = in_category @ (weights * values[:, None])
        return np.divide(sums, category_weights, out=np.zeros_like(category_weights), where=category_weights > 0)

    # With the baseline negated, the sum over the runs of both arms is the gain.
    signed_success = 100.0 * np.concatenate([-baseline.astype(np.float64), variant])
    gains = points.means(signed_success.T @ runs.weights / len(baseline))  # [P, 1 + R]
    mean_similarity = category_means(points.similarity)

    # Replicates [1 + R, 1 + C] of slope and correlation.
    slope_replicates = []
    pearson_replicates = []
    for run_gain in gains.T:
        slope, correlation = _slope_and_pearson(mean_similarity, category_means(run_gain), category_weights)
        slope_replicates.append(slope)
        pearson_replicates.append(correlation)

    # The first column, or row, of every array holds the values over all scenes and runs. The factor 0.1 gives the slope
    # per tenth of similarity.
    return GainBySimilarity(
        categories=tuple(np.asarray(categories)[category].tolist()),
        similarity=mean_similarity[:, 0],
        baseline=category_means(100.0 * points.means(baseline.mean(axis=0)))[:, 0],
        gain=category_means(gains[:, 0])[:, 0],
        slope=jackknife_interval(0.1 * np.stack(slope_replicates), scenes, runs),
        pearson=correlation_interval(np.stack(pearson_replicates), scenes, runs),
    )


def _slope_and_pearson(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the slope of y on x, and Pearson's r, of weighted points.

    Args:
      x, y: float64 [P, R] or [P, 1].
      weights: float64 [P, R], >= 0.

    Returns:
      Both [R], one for each column of the weights; NaN if x (or y) does not vary.
    """
    total_weight = np.maximum(weights.sum(axis=0), 1.0)

    def mean(values: np.ndarray) -> np.ndarray:
        return (weights * values).sum(axis=0) / total_weight

    # Weighted moments around the means, [R].
    x = x - mean(x)
    y = y - mean(y)
    variance_x = mean(x * x)
    variance_y = mean(y * y)
    covariance = mean(x * y)
    return _divide_if_varying(covariance, variance_x), _divide_if_varying(covariance, np.sqrt(variance_x * variance_y))


def _divide_if_varying(covariance: np.ndarray, variance: np.ndarray) -> np.ndarray:
    return np.divide(covariance, variance, out=np.full(covariance.shape, np.nan), where=variance > 1e-12)


# Rows of the result table


def success_rows(fields: Mapping[str, Any], points: SimilarityPoints, success: np.ndarray) -> Iterator[ResultRow]:
    """Put the relation of success to similarity into rows.

    Args:
      fields: fields of the rows.
      points: points with a similarity.
      success: bool or float [S, E], of the baseline.
    """
    relation = relate_success_to_similarity(points, success)
    for metric, values in (("sr by similarity", relation.success), ("episodes by similarity", relation.episodes)):
        undefined = np.full(len(values), np.nan)
        curve = Curve(relation.similarity, values, undefined, undefined)
        yield ResultRow(**fields, variant="baseline", metric=metric, value=curve)
    yield ResultRow(**fields, variant="baseline", metric="sr by similarity, pearson", value=relation.pearson)
    yield ResultRow(**fields, variant="baseline", metric="sr by similarity, spearman", value=relation.spearman)


def success_of_table(table: ResultTable, **fields: Any) -> SuccessBySimilarity:
    """Read the relation of success to similarity from the rows with some fields."""
    success = table.curve(**fields, variant="baseline", metric="sr by similarity")
    episodes = table.curve(**fields, variant="baseline", metric="episodes by similarity")
    return SuccessBySimilarity(
        episodes=episodes.mean,
        similarity=success.positions,
        success=success.mean,
        pearson=table.find(**fields, variant="baseline", metric="sr by similarity, pearson"),
        spearman=table.find(**fields, variant="baseline", metric="sr by similarity, spearman"),
    )


def gain_rows(
    fields: Mapping[str, Any],
    points: SimilarityPoints,
    baseline: np.ndarray,
    variant: np.ndarray,
    categories: Sequence[str],
) -> Iterator[ResultRow]:
    """Put the relation of a variant's gain to similarity into rows; see `relate_gain_to_similarity`.

    Args:
      fields: fields of the rows.
      points: points with a similarity.
      baseline, variant: bool or float [S, E], success of both.
      categories: [K], names.
    """
    relation = relate_gain_to_similarity(points, baseline, variant, categories)
    for index, category in enumerate(relation.categories):
        for metric in ("similarity", "baseline", "gain"):
            value = Interval(float(getattr(relation, metric)[index]))
            yield ResultRow(**fields, category=category, metric=f"{metric} by category", value=value)
    yield ResultRow(**fields, metric="gain by similarity, slope", value=relation.slope)
    yield ResultRow(**fields, metric="gain by similarity, pearson", value=relation.pearson)


def gain_of_table(table: ResultTable, **fields: Any) -> GainBySimilarity:
    """Read the relation of a variant's gain to similarity from the rows with some fields."""
    categories = tuple(table.distinct("category", **fields, metric="gain by category"))
    columns = {}
    for metric in ("similarity", "baseline", "gain"):
        cells = [table.find(**fields, category=name, metric=f"{metric} by category") for name in categories]
        columns[metric] = np.array([cell.mean for cell in cells])
    return GainBySimilarity(
        categories=categories,
        **columns,
        slope=table.find(**fields, metric="gain by similarity, slope"),
        pearson=table.find(**fields, metric="gain by similarity, pearson"),
    )
