"""What the detector tells of goals, category by category."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import Bank, in_view
from jaxnav.scenes.tables.observation_row import RowFormat


class Detection(NamedTuple):
    """Hold shares of poses by scene and goal category.

    All are float64 [N, K], NaN of categories that are no goal of a scene.

    Attributes:
      detected: poses that detect a goal, of those that have it in view; see `in_view`.
      succeeds: poses where Done would succeed, of those; NaN where a goal is never detected.
      distance: metres from the cells to the nearest object, in the mean; see `SceneTable.goal_distance`.
    """

    detected: np.ndarray
    succeeds: np.ndarray
    distance: np.ndarray


def measure_detection(bank: Bank, scenes: Iterator[Scene]) -> Detection:
    """Measure the detection of goals over all poses.

    Args:
      bank: N scenes.
      scenes: what it was compiled from, in its order; those that the bank left out are passed over.
    """
    poses_per_cell, row_format = bank.task.rules.poses_per_cell, RowFormat(len(bank.task.categories))
    measures = np.full((3, len(bank.names), len(bank.task.categories)), np.nan)
    for i, name in enumerate(bank.names):
        scene = next(scene for scene in scenes if scene.name == name)
        cells = slice(bank.first_cell[i], bank.first_cell[i] + bank.num_cells[i])
        poses = slice(cells.start * poses_per_cell, cells.stop * poses_per_cell)
        goals = bank.goals[i, : bank.num_goals[i]]
        view = in_view(scene, bank.task)[:, goals]
        detected = view & row_format.presence(bank.rows[poses])[:, goals]  # false alarms are left out
        succeeds = detected & (bank.best_length[poses][:, goals] == 1)
        distance = bank.goal_distance[cells][:, goals]
        near = np.isfinite(distance)
        measures[:, i, goals] = (
            _share(detected, view),
            _share(succeeds, detected),
            np.where(near, distance, 0.0).sum(axis=0) / near.sum(axis=0),
        )
    return Detection(*measures)


def _share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return how much of each column is in a part, float64 [K]."""
    count = whole.sum(axis=0)
    return np.divide(part.sum(axis=0), count, out=np.full(len(count), np.nan), where=count > 0)
