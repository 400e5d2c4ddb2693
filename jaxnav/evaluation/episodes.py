"""Fixed lists of evaluation episodes."""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.compile import Bank
from jaxnav.scenes.lattice import POSES_PER_CELL


class EpisodeList(NamedTuple):
    """E episodes, fixed before anything is run.

    Attributes:
      scene, goal, pose: int32 [E], indices into the bank.
      best_length: int32 [E], L* >= 1.
      room: int [E], index into `rooms`; the strata of the statistics.
      rooms: names of the room types.
    """

    scene: np.ndarray
    goal: np.ndarray
    pose: np.ndarray
    best_length: np.ndarray
    room: np.ndarray
    rooms: tuple[str, ...]


def episode_list(bank: Bank, episodes: int = 1000, seed: int = 0) -> EpisodeList:
    """Draw the episodes of a bank by the paper's rule: equally many per room type, balanced over its scenes.

    In each scene the goal is uniform over its possible categories, the start uniform over all poses that can reach it.

    Args:
      bank: the scenes.
      episodes: E, rounded up to a multiple of the number of room types.
      seed: of the draw.

    Raises:
      InputError: fewer than one episode.
    """
    if episodes < 1:
        raise InputError(f"--episodes {episodes}: give at least 1")
    rooms = tuple(sorted(set(bank.room_types)))
    per_room = -(-episodes // len(rooms))
    generator = np.random.default_rng([seed, len(bank.names)])
    rows = []
    for room, name in enumerate(rooms):
        scenes = [i for i, room_type in enumerate(bank.room_types) if room_type == name]
        for number in range(per_room):
            scene = scenes[number % len(scenes)]
            goal = generator.choice(bank.goals[scene, : bank.num_goals[scene]])
            first = bank.first_cell[scene] * POSES_PER_CELL
            lengths = bank.best_length[first : first + bank.num_cells[scene] * POSES_PER_CELL, goal]
            start = generator.choice(np.flatnonzero(lengths))
            rows.append((scene, goal, first + start, lengths[start], room))
    scene, goal, pose, best_length, room = np.array(rows, np.int32).T
    return EpisodeList(scene=scene, goal=goal, pose=pose, best_length=best_length, room=room, rooms=rooms)
