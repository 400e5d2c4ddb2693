"""Exact difficulty of scenes: mean shortest path length, and success rate of random actions."""

import numpy as np

from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE, NUM_ACTIONS

#: Actions after which a random episode counts as over; it continues with probability (5 / 6)^100 = 1.2e-8.
MAX_RANDOM_ACTIONS = 100


def expected_length(bank: Bank) -> np.ndarray:
    """Return the mean shortest path length L* over the episodes of each scene.

    Goals and starts are weighted as `draw_episodes` draws them.

    Returns:
      float64 [S], actions, Done included.
    """
    means = []
    for scene in range(len(bank.names)):
        lengths = _scene_lengths(bank, scene)
        means.append(_mean_over_episodes(lengths, lengths))
    return np.array(means)


def random_success(bank: Bank, step_limit: np.ndarray) -> np.ndarray:
    """Return the success rate of uniformly random actions.

    With t actions left, p_t(pose) = (1 if Done succeeds at the pose + sum over the other five actions of
    p_{t-1}(pose after the action)) / 6.

    Args:
      bank: the scenes.
      step_limit: int [S], greatest number of actions in each scene.

    Returns:
      float64 [S], in [0, 1].
    """
    successor = bank.successor
    rates = []
    for scene in range(len(bank.names)):
        # Successors within the scene, except for Done.
        lengths = _scene_lengths(bank, scene)
        first_pose = bank.first_cell[scene] * bank.task.rules.poses_per_cell
        next_poses = successor[first_pose : first_pose + len(lengths), :DONE] - first_pose

        # Dynamic programming over the number of actions left.
        done_succeeds = (lengths == 1).astype(np.float64)
        success_rate = np.zeros(lengths.shape)
        for _ in range(min(int(step_limit[scene]), MAX_RANDOM_ACTIONS)):
            success_rate = (done_succeeds + sum(success_rate[poses] for poses in next_poses.T)) / NUM_ACTIONS
        rates.append(_mean_over_episodes(success_rate, lengths))
    return np.array(rates)


def _scene_lengths(bank: Bank, scene: int) -> np.ndarray:
    """Return L* from each pose of a scene to each of its goals, uint16 [poses, goals], 0 if there is no path."""
    poses_per_cell = bank.task.rules.poses_per_cell
    first_pose = bank.first_cell[scene] * poses_per_cell
    num_poses = bank.num_cells[scene] * poses_per_cell
    goals = bank.goals[scene, : bank.num_goals[scene]]
    return bank.best_length[first_pose : first_pose + num_poses, goals]


def _mean_over_episodes(values: np.ndarray, lengths: np.ndarray) -> float:
    """Return the mean over goals of the means over starts, the poses from which the goal can be reached."""
    return float(np.mean(values, axis=0, where=lengths > 0).mean())
