"""Fixed lists of evaluation episodes.

`draw_episodes` draws the episodes of a bank before any agent is run, so that all agents meet the same ones.
`join_episode_lists` joins the lists of several banks for statistics and reports.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Clusters, scene_clusters
from jaxnav.scenes.scene import floor_plan_name
from jaxnav.scenes.tables.compile import Bank

Array = TypeVar("Array", np.ndarray, jax.Array)

#: Upper bound on the episodes of a bank: a million take about a minute to draw, and memory in every row of a table.
MAX_EPISODES = 10**6


class EpisodeList(NamedTuple):
    """List of E episodes.

    Attributes:
      scene, goal, pose: int32 [E], indices into the bank.
      best_length: int32 [E], L* >= 1, length of a shortest successful episode.
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
    def num_drawn_scenes(self) -> int:
        """Number of scenes with episodes; few episodes leave some scenes without any."""
        return len(np.unique(self.scene))

    @property
    def floor_plans(self) -> np.ndarray:
        """Floor plan of each episode, [E]; see `floor_plan_name`."""
        plan_by_scene = np.array(list(map(floor_plan_name, self.scenes)))
        return plan_by_scene[self.scene]

    def take(self, selection: np.ndarray) -> "EpisodeList":
        """Select episodes by a mask, bool [E], or by indices."""
        return self._replace(
            scene=self.scene[selection],
            goal=self.goal[selection],
            pose=self.pose[selection],
            best_length=self.best_length[selection],
            room=self.room[selection],
        )

    @property
    def room_rank(self) -> np.ndarray:
        """Number of earlier episodes of the same room type, int32 [E]."""
        ranks = np.zeros(len(self.room), np.int32)
        for room in set(self.room.tolist()):
            in_room = self.room == room
            ranks[in_room] = np.arange(in_room.sum())
        return ranks

    def clusters(self) -> Clusters:
        """Cluster the episodes by floor plan, within room types."""
        return scene_clusters(self.floor_plans, self.room)


def select_first_episodes(room_rank: Array, max_room_episodes: Any) -> Array:
    """True for the first `max_room_episodes` episodes of each room type, bool [E].

    Args:
      room_rank: int32 [E], `EpisodeList.room_rank`, of NumPy or traced.
      max_room_episodes: largest number of episodes of a room type, int or int32 [].
    """
    return room_rank < max_room_episodes


def draw_episodes(bank: Bank, num_episodes: int = 1000, seed: int = 0, bank_index: int = 0) -> EpisodeList:
    """Draw the episodes of a bank by the paper's rule.

    Each room type has equally many episodes, balanced over its scenes. In each scene, the goal is uniform over its
    possible categories, and the start is uniform over all poses that can reach the goal.

    Args:
      bank: the scenes.
      num_episodes: E, rounded up to a multiple of the number of room types.
      seed: seed of the draw.
      bank_index: index of the bank among those evaluated together; each bank has draws of its own.

    Raises:
      InputError: fewer than one episode, or too many.
    """
    if not 1 <= num_episodes <= MAX_EPISODES:
        raise InputError(f"--episodes {num_episodes}: give at least 1, and at most {MAX_EPISODES}")

    # Round up, so that every room type has equally many episodes.
    rooms = tuple(sorted(set(bank.room_types)))
    episodes_per_room = -(-num_episodes // len(rooms))
    poses_per_cell = bank.task.rules.poses_per_cell

    # The bank's index is part of the seed, so that banks evaluated together have independent draws.
    random_generator = np.random.default_rng([seed, len(bank.names), bank_index])

    # Draw goal, then start, episode by episode: the order of the draws defines the list.
    episode_rows = []
    for room_index, room_type in enumerate(rooms):
        room_scenes = np.flatnonzero(np.array(bank.room_types) == room_type)
        for episode in range(episodes_per_room):
            # Scenes take turns; every category that a scene offers as a goal is equally likely.
            scene = room_scenes[episode % len(room_scenes)]
            goal = random_generator.choice(bank.goals[scene, : bank.num_goals[scene]])

            # A length of 0 marks poses of the scene that cannot reach the goal.
            first_pose = bank.first_cell[scene] * poses_per_cell
            end_pose = first_pose + bank.num_cells[scene] * poses_per_cell
            best_lengths = bank.best_length[first_pose:end_pose, goal]
            start_offset = random_generator.choice(np.flatnonzero(best_lengths))
            episode_rows.append((scene, goal, first_pose + start_offset, best_lengths[start_offset], room_index))

    # From one row per episode to one array [E] per field.
    scene, goal, pose, best_length, room = np.array(episode_rows, np.int32).T
    return EpisodeList(
        scene=scene, goal=goal, pose=pose, best_length=best_length, room=room, rooms=rooms, scenes=bank.names
    )


def join_episode_lists(lists: Sequence[EpisodeList]) -> EpisodeList:
    """Join the lists of several banks, for statistics and reports.

    `scene` and `room` of the result are indices into its own `scenes` and `rooms`; `pose` still counts from the start
    of each bank.
    """
    # A room type keeps one index in the joined list, whichever banks contain it.
    room_names: set[str] = set()
    for episodes in lists:
        room_names.update(episodes.rooms)
    rooms = tuple(sorted(room_names))

    # Scenes are numbered on from list to list, rooms are renumbered by name.
    scene_names: list[str] = []
    list_columns = []
    for episodes in lists:
        joined_scene = episodes.scene + len(scene_names)
        joined_room = np.array(list(map(rooms.index, episodes.rooms)))[episodes.room]
        list_columns.append([joined_scene, episodes.goal, episodes.pose, episodes.best_length, joined_room])
        scene_names.extend(episodes.scenes)

    # From [5, E] of every list to one array per field.
    scene, goal, pose, best_length, room = np.concatenate(list_columns, axis=1).astype(np.int32)
    return EpisodeList(scene, goal, pose, best_length, room, rooms, tuple(scene_names))


def joint_clusters(lists: Sequence[EpisodeList]) -> list[Clusters]:
    """Cluster the episodes of several lists, one result per list.

    A floor plan that occurs in several lists is omitted from all of them at once.
    """
    clusters = join_episode_lists(lists).clusters()

    # Every list gets its own rows of the weights; columns and scale are shared.
    list_ends = np.cumsum([len(episodes.scene) for episodes in lists])[:-1]
    return [clusters._replace(weights=weights) for weights in np.split(clusters.weights, list_ends)]
