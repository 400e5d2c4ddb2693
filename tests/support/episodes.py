"""Episode lists made by hand."""

from collections.abc import Sequence

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList


def episodes_in(
    scene: Sequence[int] | np.ndarray,
    goal: Sequence[int] | np.ndarray | None = None,
    room: Sequence[int] | np.ndarray | None = None,
    names: tuple[str, ...] | None = None,
    best_length: int | np.ndarray = 1,
) -> EpisodeList:
    """Episodes in these scenes.

    Args:
      scene: [E], scene of each episode.
      goal: [E], goal category of each episode; 0 unless given.
      room: [N], room type of each scene; one for all unless given.
      names: [N], names of the scenes; `room00`, `room01`, ... unless given.
      best_length: of each episode, or of all.
    """
    scene = np.asarray(scene, np.int32)
    num_scenes = int(scene.max()) + 1
    num_episodes = len(scene)
    room_by_scene = np.zeros(num_scenes, int) if room is None else np.asarray(room)
    return EpisodeList(
        scene=scene,
        goal=np.zeros(num_episodes, np.int32) if goal is None else np.asarray(goal, np.int32),
        pose=np.ones(num_episodes, np.int32),
        best_length=np.full(num_episodes, best_length, np.int32),
        room=room_by_scene[scene],
        rooms=("bedroom", "kitchen"),
        scenes=tuple(f"room{index:02}" for index in range(num_scenes)) if names is None else names,
    )
