"""A mixed population: episodes of which some are in scenes of another layout."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console

from jaxnav.evaluation.episodes import EpisodeList, together
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import CompiledWorld, evaluation_world, one_world
from jaxnav.study.bench import study_episodes
from jaxnav.study.config import StudyConfig


class Population(NamedTuple):
    """Hold the episodes of all shifts in one world.

    Attributes:
      world: the scenes at each shift, end to end.
      episodes: equally many at each shift.
      shift: int [E], index of each episode's shift.
    """

    world: CompiledWorld
    episodes: EpisodeList
    shift: np.ndarray


def mixed_population(run: RunConfig, shifts: Sequence[float], config: StudyConfig, console: Console) -> Population:
    """Draw episodes at every shift.

    Args:
      run: whose scenes.
      shifts: of the layout.
      config: of the study: split of the scenes, episodes at each shift, and the seed of their draw.
      console: shows the progress.

    Raises:
      InputError: see `evaluation_world` and `one_world`.
    """
    worlds = [evaluation_world(run, config.split, None, shift, console) for shift in shifts]
    lists = [study_episodes(world, config) for world in worlds]
    return Population(
        one_world(worlds),
        end_to_end(lists, [len(world.banks[0].rows) for world in worlds]),
        np.repeat(np.arange(len(shifts)), [len(episodes.pose) for episodes in lists]),
    )


def end_to_end(lists: Sequence[EpisodeList], poses: Sequence[int]) -> EpisodeList:
    """Join lists of banks that were put end to end.

    Args:
      lists: of each bank.
      poses: number of each bank.
    """
    whole = together(lists)
    first = np.cumsum([0, *poses[:-1]])
    pose = [episodes.pose + start for episodes, start in zip(lists, first, strict=True)]
    return whole._replace(pose=np.concatenate(pose).astype(np.int32))
