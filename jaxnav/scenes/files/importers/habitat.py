"""Importer of Habitat's ObjectNav, one scene per floor of a home.

`read_habitat` reads episode files, which have the starts of episodes, their goals, and places that are standable.
Habitat is right-handed with -z forward; positions are given in the frame of scenes, with z negated.

Episode files lack the free floor. The semantic floor maps of SemExp (`*_info.pbz2`, `read_floor_maps`) have it, in
layers of 0 and 1 at 5 cm. Pixel [i, j] of a map covers Habitat's x from `origin[1] + 5 i` to `+ 5` cm, and Habitat's z
from `origin[0] + 5 j` to `+ 5` cm.
"""

import dataclasses
import itertools
import re
import reprlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import GIBSON_CATEGORIES
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount
from jaxnav.scenes.files.importers.assemble import SceneObject, build_scene_from_cells, lattice_cells, scene_or_error
from jaxnav.scenes.files.importers.pickled_arrays import PickledArray, read_pickle
from jaxnav.scenes.files.scene_file import JsonRecord, count_items, list_visible_files, parse_json, read_bytes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import connected_parts, standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene

# Endings of the files of scenes; any other dot belongs to the name of a scene.
_MESH_ENDING = re.compile(r"(\.basis|\.semantic)?\.(glb|gltf|obj|ply)\Z|\.scene_instance(\.json)?\Z")

# Floors by the starts of episodes.
_FLOOR_TOLERANCE = 0.5  # metres above or below a floor's height that still belong to it
_MIN_FLOOR_SHARE = 0.05  # of all starts on a floor; with fewer they are on stairs
_UNDER_FLOOR = 0.25  # metres that the centre of an object may lie below its floor
_STOREY_HEIGHT = 3.0  # metres that the centre of an object may lie above its floor
_ON_NO_FLOOR = "on no floor"
_MIN_SHARE_ON_MAP = 0.8  # of the starts; with fewer the map is of another scene
_MIN_CONNECTED_SHARE = 0.5  # of the standable cells; with fewer too little of the floor is in the episodes

# Semantic floor maps.
_NUM_LAYERS = 1 + len(GIBSON_CATEGORIES)  # navigable floor, then the categories in this order
_MAX_SIDE_PIXELS = 2000  # 100 m
_PIXEL_CM = 5
_CELL_CM = 25
_FAR = 10**7  # centimetres of an origin, or pixels; a greater number is a mistake
_MIN_OBJECT_PIXELS = 3  # less is noise
_MIN_FREE_PIXELS = 8  # of the 25 pixels of a cell, for it to be standable; narrow doors have few

# A strip this wide (pixels) between floor on both sides, and this long (cells), is a wall. The floor of a map ends 0.1
# to 0.2 m before an obstacle, so the obstacle is at most 0.4 m thick, yet 1 m long, unlike usual furniture. The cells
# on both sides of a narrow strip may have enough free pixels to be standable, and would be neighbours.
_STRIP_WIDTHS = (4, 12)
_NARROW_STRIP_WIDTHS = (4, 6)
_MIN_STRIP_LENGTH = 4
_MIN_NARROW_ROWS = 3  # of the 5 of a cell that a narrow strip crosses; with fewer there is room for a door


class SceneEpisodes(NamedTuple):
    """The episodes of one scene in one file.

    Attributes:
      record: the whole file; its errors name file and scene.
      name: name of the scene, for example `Collierville`.
      mesh: name of the scene's file, for example `Collierville.glb`.
      episodes: one or more episodes.
    """

    record: JsonRecord
    name: str
    mesh: str
    episodes: list[JsonRecord]


class FloorMap(NamedTuple):
    """The map of one floor.

    Attributes:
      height: height of the floor in metres, Habitat's y.
      origin: Habitat's (x, z) of the low corner of pixel [0, 0], whole centimetres.
      layers: bool [16, nx, nz], the navigable floor and then `GIBSON_CATEGORIES`.
    """

    height: float
    origin: tuple[int, int]
    layers: np.ndarray


def read_habitat(path: Path, split: str, maps: Path | None = None) -> Iterator[Scene | InputError | ImportCount]:
    """Read a split of Habitat's ObjectNav.

    With `maps`, floor and objects come from the map (`build_scene_from_map`), and the episodes of a floor must start on
    it. Without, the standable cells are the lattice points nearest to the places in the episodes
    (`collect_standable_points`), and the objects are the goals, in typical sizes. Few files have enough such places.

    Args:
      path: the folder of a split, its `<split>.json.gz` next to `content/`, or one file of `content/`.
      split: `train`, `val` or `test`.
      maps: a semantic floor map `*_info.pbz2`; all of its scenes are read if there is no episode.

    Yields:
      For every floor of every scene the `Scene`, or why it cannot be used; also the accounts of episodes, goals and
      objects.

    Raises:
      InputError: `path` or `maps` cannot be read.
    """
    # The map, if there is one, is read once for all files.
    floor_maps = None if maps is None else read_floor_maps(maps)
    episode_files = list_episode_files(path)
    has_episodes = False
    for episode_file in episode_files:
        try:
            scene_episodes = read_episodes(episode_file)
        except InputError as error:
            # A damaged file leaves the other files of a folder.
            if episode_files == [path]:
                raise
            yield error
            has_episodes = True
            continue
        for scene in scene_episodes:
            has_episodes = True
            if floor_maps is None:
                yield from _floors_without_map(scene, split)
                continue

            # The maps have the objects, so the goals are not used.
            yield _count_unused_goals(scene)
            if scene.name in floor_maps:
                yield from _floors_with_map(scene.name, split, floor_maps[scene.name], scene.episodes)
            else:
                yield InputError(f"{scene.record.location}: has no map in {maps}; give the maps of this split")
                num_episodes = len(scene.episodes)
                yield ImportCount("episodes", num_episodes, skipped=Counter({IN_REFUSED_SCENE: num_episodes}))
        yield _count_other_goals(scene_episodes)

    # Without any episode, all scenes of the map are built.
    if has_episodes:
        return
    if floor_maps is None:
        raise InputError(f"{path}: holds no episode; give the folder of a split, or a semantic floor map (--maps)")
    for name, floor_records in floor_maps.items():
        yield from _floors_with_map(name, split, floor_records, [])


# Episode files


def list_episode_files(path: Path) -> list[Path]:
    """Return the episode files of a split.

    They are those of its `content` folder, or else the file itself or the files of the folder.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "content").is_dir():
        folder = folder / "content"
    elif folder != path:
        return [path]
    folder_files = [file for file in list_visible_files(folder) if file.name.endswith((".json.gz", ".json"))]

    # SemExp keeps `X_episodes.json.gz` next to Habitat's `X.json.gz` or `X.glb.json.gz`, which it does not use.
    scene_names = [_strip_mesh_ending(file.name.removesuffix(".gz").removesuffix(".json")) for file in folder_files]
    episode_files: list[Path] = []
    for file, scene_name in zip(folder_files, scene_names, strict=True):
        if f"{scene_name}_episodes" not in scene_names:
            episode_files.append(file)
    return episode_files


def _strip_mesh_ending(mesh: str) -> str:
    """Return the name of the scene in a file such as `house.1.glb`: `house.1`."""
    return _MESH_ENDING.sub("", mesh) or mesh


def read_episodes(file: Path) -> list[SceneEpisodes]:
    """Read the episodes of a file, scene by scene.

    Raises:
      InputError: the file cannot be read, or an episode has no scene.
    """
    file_content = parse_json(str(file), read_bytes(file))
    if not isinstance(file_content, dict):
        raise InputError(f"{file}: is not a JSON object with `episodes`; give an ObjectNav episode file")
    file_record = JsonRecord(str(file), file_content)
    scene_by_name: dict[str, SceneEpisodes] = {}
    for index, episode in enumerate(file_record.iterate_records("episodes", file_record.get("episodes"))):
        mesh = episode.get_text("scene_id").rsplit("/", 1)[-1]
        name = _strip_mesh_ending(mesh)
        location = f"{file}, scene {reprlib.repr(name)}"
        scene = scene_by_name.setdefault(name, SceneEpisodes(JsonRecord(location, file_content), name, mesh, []))
        scene.episodes.append(JsonRecord(f"{location}: episodes[{index}]", episode.fields))
    return list(scene_by_name.values())


def read_position(record: JsonRecord, field: str = "position") -> list[float]:
    """Read a position (x, y, z), metres, with z negated."""
    x, y, z = record.check_numbers(field, record.get_list(field, 3))
    return [x, y, 0.0 - z]


def list_goals(scene: SceneEpisodes) -> list[JsonRecord]:
    """Return the goals of the scene's categories, or else those of its episodes, as often as they are listed."""
    # Lists of goals: the record that holds the list, its field and the goals.
    goal_lists: list[tuple[JsonRecord, str, Any]] = []
    goals_by_category = scene.record.fields.get("goals_by_category")
    if goals_by_category is None:
        for episode in scene.episodes:
            goal_lists.append((episode, "goals", episode.fields.get("goals") or []))
    else:
        category_record = scene.record.check_record("goals_by_category", goals_by_category)
        for list_field, goals in category_record.fields.items():
            if list_field.startswith(f"{scene.mesh}_"):
                goal_lists.append((category_record, list_field, goals))

    listed_goals: list[JsonRecord] = []
    for record, list_field, goals in goal_lists:
        listed_goals.extend(record.iterate_records(list_field, goals))
    return listed_goals


def distinct_goals(listed_goals: Sequence[JsonRecord], goal_count: ImportCount) -> list[JsonRecord]:
    """Return the goal objects, each once.

    An object is listed again where id, category and place are equal; ids alone need not be unique.
    """
    goal_by_identity: dict[Any, JsonRecord] = {}
    for goal in listed_goals:
        object_id = goal.fields.get("object_id")
        known_id = object_id if isinstance(object_id, int | str) else None
        goal_identity = (known_id, goal.get_text("object_category"), *read_position(goal))
        if goal_identity in goal_by_identity:
            goal_count.skipped["listed again"] += 1
        else:
            goal_by_identity[goal_identity] = goal
    goal_count.num_kept = len(goal_by_identity)
    return list(goal_by_identity.values())


def _count_unused_goals(scene: SceneEpisodes) -> ImportCount:
    """Count the goals of a scene whose objects come from a map."""
    try:
        num_goals = len(list_goals(scene))
    except InputError:
        num_goals = 0
    return ImportCount("goals", num_goals, skipped=Counter({"replaced by the objects of the maps": num_goals}))


def _count_other_goals(scenes: Sequence[SceneEpisodes]) -> ImportCount:
    """Count the goals of a file that belong to none of its scenes with episodes."""
    num_goals = 0
    goals_by_category = scenes[0].record.fields.get("goals_by_category") if scenes else None
    if isinstance(goals_by_category, dict):
        scene_prefixes = tuple(f"{scene.mesh}_" for scene in scenes)
        for list_field, goals in goals_by_category.items():
            if not list_field.startswith(scene_prefixes):
                num_goals += count_items(goals)
    return ImportCount("goals", num_goals, skipped=Counter({"of scenes without an episode": num_goals}))


def collect_standable_points(scene: SceneEpisodes, goals: list[JsonRecord]) -> np.ndarray:
    """Return the standable places in the episodes: starts, view points and points of shortest paths.

    Returns:
      float64 [N, 3], (x, y, z), metres, the starts first.
    """
    standable_points = [read_position(episode, "start_position") for episode in scene.episodes]
    for goal in goals:
        for view_point in goal.iterate_records("view_points", goal.fields.get("view_points") or []):
            standable_points.append(read_position(view_point.get_record("agent_state")))
    for episode in scene.episodes:
        standable_points.extend(_iterate_path_points(episode))
    return np.array(standable_points)


def _iterate_path_points(episode: JsonRecord) -> Iterator[list[float]]:
    for path_index, path_points in enumerate(episode.get_list_or_empty("shortest_paths")):
        field = f"shortest_paths[{path_index}]"
        for point_index, path_point in enumerate(episode.check_list(field, path_points)):
            if isinstance(path_point, dict) and path_point.get("position") is not None:  # else it is an action alone
                yield read_position(episode.check_record(f"{field}[{point_index}]", path_point))


# Floors by episodes alone


def _floors_without_map(scene: SceneEpisodes, split: str) -> Iterator[Scene | InputError | ImportCount]:
    """Build the floors of a scene from its episodes."""
    episode_count = ImportCount("episodes", len(scene.episodes))
    goal_count = ImportCount("goals")
    try:
        listed_goals = list_goals(scene)
        goal_count.num_read = len(listed_goals)
        goals = distinct_goals(listed_goals, goal_count)
        standable_points = collect_standable_points(scene, goals)
        goal_centres = np.array([read_position(goal) for goal in goals]).reshape(-1, 3)
        goal_types = [goal.get_text("object_category") for goal in goals]
    except InputError as error:
        yield error
        for import_count in (episode_count, goal_count):
            import_count.skip_all(IN_REFUSED_SCENE)
            yield import_count
        return

    # An object belongs to the highest floor below it.
    floor_heights = _find_floor_heights(standable_points[: len(scene.episodes), 1])
    floor_numbers = np.searchsorted(floor_heights, goal_centres[:, 1] + _UNDER_FLOOR, side="right") - 1

    # Which objects and starts are on an imported floor, and which on a refused one.
    object_count = ImportCount("objects", len(goals))
    num_placed = 0
    has_used_start = np.zeros(len(scene.episodes), bool)
    has_refused_start = np.zeros(len(scene.episodes), bool)

    for floor_index, floor_height in enumerate(floor_heights):
        floor_record = JsonRecord(f"{scene.record.location}: floor {floor_index}", {})
        floor_objects: list[SceneObject] = []
        for object_type, (x, y, z), floor_number in zip(goal_types, goal_centres.tolist(), floor_numbers, strict=True):
            if floor_number == floor_index and y - floor_height <= _STOREY_HEIGHT:
                floor_objects.append(SceneObject(object_type, (x, y - floor_height, z, *typical_box(object_type)[:3])))
        on_floor = np.abs(standable_points[:, 1] - floor_height) <= _FLOOR_TOLERANCE
        result = scene_or_error(
            _build_scene_from_points,
            floor_record,
            f"{scene.name}_floor{floor_index}",
            split,
            standable_points[on_floor][:, ::2],
            floor_objects,
        )
        yield result

        starts_on_floor = on_floor[: len(scene.episodes)]
        num_placed += len(floor_objects)
        if isinstance(result, InputError):
            object_count.skipped[IN_REFUSED_SCENE] += len(floor_objects)
            has_refused_start |= starts_on_floor
        else:
            has_used_start |= starts_on_floor

    object_count.skipped[_ON_NO_FLOOR] = len(goals) - num_placed
    episode_count.num_kept = int(has_used_start.sum())
    episode_count.skipped[IN_REFUSED_SCENE] = int((has_refused_start & ~has_used_start).sum())
    episode_count.skipped[_ON_NO_FLOOR] = int((~has_refused_start & ~has_used_start).sum())
    yield from (episode_count, goal_count, object_count)


def _find_floor_heights(start_heights: np.ndarray) -> list[float]:
    """Return the heights of floors by the heights [N] of starts, ascending."""
    floor_heights: list[float] = []
    remaining_heights = np.sort(start_heights)
    while len(remaining_heights):
        # The floor with most of the remaining starts.
        range_ends = np.searchsorted(remaining_heights, remaining_heights + 2 * _FLOOR_TOLERANCE, side="right")
        first_index = int(np.argmax(range_ends - np.arange(len(remaining_heights))))
        on_floor = slice(first_index, range_ends[first_index])
        if len(remaining_heights[on_floor]) < _MIN_FLOOR_SHARE * len(start_heights):
            break
        floor_heights.append(float(np.median(remaining_heights[on_floor])))
        remaining_heights = np.delete(remaining_heights, on_floor)
    return sorted(floor_heights)


def _build_scene_from_points(
    record: JsonRecord, name: str, split: str, points: np.ndarray, objects: Sequence[SceneObject]
) -> Scene:
    """Build a scene from standable points [N, 2], (x, z); the lattice points nearest to them are standable."""
    if not objects:
        raise record.error("goals", "has no object on this floor; give a semantic floor map (--maps)")
    nearest_points = (CELL_SIZE * np.rint(points / CELL_SIZE)).tolist()
    floor_cells = np.unique(lattice_cells(record, "start_position", nearest_points), axis=0)
    scene = build_scene_from_cells(name, "habitat", "house", split, floor_cells, objects)

    num_connected = len(standable_cells(scene.reach))
    if num_connected < _MIN_CONNECTED_SHARE * len(floor_cells):
        problem = f"and view points are {len(floor_cells)} cells, of which only {num_connected} are connected"
        raise record.error("start_position", f"{problem}; give a semantic floor map (--maps)")
    return scene


# Floors by semantic maps


def read_floor_maps(path: Path) -> dict[str, dict[int, JsonRecord]]:
    """Read the floors of every scene by their numbers.

    `parse_floor_map` checks each of them.

    Raises:
      InputError: the file cannot be read (`read_pickle`) or holds something else.
    """
    # Check both levels of names and numbers here; the fields of a floor are checked when it is used.
    map_by_name = read_pickle(path)
    if (
        not isinstance(map_by_name, dict)
        or not map_by_name
        or not all(isinstance(name, str) and name for name in map_by_name)
    ):
        raise InputError(f"{path}: contains no maps by scene name; give a file such as val_info.pbz2")
    floor_maps: dict[str, dict[int, JsonRecord]] = {}
    for name, floor_by_number in map_by_name.items():
        location = f"{path}, scene {reprlib.repr(name)}"
        if (
            not isinstance(floor_by_number, dict)
            or not floor_by_number
            or not all(map(_is_floor_number, floor_by_number))
        ):
            raise InputError(f"{location}: has no floors with the numbers 0, 1, ...; give a file such as val_info.pbz2")
        floor_maps[name] = {}
        for floor_number, floor_content in floor_by_number.items():
            floor_fields = floor_content if isinstance(floor_content, dict) else {}
            floor_maps[name][floor_number] = JsonRecord(f"{location}: floor {floor_number}", floor_fields)
    return floor_maps


def _is_floor_number(number: Any) -> bool:
    return type(number) is int and 0 <= number < 1000


def parse_floor_map(record: JsonRecord) -> FloorMap:
    """Check the map of a floor.

    Raises:
      InputError: a field is missing or wrong.
    """
    # The pickle may hold anything, so each of the three fields is checked in type, shape and range.
    height = record.get("floor_height")
    origin = record.get("origin")
    layers = record.get("sem_map")
    if type(height) not in (int, float) or not abs(height) < _FAR:
        raise record.error("floor_height", "is not a finite number; give metres")

    low_corner = origin.values.astype(float) if isinstance(origin, PickledArray) else np.zeros(0)
    if low_corner.shape != (2,) or not (np.abs(low_corner) < _FAR).all():
        raise record.error("origin", "is not an array of two finite numbers; give (z, x) in centimetres")

    layers_shape = layers.values.shape if isinstance(layers, PickledArray) else ()
    if (
        len(layers_shape) != 3
        or layers_shape[0] != _NUM_LAYERS
        or not 0 < min(layers_shape) <= max(layers_shape) <= _MAX_SIDE_PIXELS
    ):
        expected = f"[{_NUM_LAYERS}, H, W] with sides up to {_MAX_SIDE_PIXELS}"
        raise record.error("sem_map", f"is not an array {expected}; give the floor and {_NUM_LAYERS - 1} categories")
    if not ((layers.values == 0) | (layers.values == 1)).all():
        raise record.error("sem_map", "contains values other than 0 and 1; give layers of 0 and 1")

    # The file orders the axes as z, x.
    z_cm, x_cm = np.rint(low_corner).astype(int).tolist()
    return FloorMap(float(height), (x_cm, z_cm), layers.values == 1)


def build_scene_from_map(
    record: JsonRecord, name: str, split: str, floor: FloorMap, object_count: ImportCount | None = None
) -> Scene:
    """Build the scene of one floor.

    Its x is Habitat's, its z is minus Habitat's. A cell is standable if at least 8 of its 25 pixels are navigable: the
    agent's radius is clear of obstacles there already. An object is a connected part of a category's layer, at the
    typical height. Walls are the cells far from everything (`derive_walls`) and thin strips that divide the floor.

    Raises:
      InputError: the floor has no standable cell or no object.
    """
    # Standable cells, without those in narrow strips that divide the floor.
    free_cells = _count_pixels_per_cell(floor, floor.layers[0]) >= _MIN_FREE_PIXELS
    narrow_walls = _keep_long_parts(_find_strips(floor, _NARROW_STRIP_WIDTHS, _MIN_NARROW_ROWS))
    reach_mask = free_cells & ~narrow_walls
    lattice_indices = _to_lattice_cells(floor, reach_mask)
    map_objects = list(_iterate_map_objects(floor, object_count or ImportCount("objects")))
    if not len(lattice_indices):
        raise record.error("sem_map", f"has no cell with {_MIN_FREE_PIXELS} pixels of layer 0; leave the floor out")
    if not map_objects:
        raise record.error("sem_map", "has no object in layers 1 and up; leave the floor out")
    scene = build_scene_from_cells(name, "gibson", "house", split, lattice_indices, map_objects)

    # Add the thin walls that are within the scene's array.
    thin_walls = _keep_long_parts(_find_strips(floor, _STRIP_WIDTHS, 1) & ~reach_mask)
    first_cell = np.rint(np.divide(scene.origin[::-1], _CELL_CM / 100)).astype(int)
    wall_cells = _to_lattice_cells(floor, thin_walls) - first_cell
    in_scene = ((wall_cells >= 0) & (wall_cells < scene.walls.shape)).all(axis=1)
    wall_mask = scene.walls.copy()
    wall_mask[tuple(wall_cells[in_scene].T)] = True
    return dataclasses.replace(scene, walls=wall_mask)


def _floors_with_map(
    name: str, split: str, records: dict[int, JsonRecord], episodes: Sequence[JsonRecord]
) -> Iterator[Scene | InputError | ImportCount]:
    """Build the floors of a scene from their maps, and check them against the episodes."""
    # All maps first: the heights of the floors decide on which of them an episode starts.
    floor_maps: dict[int, FloorMap] = {}
    for floor_number, floor_record in records.items():
        try:
            floor_maps[floor_number] = parse_floor_map(floor_record)
        except InputError as error:
            yield error

    episode_count = ImportCount("episodes", len(episodes))
    for floor_number, floor_map in floor_maps.items():
        floor_name = f"{name}_floor{floor_number}"
        object_count = ImportCount("objects")
        num_starts = 0
        try:
            floor_starts = _starts_on_floor(floor_number, floor_maps, episodes)
            num_starts = len(floor_starts)
            scene = build_scene_from_map(records[floor_number], floor_name, split, floor_map, object_count)
            _check_starts(records[floor_number], scene, floor_starts)
        except InputError as error:
            object_count.skip_all(IN_REFUSED_SCENE)
            episode_count.skipped[IN_REFUSED_SCENE] += num_starts
            yield error
        else:
            episode_count.num_kept += num_starts
            yield scene
        yield object_count

    # Each other episode is on a floor without a map, or has no readable start.
    num_counted = episode_count.num_kept + episode_count.skipped.total()
    episode_count.skipped[_ON_NO_FLOOR] = episode_count.num_read - num_counted
    yield episode_count


def _starts_on_floor(number: int, floors: dict[int, FloorMap], episodes: Sequence[JsonRecord]) -> np.ndarray:
    """Return the starts on a floor.

    The floor of an episode is its `floor_id`, or else the nearest.

    Returns:
      float64 [N, 2], (x, z), metres.
    """
    floor_numbers = list(floors)
    floor_heights = np.array([floor.height for floor in floors.values()])

    start_positions: list[tuple[float, float]] = []
    for episode in episodes:
        x, y, z = read_position(episode, "start_position")
        nearest_number = floor_numbers[int(np.abs(floor_heights - y).argmin())]
        if episode.fields.get("floor_id", nearest_number) == number:
            start_positions.append((x, z))
    return np.array(start_positions, np.float64).reshape(-1, 2)


def _check_starts(record: JsonRecord, scene: Scene, starts: np.ndarray) -> None:
    """Refuse a map that does not fit its episodes.

    A start must lie on a standable cell or next to one.
    """
    near_cells: set[tuple[int, int]] = set()
    for iz, ix in np.argwhere(scene.reach).tolist():
        for offset_z, offset_x in itertools.product((-1, 0, 1), repeat=2):
            near_cells.add((iz + offset_z, ix + offset_x))

    start_cells = np.rint((starts - scene.origin) / CELL_SIZE).astype(int)  # [N, 2], (ix, iz)
    num_on_map = 0
    for ix, iz in start_cells.tolist():
        num_on_map += (iz, ix) in near_cells
    if num_on_map < _MIN_SHARE_ON_MAP * len(starts):
        problem = f"has {num_on_map} of {len(starts)} starts of its episodes on navigable floor"
        raise record.error("sem_map", f"{problem}; give map and episodes of the same scenes")


# Pixels, cells and strips of a map


def _lattice_indices(low: int, num_pixels: int) -> np.ndarray:
    """Return the lattice index nearest to each pixel along an axis that begins at `low` centimetres."""
    return (2 * (low + _PIXEL_CM * np.arange(num_pixels)) + _PIXEL_CM + _CELL_CM) // (2 * _CELL_CM)


def _count_pixels_per_cell(floor: FloorMap, mask: np.ndarray) -> np.ndarray:
    """Count the pixels of a mask [nx, nz] in each cell.

    Returns:
      int [cells along x, cells along Habitat's z]; a whole cell has 25 pixels.
    """
    x_indices = _lattice_indices(floor.origin[0], mask.shape[0])
    z_indices = _lattice_indices(floor.origin[1], mask.shape[1])
    pixel_counts = np.zeros((np.ptp(x_indices) + 1, np.ptp(z_indices) + 1), np.int64)
    np.add.at(pixel_counts, np.ix_(x_indices - x_indices[0], z_indices - z_indices[0]), mask)
    return pixel_counts


def _to_lattice_cells(floor: FloorMap, mask: np.ndarray) -> np.ndarray:
    """Return the lattice indices (iz, ix), int [N, 2], of a mask [cells along x, cells along Habitat's z].

    The first cell of the mask is that of the first pixel.
    """
    first_cell = [_lattice_indices(low, 1)[0] for low in floor.origin]
    x, z = (np.argwhere(mask) + first_cell).T
    return np.stack([-z, x], axis=1)


def _iterate_map_objects(floor: FloorMap, object_count: ImportCount) -> Iterator[SceneObject]:
    # Pixels are 5 cm wide, and the box of an object ends with its last pixel.
    for category, layer in zip(GIBSON_CATEGORIES, floor.layers[1:], strict=True):
        _, height, _, y = typical_box(category)
        for part_pixels in connected_parts(layer):
            object_count.num_read += 1
            if len(part_pixels) < _MIN_OBJECT_PIXELS:
                object_count.skipped[f"smaller than {_MIN_OBJECT_PIXELS} pixels"] += 1
            else:
                low_pixel = part_pixels.min(axis=0)
                high_pixel = part_pixels.max(axis=0) + 1
                x, z = ((floor.origin + _PIXEL_CM * (low_pixel + high_pixel) / 2) / 100).tolist()
                size_x, size_z = (_PIXEL_CM * (high_pixel - low_pixel) / 100).tolist()
                yield SceneObject(category, (x, y, 0.0 - z, size_x, height, size_z))


def _find_strips(floor: FloorMap, widths: tuple[int, int], min_rows: int) -> np.ndarray:
    """Return the cells in the middle of thin strips between floor.

    Args:
      floor: the map.
      widths: least and greatest, pixels.
      min_rows: least number of rows of pixels of a cell that a strip crosses.

    Returns:
      bool [cells along x, cells along Habitat's z].
    """
    free_pixels = floor.layers[0]
    object_pixels = floor.layers[1:].any(axis=0)
    middles_along_z = _strip_middles(free_pixels, widths) & ~object_pixels
    middles_along_x = _strip_middles(free_pixels.T, widths).T & ~object_pixels
    strips_along_z = _count_pixels_per_cell(floor, middles_along_z) >= min_rows
    strips_along_x = _count_pixels_per_cell(floor, middles_along_x) >= min_rows
    return strips_along_z | strips_along_x


def _strip_middles(free: np.ndarray, widths: tuple[int, int]) -> np.ndarray:
    """Return the pixels in the middle of a thin gap.

    The gap lies between free pixels of their row, and has one such pixel. bool, of the shape of `free` [H, W].
    """
    # The nearest free pixels on both sides.
    column_index = np.arange(free.shape[1])
    free_before = np.maximum.accumulate(np.where(free, column_index, -_FAR), axis=1)
    free_after = np.minimum.accumulate(np.where(free, column_index, _FAR)[:, ::-1], axis=1)[:, ::-1]

    gap_width = free_after - free_before - 1
    is_thin = (gap_width >= widths[0]) & (gap_width <= widths[1])
    return is_thin & (column_index == (free_before + free_after) // 2)


def _keep_long_parts(strips: np.ndarray) -> np.ndarray:
    """Return the connected parts of strips that are long enough for a wall."""
    wall_mask = np.zeros_like(strips)
    for part_cells in connected_parts(strips):
        wall_mask[tuple(part_cells.T)] = len(part_cells) >= _MIN_STRIP_LENGTH
    return wall_mask
