"""Importer of Habitat's ObjectNav, one scene per floor."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.assemble import Thing, lattice_cells, scene_of_cells
from jaxnav.scenes.files.importers.habitat_episodes import (
    SceneEpisodes,
    episode_files,
    goals,
    position,
    read_episodes,
    standable_points,
)
from jaxnav.scenes.files.importers.semantic_map import FloorMap, floor_map, read_maps, scene_of_map
from jaxnav.scenes.files.record import Record
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene

_FLOOR_REACH = 0.5  # metres above or below a floor's height that still belong to it
_FLOOR_SHARE = 0.05  # least share of all starts on a floor; with fewer they are on stairs
_UNDER_FLOOR = 0.25  # metres that the centre of an object may lie below its floor
_STOREY = 3.0  # metres that it may lie above it
_ON_MAP = 0.8  # least share of the starts on the map; with fewer the map is of another scene
_CONNECTED = 0.5  # least share of the known cells that are connected; with fewer the floor is hardly known


def read_habitat(path: Path, split: str, maps: Path | None = None) -> Iterator[Scene | InputError]:
    """Read a split of Habitat's ObjectNav.

    With `maps`, floor and objects come from the map (`scene_of_map`), and the episodes of a floor must start on it.
    Without, the standable cells are the lattice points nearest to the places in the episodes (`standable_points`), and
    the objects are the goals, in typical sizes. Few files have enough such places.

    Args:
      path: the folder of a split, its `<split>.json.gz` beside `content/`, or one file of `content/`.
      split: `train`, `val` or `test`.
      maps: a semantic floor map `*_info.pbz2`; all of its scenes are read if there is no episode.

    Yields:
      For every floor of every scene the `Scene`, or why it cannot be used.

    Raises:
      InputError: `path` or `maps` cannot be read.
    """
    floors = None if maps is None else read_maps(maps)
    files, empty = episode_files(path), True
    for file in files:
        try:
            scenes = read_episodes(file)
        except InputError as error:
            if files == [path]:
                raise
            yield error
            empty, scenes = False, []
        for scene in scenes:
            empty = False
            if floors is None:
                yield from _unmapped_floors(scene, split)
            elif scene.name in floors:
                yield from _mapped_floors(scene.name, split, floors[scene.name], scene.episodes)
            else:
                yield InputError(f"{scene.record.where}: is not in {maps}; give the map of this split")
    if empty and floors is None:
        raise InputError(f"{path}: holds no episode; give the folder of a split, or a semantic floor map (--maps)")
    for name, records in floors.items() if empty and floors else ():
        yield from _mapped_floors(name, split, records, [])


def _mapped_floors(
    name: str, split: str, records: dict[int, Record], episodes: Sequence[Record]
) -> Iterator[Scene | InputError]:
    floors: dict[int, FloorMap] = {}
    for number, record in records.items():
        try:
            floors[number] = floor_map(record)
        except InputError as error:
            yield error
    for number, floor in floors.items():
        try:
            scene = scene_of_map(records[number], f"{name}_floor{number}", split, floor)
            _check_starts(records[number], scene, _starts_on(number, floors, episodes))
        except InputError as error:
            yield error
        else:
            yield scene


def _starts_on(number: int, floors: dict[int, FloorMap], episodes: Sequence[Record]) -> np.ndarray:
    """Return the starts on a floor.

    The floor of an episode is its `floor_id`, or else the nearest.

    Returns:
      float64 [N, 2], (x, z), metres.
    """
    starts = []
    for episode in episodes:
        x, y, z = position(episode, "start_position")
        nearest = min(floors, key=lambda k: abs(floors[k].height - y))
        if episode.fields.get("floor_id", nearest) == number:
            starts.append((x, z))
    return np.array(starts, np.float64).reshape(-1, 2)


def _check_starts(record: Record, scene: Scene, starts: np.ndarray) -> None:
    """Refuse a map that does not fit its episodes.

    A start must lie on a standable cell or beside one.
    """
    cells = np.argwhere(scene.reach).tolist()
    near = {(z + dz, x + dx) for z, x in cells for dz in (-1, 0, 1) for dx in (-1, 0, 1)}
    index = np.rint((starts - scene.origin) / CELL).astype(int)
    on_map = sum((z, x) in near for x, z in index.tolist())
    if on_map < _ON_MAP * len(starts):
        problem = f"has {on_map} of {len(starts)} starts of its episodes on navigable floor"
        raise record.error("sem_map", f"{problem}; give map and episodes of the same scenes")


def _unmapped_floors(scene: SceneEpisodes, split: str) -> Iterator[Scene | InputError]:
    try:
        objects = goals(scene)
        points = standable_points(scene, objects)
        centres = np.array([position(goal) for goal in objects]).reshape(-1, 3)
        types = [goal.text("object_category", goal.get("object_category")) for goal in objects]
    except InputError as error:
        yield error
        return
    heights = _floor_heights(points[: len(scene.episodes), 1])
    below = np.searchsorted(heights, centres[:, 1] + _UNDER_FLOOR, side="right") - 1
    for number, height in enumerate(heights):
        record = Record(f"{scene.record.where}: floor {number}", {})
        things = [
            Thing(types[i], (x, y - height, z, *typical_box(types[i])[:3]))
            for i, (x, y, z) in enumerate(centres.tolist())
            if below[i] == number and y - height <= _STOREY
        ]
        on_floor = points[np.abs(points[:, 1] - height) <= _FLOOR_REACH]
        try:
            floor_scene = _scene_of_points(record, f"{scene.name}_floor{number}", split, on_floor[:, ::2], things)
        except InputError as error:
            yield error
        else:
            yield floor_scene


def _scene_of_points(record: Record, name: str, split: str, points: np.ndarray, things: Sequence[Thing]) -> Scene:
    """Build a scene from standable points [N, 2], (x, z).

    The lattice points nearest to them are standable.
    """
    if not things:
        raise record.error("goals", "has no object on this floor; give a semantic floor map (--maps)")
    cells = np.unique(lattice_cells(record, "start_position", (CELL * np.rint(points / CELL)).tolist()), axis=0)
    scene = scene_of_cells(name, "habitat", "house", split, cells, things)
    connected = len(standable_cells(scene.reach))
    if connected < _CONNECTED * len(cells):
        problem = f"and view points are {len(cells)} cells, of which only {connected} are connected"
        raise record.error("start_position", f"{problem}; give a semantic floor map (--maps)")
    return scene


def _floor_heights(y: np.ndarray) -> list[float]:
    """Return the heights of floors by those of starts, ascending."""
    heights, left = [], np.sort(y)
    while len(left):
        ends = np.searchsorted(left, left + 2 * _FLOOR_REACH, side="right")
        first = int(np.argmax(ends - np.arange(len(left))))
        floor = slice(first, ends[first])
        if len(left[floor]) < _FLOOR_SHARE * len(y):
            break
        heights.append(float(np.median(left[floor])))
        left = np.delete(left, floor)
    return sorted(heights)
