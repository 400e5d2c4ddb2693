"""Does success follow the fit of the layout? Success against similarity (paper, Fig. 4), gain against it (Fig. 5).

Similarity is the cosine of a category's co-occurrence in a scene and in the prior: of rows i of `expected(counts)`.
Every correlation and slope weighs each point by its number of episodes. Intervals are 95 % percentile bootstrap ones
over scenes, drawn within room types; training seeds are averaged over and not drawn.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.similarity import expected

RESAMPLES = 2000

#: A mean with its 95 % interval: {"mean": float, "ci95": [low, high]}, None for what is not defined.
Interval = dict[str, Any]


class SuccessBySimilarity(NamedTuple):
    """Fig. 4: P points, a goal category in a scene each.

    Attributes:
      category, scene: int [P], indices.
      episodes: int [P].
      similarity: float64 [P], in [0, 1].
      success: float64 [P], success rate over episodes and seeds, 0 to 1.
      left_out: points without a similarity, as the scene or the prior shows the category with no other.
      pearson, spearman: r of success and similarity.
    """

    category: np.ndarray
    scene: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    success: np.ndarray
    left_out: int
    pearson: Interval
    spearman: Interval


class GainBySimilarity(NamedTuple):
    """Fig. 5: C goal categories, over the episodes whose point (category, scene) has a similarity.

    Attributes:
      category: int [C], indices, rising.
      episodes: int [C].
      similarity: float64 [C], mean over the category's episodes, in [0, 1].
      baseline: float64 [C], success rate in percent.
      gain: float64 [C], success rate of the variant less the baseline's, in points.
      left_out: points (category, scene) without a similarity.
      slope: of gain on similarity, points per 0.1.
      pearson: r of gain and similarity.
    """

    category: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    baseline: np.ndarray
    gain: np.ndarray
    left_out: int
    slope: Interval
    pearson: Interval


def success_by_similarity(
    success: np.ndarray,
    episodes: EpisodeList,
    counts: np.ndarray,
    prior: np.ndarray,
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
) -> SuccessBySimilarity:
    """Whether goals are found more often where they stand with what they stood with in training.

    Args:
      success: bool or float [S, E], by seed and episode.
      episodes: the E episodes, in N scenes.
      counts: real [N, K, K], see `jaxnav.evaluation.similarity.scene_counts`.
      prior: real [N, K, K], counts or concentrations of each scene's room type in training.
      generator: of the resamples.
      resamples: their number.
    """
    points = _points(episodes, counts, prior)
    rate = points.means(success.mean(axis=0))
    weights = points.weights(episodes, generator, resamples)
    similarity_ranks, success_ranks = (weight_below(values, values, weights) for values in (points.similarity, rate))
    return SuccessBySimilarity(
        category=points.category,
        scene=points.scene,
        episodes=points.episodes,
        similarity=points.similarity,
        success=rate,
        left_out=points.left_out,
        pearson=interval(_line(points.similarity[:, None], rate[:, None], weights)[1]),
        spearman=interval(_line(similarity_ranks, success_ranks, weights)[1]),
    )


def gain_by_similarity(
    baseline: np.ndarray,
    variant: np.ndarray,
    episodes: EpisodeList,
    counts: np.ndarray,
    prior: np.ndarray,
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
) -> GainBySimilarity:
    """Whether a variant gains more on goals that stand with other things than in training.

    Args:
      baseline: bool or float [S, E], success by seed and episode.
      variant: bool or float [S', E], on the same episodes.
      episodes, counts, prior, generator, resamples: as for `success_by_similarity`.
    """
    points = _points(episodes, counts, prior)
    before, after = (100.0 * points.means(success.mean(axis=0)) for success in (baseline, variant))
    weights = points.weights(episodes, generator, resamples)
    category, of = np.unique(points.category, return_inverse=True)
    member = (np.arange(len(category))[:, None] == of).astype(np.float64)  # [C, P]
    total = member @ weights

    def means(values: np.ndarray) -> np.ndarray:
        """Means by category, [C, 1 + R]; 0 where no scene of the category is drawn, at weight 0."""
        return member @ (weights * values[:, None]) / np.maximum(total, 1.0)

    similarity, gain = means(points.similarity), means(after - before)
    slope, pearson = _line(similarity, gain, total)
    return GainBySimilarity(
        category=category,
        episodes=(member @ points.episodes).astype(int),
        similarity=similarity[:, 0],
        baseline=means(before)[:, 0],
        gain=gain[:, 0],
        left_out=points.left_out,
        slope=interval(0.1 * slope),
        pearson=interval(pearson),
    )


class _Points(NamedTuple):
    """P pairs of scene and goal category that have a similarity; fields as in `SuccessBySimilarity`.

    Attributes:
      member: bool [P, E], the episodes of each.
    """

    category: np.ndarray
    scene: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    left_out: int
    member: np.ndarray

    def means(self, values: np.ndarray) -> np.ndarray:
        """Means [P] of values [E]."""
        return self.member @ values.astype(np.float64) / self.episodes

    def weights(self, episodes: EpisodeList, generator: np.random.Generator, resamples: int) -> np.ndarray:
        """Episodes of each point in each resample, float64 [P, 1 + R]."""
        (draws,) = scene_draws([episodes], generator, resamples)
        return self.member @ draws.astype(np.float64)


def _points(episodes: EpisodeList, counts: np.ndarray, prior: np.ndarray) -> _Points:
    pairs, of, number = np.unique(
        episodes.scene * counts.shape[-1] + episodes.goal, return_inverse=True, return_counts=True
    )
    scene, category = np.divmod(pairs, counts.shape[-1])
    own, learned = expected(counts)[scene, category], expected(prior)[scene, category]  # [P, K]
    norms = np.sqrt((own**2).sum(axis=-1) * (learned**2).sum(axis=-1))
    kept = np.flatnonzero(norms > 0)
    return _Points(
        category=category[kept],
        scene=scene[kept],
        episodes=number[kept],
        similarity=(own * learned).sum(axis=-1)[kept] / norms[kept],
        left_out=len(pairs) - len(kept),
        member=kept[:, None] == of,
    )


def _line(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope of y on x and Pearson's r, both [R], of points weighted by column; NaN where x (or y) does not vary.

    Args:
      x, y: float64 [P, R] or [P, 1].
      weights: float64 [P, R], >= 0.
    """
    total = np.maximum(weights.sum(axis=0), 1.0)
    x, y = (values - (weights * values).sum(axis=0) / total for values in (x, y))
    xx, yy, xy = ((weights * product).sum(axis=0) / total for product in (x * x, y * y, x * y))
    slope, r = (np.divide(xy, by, out=np.full(xy.shape, np.nan), where=by > 1e-12) for by in (xx, np.sqrt(xx * yy)))
    return slope, r


def weight_below(values: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Total weight of the others that lie below each value, and half the weight of those equal to it.

    With `others = values` these are ranks: midranks less a half where all weights are 1.

    Args:
      values: real [P].
      others: real [Q].
      weights: float [Q, R].

    Returns:
      [P, R], of the weights' dtype.
    """
    order = np.argsort(others)
    below = np.concatenate([np.zeros_like(weights[:1]), np.cumsum(weights[order], axis=0)])
    less, up_to = (np.searchsorted(others[order], values, side) for side in ("left", "right"))
    return (below[less] + below[up_to]) / 2


def scene_draws(
    lists: Sequence[EpisodeList], generator: np.random.Generator, resamples: int = RESAMPLES
) -> list[np.ndarray]:
    """How often each episode counts in a bootstrap that draws scenes, as many of each room type as there are.

    Scenes of equal name are twins: they are drawn together, in all lists.

    Args:
      lists: lists of episodes, E each.
      generator: of the draws.
      resamples: R.

    Returns:
      For each list float32 [E, 1 + R], whole numbers; column 0 is the data itself, 1 everywhere.
    """
    names = [np.array(own.scenes)[own.scene] for own in lists]
    rooms = [np.array(own.rooms)[own.room] for own in lists]
    every, first = np.unique(np.concatenate(names), return_index=True)
    strata = np.concatenate(rooms)[first]
    draws = np.ones((len(every), 1 + resamples), np.float32)
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        share = np.full(len(members), 1 / len(members))
        draws[members, 1:] = generator.multinomial(len(members), share, resamples).T
    return [draws[np.searchsorted(every, own)] for own in names]


def interval(values: np.ndarray) -> Interval:
    """The value of the data, values[0], and the 95 % interval of its resamples values[1:] that are defined."""
    defined = values[1:][np.isfinite(values[1:])]
    if not (np.isfinite(values[0]) and len(defined)):
        return {"mean": None, "ci95": [None, None]}
    return {"mean": float(values[0]), "ci95": np.percentile(defined, (2.5, 97.5)).tolist()}
