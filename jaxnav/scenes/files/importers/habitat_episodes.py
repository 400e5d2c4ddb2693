"""Episode files of Habitat's ObjectNav.

They have the starts of episodes, their goals, and places that are known to be standable. Habitat is right-handed with
-z forward; positions are given in the frame of scenes, with z negated.
"""

import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.record import Record, parse_json, read_bytes


class SceneEpisodes(NamedTuple):
    """Hold the episodes of one scene in one file.

    Attributes:
      record: the whole file; its errors name file and scene.
      name: of the scene, for example `Collierville`.
      mesh: name of the scene's file, for example `Collierville.glb`.
      episodes: at least one.
    """

    record: Record
    name: str
    mesh: str
    episodes: list[Record]


def episode_files(path: Path) -> list[Path]:
    """Return the episode files of a split.

    They are those of its `content` folder, or else the file itself or the files of the folder.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "content").is_dir():
        folder = folder / "content"
    elif folder != path:
        return [path]
    files = sorted(folder.glob("*.json.gz"))
    # SemExp keeps `X_episodes.json.gz` beside Habitat's `X.json.gz` or `X.glb.json.gz`, which it does not use.
    scenes = [file.name.split(".")[0] for file in files]
    return [file for file, scene in zip(files, scenes, strict=True) if f"{scene}_episodes" not in scenes]


def read_episodes(file: Path) -> list[SceneEpisodes]:
    """Read the episodes of a file, scene by scene.

    Raises:
      InputError: the file cannot be read, or an episode has no scene.
    """
    content = parse_json(str(file), read_bytes(file))
    if not isinstance(content, dict):
        raise InputError(f"{file}: is no object with episodes; give an ObjectNav episode file")
    whole = Record(str(file), content)
    scenes: dict[str, SceneEpisodes] = {}
    for i, value in enumerate(whole.sequence("episodes", whole.get("episodes"))):
        episode = whole.record(f"episodes[{i}]", value)
        mesh = episode.text("scene_id", episode.get("scene_id")).rsplit("/", 1)[-1]
        name = mesh.split(".")[0]
        where = f"{file}, scene {reprlib.repr(name)}"
        scene = scenes.setdefault(name, SceneEpisodes(Record(where, content), name, mesh, []))
        scene.episodes.append(Record(f"{where}: episodes[{i}]", episode.fields))
    return list(scenes.values())


def position(record: Record, field: str = "position") -> list[float]:
    """Read a position (x, y, z), metres, with z negated."""
    x, y, z = (record.number(field, value) for value in record.sequence(field, record.get(field), 3))
    return [x, y, 0.0 - z]


def goals(scene: SceneEpisodes) -> list[Record]:
    """Return the goal objects, each once.

    They are those of the scene's categories, or else those of its episodes.
    """
    by_category = scene.record.fields.get("goals_by_category")
    if by_category is None:
        lists = [(episode, "goals", episode.fields.get("goals") or []) for episode in scene.episodes]
    else:
        members = scene.record.record("goals_by_category", by_category)
        lists = [(members, key, value) for key, value in members.fields.items() if key.startswith(f"{scene.mesh}_")]
    unique: dict[Any, Record] = {}
    for record, field, values in lists:
        for i, value in enumerate(record.sequence(field, values)):
            goal = record.record(f"{field}[{i}]", value)
            identity = goal.fields.get("object_id")
            unique.setdefault(identity if isinstance(identity, int | str) else tuple(position(goal)), goal)
    return list(unique.values())


def standable_points(scene: SceneEpisodes, goals: list[Record]) -> np.ndarray:
    """Return the places that are known to be standable.

    They are starts, view points and points of shortest paths.

    Returns:
      float64 [N, 3], (x, y, z), metres, the starts first.
    """
    points = [position(episode, "start_position") for episode in scene.episodes]
    points += [point for goal in goals for point in _view_points(goal)]
    points += [point for episode in scene.episodes for point in _path_points(episode)]
    return np.array(points)


def _view_points(goal: Record) -> Iterator[list[float]]:
    for i, value in enumerate(goal.sequence("view_points", goal.fields.get("view_points") or [])):
        point = goal.record(f"view_points[{i}]", value)
        yield position(point.record("agent_state", point.get("agent_state")))


def _path_points(episode: Record) -> Iterator[list[float]]:
    for i, path in enumerate(episode.sequence("shortest_paths", episode.fields.get("shortest_paths") or [])):
        for j, value in enumerate(episode.sequence(f"shortest_paths[{i}]", path)):
            if isinstance(value, dict) and value.get("position") is not None:  # else it is an action alone
                yield position(episode.record(f"shortest_paths[{i}][{j}]", value))
