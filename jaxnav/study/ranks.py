"""Stratified resamples, and ranks under their weights."""

from collections.abc import Sequence

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList

RESAMPLES = 2000


def stratified_draws(strata: np.ndarray, generator: np.random.Generator, resamples: int = RESAMPLES) -> np.ndarray:
    """Count how often each item is drawn in each resample.

    Items are drawn with replacement within their stratum, as many as it holds.

    Args:
      strata: [N], stratum of each item.
      generator: source of the draws.
      resamples: R.

    Returns:
      float64 [N, 1 + R], whole numbers; column 0 is the data itself, 1 everywhere.
    """
    draws = np.ones((len(strata), 1 + resamples))
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        share = np.full(len(members), 1 / len(members))
        draws[members, 1:] = generator.multinomial(len(members), share, resamples).T
    return draws


def scene_draws(
    lists: Sequence[EpisodeList], generator: np.random.Generator, resamples: int = RESAMPLES
) -> list[np.ndarray]:
    """Count each episode in a bootstrap over scenes.

    Scenes are drawn within their room types, each with all its episodes. Scenes of equal name are twins: they are drawn
    together, in all lists.

    Args:
      lists: lists of episodes, E each.
      generator: source of the draws.
      resamples: R.

    Returns:
      For each list float32 [E, 1 + R], whole numbers; column 0 is the data itself, 1 everywhere.
    """
    names = [np.array(episodes.scenes)[episodes.scene] for episodes in lists]
    rooms = [np.array(episodes.rooms)[episodes.room] for episodes in lists]
    scenes, first = np.unique(np.concatenate(names), return_index=True)
    draws = stratified_draws(np.concatenate(rooms)[first], generator, resamples).astype(np.float32)
    return [draws[np.searchsorted(scenes, scene)] for scene in names]


def weight_below(values: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum the weights of the others below each value.

    The weights of equal ones count half. With `others = values` these are ranks: midranks less a half where all weights
    are 1.

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
