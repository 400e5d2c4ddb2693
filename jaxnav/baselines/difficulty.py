"""How hard scenes are for one who knows everything and for one who knows nothing: exact, over all their episodes."""

import numpy as np

from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE, NUM_ACTIONS

#: Actions after which a random episode counts as over: it is still going on with probability (5 / 6)^100 = 1.2e-8.
LONGEST = 100


def expected_length(bank: Bank) -> np.ndarray:
    """Mean L* over the episodes of each scene, as `episode_list` draws them: float64 [S], actions with Done."""
    every = [_lengths(bank, scene) for scene in _scenes(bank)]
    return np.array([_mean_over_episodes(lengths, lengths) for lengths in every])


def random_success(bank: Bank, step_limit: np.ndarray) -> np.ndarray:
    """Success rate of uniformly random actions in the episodes of each scene.

    With t actions left, p_t(pose) = (found(pose) + sum over the other five actions of p_{t-1}(pose after it)) / 6.

    Args:
      bank: the scenes.
      step_limit: int [S], of each scene.

    Returns:
      float64 [S], in [0, 1].
    """
    successor, rates = bank.successor, []
    for scene in _scenes(bank):
        lengths = _lengths(bank, scene)
        first = bank.first_cell[scene] * bank.task.rules.poses_per_cell
        after = successor[first : first + len(lengths), :DONE] - first
        found, success = (lengths == 1).astype(np.float64), np.zeros(lengths.shape)
        for _ in range(min(int(step_limit[scene]), LONGEST)):
            success = (found + sum(success[own] for own in after.T)) / NUM_ACTIONS
        rates.append(_mean_over_episodes(success, lengths))
    return np.array(rates)


def _scenes(bank: Bank) -> range:
    return range(len(bank.names))


def _lengths(bank: Bank, scene: int) -> np.ndarray:
    """L* from each pose of a scene to each of its possible goals, [poses, goals], 0 where there is no way."""
    poses_per_cell = bank.task.rules.poses_per_cell
    first, goals = bank.first_cell[scene] * poses_per_cell, bank.goals[scene, : bank.num_goals[scene]]
    return bank.best_length[first : first + bank.num_cells[scene] * poses_per_cell, goals]


def _mean_over_episodes(values: np.ndarray, lengths: np.ndarray) -> float:
    """Mean with goals equally likely, and for each of them the poses that it can be reached from."""
    return float(np.mean(values, axis=0, where=lengths > 0).mean())
