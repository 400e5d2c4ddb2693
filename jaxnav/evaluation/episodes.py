"""Fixed lists of evaluation episodes."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Clusters, scene_clusters
from jaxnav.scenes.scene import floor_plan
from jaxnav.scenes.tables.compile import Bank

#: Episodes of a bank at most: so many take a minute to draw, and memory in every row of a table.
MAX_EPISODES = 10**6


class EpisodeList(NamedTuple):
    """Hold E episodes, fixed before anything is run.

    Attributes:
      scene, goal, pose: int32 [E], indices into the bank.
      best_length: int32 [E], L* >= 1.
      room: int [E], index into `rooms`.
      rooms: names of the room types.
      scenes: names of the scenes.
    """

    scene: np.ndarray
    goal: np.ndarray
    pose: np.ndarray
    best_length: np.ndarray
    room: np.ndarray
    rooms: tuple[str, ...]
    scenes: tuple[str, ...]

    @property
    def plan(self) -> np.ndarray:
        """Return the floor plan of each episode, [E]; see `floor_plan`."""
        return np.array([floor_plan(name) for name in self.scenes])[self.scene]

    def take(self, chosen: np.ndarray) -> "EpisodeList":
        """Return the chosen episodes; bool [E], or indices."""
        fields = ("scene", "goal", "pose", "best_length", "room")
        return self._replace(**{name: getattr(self, name)[chosen] for name in fields})

    def clusters(self) -> Clusters:
        """Return the floor plans as clusters, within room types."""
        return scene_clusters(self.plan, self.room)


def clusters_of(lists: Sequence[EpisodeList]) -> list[Clusters]:
    """Return the floor plans of several lists as clusters.

    A floor plan that is in several lists is left out of all at once.
    """
    whole = together(lists)
    clusters = whole.clusters()
    ends = np.cumsum([len(episodes.scene) for episodes in lists])[:-1]
    return [clusters._replace(weights=weights) for weights in np.split(clusters.weights, ends)]


def episode_list(bank: Bank, episodes: int = 1000, seed: int = 0, part: int = 0) -> EpisodeList:
    """Draw the episodes of a bank by the paper's rule.

    Equally many per room type, balanced over its scenes. In each scene the goal is uniform over its possible
    categories, the start uniform over all poses that can reach it.

    Args:
      bank: the scenes.
      episodes: E, rounded up to a multiple of the number of room types.
      seed: of the draw.
      part: number of the bank among those that are evaluated together; each has draws of its own.

    Raises:
      InputError: fewer than one episode, or too many.
    """
    if not 1 <= episodes <= MAX_EPISODES:
        raise InputError(f"--episodes {episodes}: give at least 1, and at most {MAX_EPISODES}")
    rooms = tuple(sorted(set(bank.room_types)))
    per_room = -(-episodes // len(rooms))
    generator = np.random.default_rng([seed, len(bank.names), part])
    poses_per_cell = bank.task.rules.poses_per_cell
    rows = []
    for room, name in enumerate(rooms):
        scenes = [i for i, room_type in enumerate(bank.room_types) if room_type == name]
        for number in range(per_room):
            scene = scenes[number % len(scenes)]
            goal = generator.choice(bank.goals[scene, : bank.num_goals[scene]])
            first = bank.first_cell[scene] * poses_per_cell
            lengths = bank.best_length[first : first + bank.num_cells[scene] * poses_per_cell, goal]
            start = generator.choice(np.flatnonzero(lengths))
            rows.append((scene, goal, first + start, lengths[start], room))
    scene, goal, pose, best_length, room = np.array(rows, np.int32).T
    return EpisodeList(
        scene=scene, goal=goal, pose=pose, best_length=best_length, room=room, rooms=rooms, scenes=bank.names
    )


def together(lists: Sequence[EpisodeList]) -> EpisodeList:
    """Join the lists of several banks, for statistics and reports.

    The `scene` of the whole list is an index into its `scenes`.
    """
    rooms = tuple(sorted({room for episodes in lists for room in episodes.rooms}))
    first = np.cumsum([0] + [len(episodes.scenes) for episodes in lists])

    def joined(arrays: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate(list(arrays)).astype(np.int32)

    return EpisodeList(
        scene=joined(episodes.scene + start for episodes, start in zip(lists, first, strict=False)),
        goal=joined(episodes.goal for episodes in lists),
        pose=joined(episodes.pose for episodes in lists),
        best_length=joined(episodes.best_length for episodes in lists),
        room=joined(np.array([rooms.index(room) for room in episodes.rooms])[episodes.room] for episodes in lists),
        rooms=rooms,
        scenes=tuple(name for episodes in lists for name in episodes.scenes),
    )
