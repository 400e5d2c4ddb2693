"""State of an episode that is played by hand: the game itself, the view of the player at each step, and the result."""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.method import Knowledge
from jaxnav.runs.policy import LoadedPolicy
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.compile import Bank


class Game(NamedTuple):
    """Episode to be played by hand, with the agent whose belief is displayed.

    Attributes:
      world: compiled scenes; the game takes place in the first bank.
      episode: list of one episode.
      knowledge: layout priors.
      estimator_config: configuration of the layout estimator.
      policy: policy that gives advice; None for no advice.
      epsilon: threshold of sTDE in the advice.
    """

    world: CompiledWorld
    episode: EpisodeList
    knowledge: Knowledge
    estimator_config: EstimatorConfig
    policy: LoadedPolicy | None = None
    epsilon: float = 0.5

    @property
    def bank(self) -> Bank:
        """Tables of the scenes."""
        return self.world.banks[0]

    @property
    def goal(self) -> str:
        """Name of the category to search for."""
        return self.bank.task.categories[int(self.episode.goal[0])]


class GameView(NamedTuple):
    """Information for the player at one step, for K categories and A actions.

    Attributes:
      time: number of actions so far.
      step_limit: largest number of actions.
      heading: degrees clockwise from +z.
      horizon: tilt of the camera, degrees downwards.
      view_cells: uint8 [V, V], the view on the floor; see `RowFormat.view_cells`.
      detections: name, metres ahead, metres to the right and confidence from 0 to 1 of each, the nearest first.
      goal_weights: float32 [K], w x g of eq. 7.
      gap: layout gap D.
      advice: float32 [A], the policy's probability of each action; None without a policy.
    """

    time: int
    step_limit: int
    heading: float
    horizon: float
    view_cells: np.ndarray
    detections: list[tuple[str, float, float, float]]
    goal_weights: np.ndarray
    gap: float
    advice: np.ndarray | None


class GameResult(NamedTuple):
    """Result of a game that ended after T actions.

    Attributes:
      poses: int [T + 1], indices of the poses in the bank, from the start on.
      shortest_poses: int [L* + 1], poses of a shortest path.
      success: True if the game ended with Done where Done succeeds.
      said_done: True if the game ended with Done.
      has_quit: True if the player quit.
    """

    poses: list[int]
    shortest_poses: list[int]
    success: bool
    said_done: bool
    has_quit: bool

    @property
    def spl(self) -> float:
        """Success weighted by path length; both lengths count actions."""
        return self.success * (len(self.shortest_poses) - 1) / max(len(self.poses) - 1, 1)


def choose_episode(bank: Bank, goal: str | None, seed: int) -> EpisodeList:
    """Draw one of the episodes of an evaluation.

    Args:
      bank: tables of the scenes.
      goal: name of the category to search for; None for any.
      seed: seed of the draw, at least 0.

    Returns:
      A list of one episode.

    Raises:
      InputError: no episode has this goal, or the seed is negative.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: give a number of at least 0")

    # The list of an evaluation, with the name of each episode's goal.
    episodes = draw_episodes(bank, seed=seed)
    goal_names = np.array(bank.task.categories)[episodes.goal]

    # Of the episodes in a random order, the first one with this goal.
    candidate_indices = np.random.default_rng(seed).permutation(len(goal_names))
    if goal is not None:
        candidate_indices = candidate_indices[goal_names[candidate_indices] == goal]
    if not len(candidate_indices):
        raise InputError(f"--goal {goal}: choose one of {', '.join(sorted(set(goal_names)))}")
    return episodes.take(candidate_indices[:1])
