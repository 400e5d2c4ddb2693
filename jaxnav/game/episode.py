"""An episode to be played by hand: what is given, what is seen, how it ends."""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.layout import Setting
from jaxnav.policies.methods import Knowledge
from jaxnav.runs.policy import LoadedPolicy
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.compile import Bank


class Game(NamedTuple):
    """Hold an episode to be played, and whose belief is shown beside it.

    Attributes:
      world: its scenes; the first bank is played in.
      episode: a list of one.
      knowledge: with the layout priors.
      setting: of the layout estimator.
      policy: whose advice is shown; None for none.
      epsilon: threshold of sTDE in that advice.
    """

    world: CompiledWorld
    episode: EpisodeList
    knowledge: Knowledge
    setting: Setting
    policy: LoadedPolicy | None = None
    epsilon: float = 0.5

    @property
    def bank(self) -> Bank:
        """Return the tables of the scenes."""
        return self.world.banks[0]

    @property
    def goal(self) -> str:
        """Return the name of what is sought."""
        return self.bank.task.categories[int(self.episode.goal[0])]


class Look(NamedTuple):
    """Hold what a player gets to know at one step.

    Attributes:
      time, limit: actions taken so far and at most.
      heading: degrees clockwise from +z.
      horizon: degrees downwards, of the camera.
      cells: uint8 [V, V], the view on the floor; see `RowFormat.view_cells`.
      seen: name, metres ahead, metres to the right and confidence from 0 to 1 of each detection, the nearest first.
      weights: float32 [K], w x g of eq. 7.
      gap: layout gap D.
      advice: float32 [A], a policy's probability of each action; None without a policy.
    """

    time: int
    limit: int
    heading: float
    horizon: float
    cells: np.ndarray
    seen: list[tuple[str, float, float, float]]
    weights: np.ndarray
    gap: float
    advice: np.ndarray | None


class Ending(NamedTuple):
    """Hold how a game ended.

    Attributes:
      poses: int [T + 1], of the bank, from the start on.
      best: int [L* + 1], those of a shortest path.
      success: whether it ended with Done where that succeeds.
      done: whether it ended with Done at all.
      quit: whether the player left.
    """

    poses: list[int]
    best: list[int]
    success: bool
    done: bool
    quit: bool

    @property
    def spl(self) -> float:
        """Return success weighted by path length; both count actions."""
        return self.success * (len(self.best) - 1) / max(len(self.poses) - 1, 1)


def choose_episode(bank: Bank, goal: str | None, seed: int) -> EpisodeList:
    """Draw one of an evaluation's episodes.

    Args:
      bank: the scenes.
      goal: name of the category to search for; None for any.
      seed: of the draw, at least 0.

    Raises:
      InputError: no episode has that goal, or a negative seed.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: give a number of at least 0")
    episodes = episode_list(bank, seed=seed)
    names = np.array(bank.task.categories)[episodes.goal]
    drawn = np.random.default_rng(seed).permutation(len(names))
    fitting = drawn if goal is None else drawn[names[drawn] == goal]
    if not len(fitting):
        raise InputError(f"--goal {goal}: choose one of {', '.join(sorted(set(names)))}")
    return episodes.take(fitting[:1])
