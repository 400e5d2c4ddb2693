"""Scenes and training runs that several conditions share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.evaluation.statistics import Clusters, Interval, jackknife, scene_clusters, training_runs
from jaxnav.scenes.scene import floor_plan


class Design(NamedTuple):
    """Hold what the conditions share.

    A scene is left out of all conditions at once, with its floor plan, and so is a training run.

    Attributes:
      names, plans, rooms: [N] of all scenes, of their floor plans and room types; names are sorted.
      scenes: their clusters.
      runs: the training runs.
    """

    names: tuple[str, ...]
    plans: np.ndarray
    rooms: np.ndarray
    scenes: Clusters
    runs: Clusters

    @classmethod
    def of(cls, conditions: Sequence[tuple[Sequence[str], Sequence[str]]], seeds: int) -> "Design":
        """Return what conditions share.

        Args:
          conditions: names of the scenes and of their room types, of each.
          seeds: number of training runs.
        """
        rooms = {name: room for names, types in conditions for name, room in zip(names, types, strict=True)}
        names = tuple(sorted(rooms))
        plans, types = np.array([floor_plan(name) for name in names]), np.array([rooms[name] for name in names])
        return cls(names, plans, types, scene_clusters(plans, types), training_runs(1, seeds))

    def means(self, sums: np.ndarray, weights: np.ndarray, names: Sequence[str], *, trained: bool = True) -> np.ndarray:
        """Return a mean of one condition, without each run and scene.

        Args:
          sums: float64 [S, N], of a measure over the episodes of a scene, by training run; [1, N] of what is untrained.
          weights: [N], numbers of episodes.
          names: [N] of the scenes.
          trained: whether it varies with the training run.

        Returns:
          float64 [1 + R, 1 + C], or [1 + C] of what is untrained; NaN where no episode is left.
        """
        index = np.searchsorted(self.names, names)
        counts = np.bincount(index, weights, len(self.names))
        scenes = scene_clusters(self.plans, self.rooms, counts).weights[index]
        left = np.broadcast_to(weights @ scenes, (len(sums), scenes.shape[1]))
        means = np.divide(sums @ scenes, left, out=np.full(left.shape, np.nan), where=left > 0)
        return self.runs.weights.T @ means / len(means) if trained else means[0]

    def interval(self, means: np.ndarray) -> Interval:
        """Return the interval of what follows from means."""
        return jackknife(means, self.scenes, None if means.ndim == 1 else self.runs)
