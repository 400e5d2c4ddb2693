"""Success and gain against layout similarity (Figs. 4 and 5).

Similarity is the cosine of a category's co-occurrence in a scene and in the prior: of rows i of `expected(counts)`.
Every correlation and slope weighs each point by its number of episodes. Intervals are over scenes and training runs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.similarity import expected
from jaxnav.evaluation.statistics import jackknife, training_runs
from jaxnav.study.ranks import weight_below
from jaxnav.study.records import GainBySimilarity, SuccessBySimilarity


class SimilarityPoints(NamedTuple):
    """Hold P pairs of scene and category with a similarity.

    Attributes:
      category, scene: int [P], indices.
      num_episodes: int [P].
      similarity: float64 [P], in [0, 1].
      left_out: number of pairs without a similarity.
      member: bool [P, E], the episodes of each.
      episodes: the E episodes.
    """

    category: np.ndarray
    scene: np.ndarray
    num_episodes: np.ndarray
    similarity: np.ndarray
    left_out: int
    member: np.ndarray
    episodes: EpisodeList

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return means [P, ...] of values [E, ...]."""
        return ((self.member @ values.astype(np.float64)).T / self.num_episodes).T


def similarity_points(episodes: EpisodeList, counts: np.ndarray, prior: np.ndarray) -> SimilarityPoints:
    """Compare each goal category's surroundings with those in training.

    Args:
      episodes: the E episodes, in N scenes.
      counts: real [N, K, K], see `jaxnav.evaluation.similarity.scene_counts`.
      prior: real [N, K, K], counts or concentrations of each scene's room type in training.
    """
    pairs, of, number = np.unique(
        episodes.scene * counts.shape[-1] + episodes.goal, return_inverse=True, return_counts=True
    )
    scene, category = np.divmod(pairs, counts.shape[-1])
    shown, learned = expected(counts)[scene, category], expected(prior)[scene, category]  # [P, K]
    norms = np.sqrt((shown**2).sum(axis=-1) * (learned**2).sum(axis=-1))
    kept = np.flatnonzero(norms > 0)
    return SimilarityPoints(
        category=category[kept],
        scene=scene[kept],
        num_episodes=number[kept],
        similarity=(shown * learned).sum(axis=-1)[kept] / norms[kept],
        left_out=len(pairs) - len(kept),
        member=kept[:, None] == of,
        episodes=episodes,
    )


def success_by_similarity(points: SimilarityPoints, success: np.ndarray) -> SuccessBySimilarity:
    """Relate success to layout similarity.

    Args:
      points: pairs of scene and category.
      success: bool or float [S, E], by training run and episode.
    """
    scenes, runs = points.episodes.clusters(), training_runs(1, len(success))
    weights = points.member @ scenes.weights  # [P, 1 + C]
    rates = points.means(success.T @ runs.weights / len(success))  # [P, 1 + R]
    similarity_ranks = weight_below(points.similarity, points.similarity, weights)
    pearson = [_line(points.similarity[:, None], rate[:, None], weights)[1] for rate in rates.T]
    spearman = [_line(similarity_ranks, weight_below(rate, rate, weights), weights)[1] for rate in rates.T]
    return SuccessBySimilarity(
        category=points.category,
        scene=points.scene,
        episodes=points.num_episodes,
        similarity=points.similarity,
        success=rates[:, 0],
        left_out=points.left_out,
        pearson=jackknife(np.stack(pearson), scenes, runs),
        spearman=jackknife(np.stack(spearman), scenes, runs),
    )


def gain_by_similarity(
    points: SimilarityPoints, baseline: np.ndarray, variant: np.ndarray, categories: Sequence[str]
) -> GainBySimilarity:
    """Relate a variant's gain to layout similarity.

    Args:
      points: pairs of scene and category.
      baseline, variant: bool or float [S, E], success by training run and episode; trained apart.
      categories: [K], names.
    """
    scenes, runs = points.episodes.clusters(), training_runs(2, len(baseline))
    weights = points.member @ scenes.weights
    category = np.unique(points.category)
    member = (category[:, None] == points.category).astype(np.float64)  # [C, P]
    total = member @ weights

    def means(values: np.ndarray) -> np.ndarray:
        # By category, [C, 1 + scenes]; 0 where the only scene of a category is left out, at weight 0.
        return np.divide(member @ (weights * values[:, None]), total, out=np.zeros_like(total), where=total > 0)

    success = 100.0 * np.concatenate([-baseline.astype(np.float64), variant])  # a sum of both arms is the gain
    gains = points.means(success.T @ runs.weights / len(baseline))  # [P, 1 + R]
    similarity = means(points.similarity)
    slope, pearson = np.stack([_line(similarity, means(gain), total) for gain in gains.T], axis=1)
    return GainBySimilarity(
        category=category,
        episodes=(member @ points.num_episodes).astype(int),
        similarity=similarity[:, 0],
        baseline=means(100.0 * points.means(baseline.mean(axis=0)))[:, 0],
        gain=means(gains[:, 0])[:, 0],
        left_out=points.left_out,
        slope=jackknife(0.1 * slope, scenes, runs),
        pearson=jackknife(pearson, scenes, runs),
        categories=tuple(np.asarray(categories)[category].tolist()),
    )


def _line(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope and Pearson's r of weighted points.

    Both are [R], of y on x, one for each column of the weights; NaN where x (or y) does not vary.

    Args:
      x, y: float64 [P, R] or [P, 1].
      weights: float64 [P, R], >= 0.
    """
    total = np.maximum(weights.sum(axis=0), 1.0)
    x, y = (values - (weights * values).sum(axis=0) / total for values in (x, y))
    xx, yy, xy = ((weights * product).sum(axis=0) / total for product in (x * x, y * y, x * y))
    slope, r = (np.divide(xy, by, out=np.full(xy.shape, np.nan), where=by > 1e-12) for by in (xx, np.sqrt(xx * yy)))
    return slope, r
