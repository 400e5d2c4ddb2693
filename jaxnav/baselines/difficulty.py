"""Exact difficulty of scenes: shortest paths and random success."""

import numpy as np

from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE, NUM_ACTIONS

#: Actions after which a random episode counts as over; it still runs with probability (5 / 6)^100 = 1.2e-8.
LONGEST = 100


def expected_length(bank: Bank) -> np.ndarray:
    """Return the mean L* over the episodes of each scene.

    Goals and starts are weighted as `episode_list` draws them.

    Returns:
      float64 [S], actions, Done included.
    """
    every = [_lengths(bank, scene) for scene in _scenes(bank)]
    return np.array([_mean_over_episodes(lengths, lengths) for lengths in every])


def random_success(bank: Bank, step_limit: np.ndarray) -> np.ndarray:
    """Return the success rate of uniformly random actions.

    With t actions left, p_t(pose) = (1 if Done succeeds at the pose + sum over the other five actions of
    p_{t-1}(pose after it)) / 6.

    Args:
      bank: the scenes.
      step_limit: int [S], actions of an episode in each scene.

    Returns:
      float64 [S], in [0, 1].
    """
    successor, rates = bank.successor, []
    for scene in _scenes(bank):
        lengths = _lengths(bank, scene)
        first = bank.first_cell[scene] * bank.task.rules.poses_per_cell
        after = successor[first : first + len(lengths), :DONE] - first
        done, success = (lengths == 1).astype(np.float64), np.zeros(lengths.shape)
        for _ in range(min(int(step_limit[scene]), LONGEST)):
            success = (done + sum(success[poses] for poses in after.T)) / NUM_ACTIONS
        rates.append(_mean_over_episodes(success, lengths))
    return np.array(rates)


def _scenes(bank: Bank) -> range:
    return range(len(bank.names))


def _lengths(bank: Bank, scene: int) -> np.ndarray:
    """Return L* from each pose to each possible goal.

    Returns:
      uint16 [poses, goals], 0 where there is no way.
    """
    poses_per_cell = bank.task.rules.poses_per_cell
    first, goals = bank.first_cell[scene] * poses_per_cell, bank.goals[scene, : bank.num_goals[scene]]
    return bank.best_length[first : first + bank.num_cells[scene] * poses_per_cell, goals]


def _mean_over_episodes(values: np.ndarray, lengths: np.ndarray) -> float:
    """Return the average over goals and their starts.

    A start is a pose from which the goal can be reached.
    """
    return float(np.mean(values, axis=0, where=lengths > 0).mean())
