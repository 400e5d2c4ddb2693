"""Success and gain against layout similarity (Figs. 4 and 5).

Similarity is the cosine of a category's co-occurrence in a scene and in the prior: of rows i of `expected(counts)`.
Every correlation and slope weighs each point by its number of episodes. Intervals are 95 % percentile bootstrap ones
over scenes, drawn within room types; training seeds are averaged over and not drawn.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.similarity import expected
from jaxnav.study.bootstrap import RESAMPLES, scene_draws, weight_below
from jaxnav.study.intervals import percentile_interval
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
        """Return means [P] of values [E]."""
        return self.member @ values.astype(np.float64) / self.num_episodes

    def weights(self, generator: np.random.Generator, resamples: int) -> np.ndarray:
        """Return each point's episodes by resample, [P, 1 + R]."""
        (draws,) = scene_draws([self.episodes], generator, resamples)
        return self.member @ draws.astype(np.float64)


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


def success_by_similarity(
    points: SimilarityPoints, success: np.ndarray, generator: np.random.Generator, resamples: int = RESAMPLES
) -> SuccessBySimilarity:
    """Relate success to layout similarity.

    Args:
      points: pairs of scene and category.
      success: bool or float [S, E], by seed and episode.
      generator: source of the resamples.
      resamples: their number.
    """
    rate = points.means(success.mean(axis=0))
    weights = points.weights(generator, resamples)
    similarity_ranks, success_ranks = (weight_below(values, values, weights) for values in (points.similarity, rate))
    return SuccessBySimilarity(
        category=points.category,
        scene=points.scene,
        episodes=points.num_episodes,
        similarity=points.similarity,
        success=rate,
        left_out=points.left_out,
        pearson=percentile_interval(_line(points.similarity[:, None], rate[:, None], weights)[1]),
        spearman=percentile_interval(_line(similarity_ranks, success_ranks, weights)[1]),
    )


def gain_by_similarity(
    points: SimilarityPoints,
    baseline: np.ndarray,
    variant: np.ndarray,
    categories: Sequence[str],
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
) -> GainBySimilarity:
    """Relate a variant's gain to layout similarity.

    Args:
      points: pairs of scene and category.
      baseline, variant: bool or float [S, E], success by seed and episode.
      categories: [K], names.
      generator: source of the resamples.
      resamples: their number.
    """
    before, after = (100.0 * points.means(success.mean(axis=0)) for success in (baseline, variant))
    weights = points.weights(generator, resamples)
    category = np.unique(points.category)
    member = (category[:, None] == points.category).astype(np.float64)  # [C, P]
    total = member @ weights

    def means(values: np.ndarray) -> np.ndarray:
        # By category, [C, 1 + R]; 0 where no scene of the category is drawn, at weight 0.
        return member @ (weights * values[:, None]) / np.maximum(total, 1.0)

    similarity, gain = means(points.similarity), means(after - before)
    slope, pearson = _line(similarity, gain, total)
    return GainBySimilarity(
        category=category,
        episodes=(member @ points.num_episodes).astype(int),
        similarity=similarity[:, 0],
        baseline=means(before)[:, 0],
        gain=gain[:, 0],
        left_out=points.left_out,
        slope=percentile_interval(0.1 * slope),
        pearson=percentile_interval(pearson),
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
