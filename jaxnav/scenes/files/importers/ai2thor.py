"""Importers of AI2-THOR scenes: metadata of the simulator, offline folders, and rooms with moved objects.

* `read_ai2thor` reads saved metadata: `event.metadata` after the action GetReachablePositions as JSON, either the
  metadata object itself or {"metadata": ..., "reachablePositions": [...]} where the positions were saved separately.
* `read_controller` takes the same metadata from an installed simulator.
* `read_scene_data` reads the offline folders `Scene_Data` that SAVN, ORG, VTNet, HOZ and the paper's released code
  share. A scene is a folder with `grid.json` (or `graph.json`) and `visible_object_map_1.5.json` (or
  `visible_object_map.json`).
* `read_replacements` reads new places of the movable objects of known rooms, which a simulator found. A record is one
  room: {"name": ..., "columns": ["type", "x", "y", "z"], "sets": [[["Book", 0.217, 1.099, -0.001], ...], ...]}. A set
  has one place of each movable object; x, y, z in metres is an object's pivot, not the centre of its box.
"""

import dataclasses
import importlib
import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount
from jaxnav.scenes.files.importers.assemble import (
    SceneObject,
    build_scene_from_cells,
    check_lattice_spacing,
    lattice_cells,
    read_bounding_box,
    scene_and_count,
)
from jaxnav.scenes.files.scene_file import (
    JsonRecord,
    count_items,
    list_visible_files,
    numbered_lines,
    parse_json,
    read_bytes,
    read_json_texts,
    read_scenes,
    scene_lines,
)
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.scene import CELL_SIZE, Scene

#: Height of the agent's position above the floor, metres.
AGENT_HEIGHT = 0.9
#: Types that are the shell of a room. Doorways and windows are objects.
STRUCTURE_TYPES = frozenset({"Floor", "Wall", "Ceiling", "Room"})
_IS_STRUCTURE = "floors, walls and ceilings"

_ITHOR_ROOMS = {0: "kitchen", 2: "living_room", 3: "bedroom", 4: "bathroom"}  # by the hundreds of the scene number

# Files of saved metadata.
_METADATA_ENDINGS = (".json", ".json.gz", ".jsonl", ".jsonl.gz")

# Files of an offline folder, and the ids in them.
_GRID_FILE = "grid.json"
_GRAPH_FILE = "graph.json"
_MAP_FILES = ("visible_object_map_1.5.json", "visible_object_map.json")
_NUMBER = r"([-+]?[0-9]+\.[0-9]+)"
_STATE_ID = re.compile(rf"{_NUMBER}\|{_NUMBER}\|[0-9]+\|-?[0-9]+")  # x|z|rotation|horizon
_OBJECT_ID = re.compile(rf"([A-Za-z0-9]+)\|{_NUMBER}\|{_NUMBER}\|{_NUMBER}(?:\|([A-Za-z0-9]+))?")  # Type|x|y|z|PartType

# Re-placements.
_REPLACEMENT_COLUMNS = ["type", "x", "y", "z"]
_PIVOT_ID = re.compile(rf"[^|]+\|{_NUMBER}\|{_NUMBER}\|{_NUMBER}.*")  # Type|x|y|z of the pivot
_PIVOT_ROUNDING = 0.01  # metres; ids have two decimals


# Names of scenes


def strip_physics_suffix(name: str) -> str:
    """Remove the suffix `_physics` that some releases add to the name of a scene."""
    return re.sub(r"(?<=.)_physics\Z", "", name)


def world_and_room_type(name: str) -> tuple[str, str]:
    """Return world and room type by a scene's name."""
    # The hundreds of a room's number give its type, and every type has 30 rooms.
    name_match = re.fullmatch(r"FloorPlan([0-9]{1,3})", name)
    if name_match:
        hundreds, room_number = divmod(int(name_match[1]), 100)
        if hundreds in _ITHOR_ROOMS and 1 <= room_number <= 30:
            return "ithor", _ITHOR_ROOMS[hundreds]
    if name.startswith("FloorPlan_"):
        return "robothor", "apartment"
    return ("procthor", "house") if name == "Procedural" else ("ai2thor", "other")


# Saved metadata


def read_ai2thor(path: Path, split: str) -> Iterator[Scene | InputError | ImportCount]:
    """Read saved metadata of the controller.

    Object types keep the names of the file. Boxes come from `axisAlignedBoundingBox` or the older `bounds3D`; an object
    without one, or of size 0, gets a typical size. Walls are derived: the metadata has none.

    Args:
      path: a file with one record (`.json`), with one per line (`.jsonl`), either also as `.gz`, or a folder of them.
      split: split of the scenes.

    Yields:
      A scene per record, or why it cannot be used; for a folder also why a file cannot be read.

    Raises:
      InputError: the file cannot be read, or there is no record at all.
    """
    metadata_files = [path]
    if path.is_dir():
        metadata_files = [file for file in list_visible_files(path) if file.name.endswith(_METADATA_ENDINGS)]
        if not metadata_files:
            raise InputError(f"{path}: holds no file {', '.join(_METADATA_ENDINGS)}; give the folder of the metadata")
    for metadata_file in metadata_files:
        try:
            record_texts = read_json_texts(metadata_file)
            if not record_texts:
                raise InputError(f"{metadata_file}: holds no record; write one JSON object per line")
        except InputError as error:
            if metadata_file == path:
                raise
            yield error
            continue
        for location, record_text in record_texts:
            yield from scene_and_count(_build_scene_from_text, location, record_text, split)


def _build_scene_from_text(location: str, record_text: bytes, split: str, object_count: ImportCount) -> Scene:
    return build_scene_from_metadata(location, parse_json(location, record_text), split, object_count)


def build_scene_from_metadata(location: str, value: Any, split: str, object_count: ImportCount) -> Scene:
    """Build the scene of one record.

    Args:
      location: name of the record in errors.
      value: the record, see the module.
      split: split of the scene.
      object_count: counts the objects that are read and skipped.

    Raises:
      InputError: the record cannot be used; names the scene, the field and how to fix it.
    """
    # The members of `metadata`, if there is such an object, and those beside it.
    outer_record = JsonRecord(location, {}).check_record("record", value)
    metadata = (
        outer_record.check_record("metadata", outer_record.fields.get("metadata", outer_record.fields)).fields
        | outer_record.fields
    )
    object_count.num_read = count_items(metadata.get("objects"))
    record = JsonRecord(f"{location}, scene {reprlib.repr(metadata.get('sceneName', '(no name)'))}", metadata)
    name = strip_physics_suffix(record.get_text("sceneName"))

    # Releases 1-2 have the positions at the top level, later ones as the result of the action, some of them in both.
    positions_field = "reachablePositions" if metadata.get("reachablePositions") else "actionReturn"
    if not metadata.get(positions_field):
        raise record.error("actionReturn", "has no positions; save event.metadata right after GetReachablePositions")
    positions = record.get_list(positions_field)
    standable_cells, floor_height = parse_agent_positions(record, positions_field, positions)

    scene_objects = _parse_objects(record, floor_height, object_count)
    return build_scene_from_cells(name, *world_and_room_type(name), split, standable_cells, scene_objects)


def parse_agent_positions(record: JsonRecord, field: str, positions: Sequence[Any]) -> tuple[np.ndarray, float]:
    """Return the standable cells and the height of the floor.

    Args:
      record: the scene's record.
      field: name of the field that holds the positions.
      positions: objects with x, y and z in metres: positions of the agent's body.

    Returns:
      Lattice indices (iz, ix), int [N, 2], and metres. The height comes from the agent because the box of `Floor`
      reaches far below the ground in many rooms.
    """
    # Positions of the body, [N, 3]; the floor is below them.
    position_records = record.iterate_records(field, positions)
    body_positions = np.array([position.get_numbers() for position in position_records]).reshape(-1, 3)
    cells = lattice_cells(record, field, body_positions[:, [0, 2]].tolist())
    check_lattice_spacing(record, field, cells)
    return cells, float(np.median(body_positions[:, 1])) - AGENT_HEIGHT


def _parse_objects(record: JsonRecord, floor_height: float, object_count: ImportCount) -> list[SceneObject]:
    """Read the objects without the shell of the room.

    The field `objects` is a list, or an object keyed by id.
    """
    # All entries must be objects; those of the shell are skipped.
    object_values = record.get("objects")
    if isinstance(object_values, dict):
        keyed_values = list(object_values.items())
    else:
        keyed_values = list(enumerate(record.check_list("objects", object_values)))
    object_rows: list[JsonRecord] = []
    for object_key, object_value in keyed_values:
        object_row = record.check_record(f"objects[{reprlib.repr(object_key)}]", object_value)
        if object_row.get_text("objectType") in STRUCTURE_TYPES:
            object_count.skipped[_IS_STRUCTURE] += 1
        else:
            object_rows.append(object_row)
    if not object_rows:
        raise record.error("objects", "holds no object except walls and floors; give at least one")

    # Receptacles are named by id, which several objects may share.
    indices_by_id: dict[str, list[int]] = {}
    for object_index, object_row in enumerate(object_rows):
        indices_by_id.setdefault(object_row.get_text("objectId"), []).append(object_index)
    object_boxes = [_parse_box(object_row, floor_height) for object_row in object_rows]

    # Parents are indices into the same rows.
    scene_objects: list[SceneObject] = []
    for object_index, object_row in enumerate(object_rows):
        (yaw,) = object_row.get_record("rotation").get_numbers("y")
        parent_index = _smallest_receptacle(object_row, object_index, indices_by_id, object_boxes)
        scene_objects.append(
            SceneObject(object_row.get_text("objectType"), object_boxes[object_index], yaw, parent_index)
        )
    return scene_objects


def _parse_box(object_row: JsonRecord, floor_height: float) -> list[float]:
    """Return centre and size of an object, metres, y above the floor."""
    box_centre = [0.0, 0.0, 0.0]
    box_size = [0.0, 0.0, 0.0]
    box_field = "axisAlignedBoundingBox"
    if object_row.fields.get(box_field) is not None:
        box_centre, box_size = read_bounding_box(object_row.get_record(box_field))
    elif object_row.fields.get("bounds3D") is not None:
        # Older releases give the low and the high corner.
        box_field = "bounds3D"
        corners = object_row.check_numbers(box_field, object_row.get_list(box_field, 6))
        low_corner, high_corner = np.reshape(corners, (2, 3))
        box_centre = ((low_corner + high_corner) / 2).tolist()
        box_size = (high_corner - low_corner).tolist()

    if min(box_size) < 0:
        raise object_row.error(box_field, f"has the size {box_size}; give sizes of at least 0")
    if max(box_size) == 0:  # the object has no renderer
        x, y, z = object_row.get_record("position").get_numbers()
        return box_at_pivot(object_row.get_text("objectType"), x, y - floor_height, z)
    return [box_centre[0], box_centre[1] - floor_height, box_centre[2], *box_size]


def _smallest_receptacle(
    object_row: JsonRecord,
    object_index: int,
    indices_by_id: Mapping[str, Sequence[int]],
    object_boxes: Sequence[Sequence[float]],
) -> int:
    """Return the index of the smallest receptacle of an object, or -1; a drawer is more specific than its desk.

    Args:
      object_row: the object.
      object_index: index of the object.
      indices_by_id: indices of the objects with each id.
      object_boxes: boxes of the objects, centre and full size.
    """
    receptacle_ids = object_row.fields.get("parentReceptacles")
    if receptacle_ids is None:
        return -1

    def centre_distance(receptacle_index: int) -> float:
        return float(np.linalg.norm(np.subtract(object_boxes[receptacle_index], object_boxes[object_index])[:3]))

    def box_volume(receptacle_index: int) -> float:
        return float(np.prod(object_boxes[receptacle_index][3:]))

    receptacle_indices: list[int] = []
    for receptacle_id in object_row.check_list("parentReceptacles", receptacle_ids):
        # Ids of the shell of the room and of objects outside the record are unknown; of equal ids the nearest counts.
        same_id_indices = indices_by_id.get(receptacle_id, ()) if isinstance(receptacle_id, str) else ()
        other_indices = [index for index in same_id_indices if index != object_index]
        if other_indices:
            receptacle_indices.append(min(other_indices, key=centre_distance))
    return min(receptacle_indices, key=box_volume, default=-1)


def box_at_pivot(object_type: str, x: float, y: float, z: float) -> list[float]:
    """Return a box of typical size around an object's pivot.

    The box is raised out of the floor, because pivots may be at the bottom of objects.

    Args:
      object_type: type of the object.
      x, y, z: the pivot, metres, y above the floor.

    Returns:
      Centre and full size, metres.
    """
    width, height, depth, _ = typical_box(object_type)
    return [x, max(y, height / 2), z, width, height, depth]


# An installed simulator


def read_controller(
    names: Sequence[str], split: str, controller_factory: Callable[..., Any] | None = None
) -> Iterator[Scene | InputError | ImportCount]:
    """Read the metadata of scenes from a simulator.

    Args:
      names: scenes such as `FloorPlan1` or `FloorPlan_Train1_1`.
      split: split of the scenes.
      controller_factory: makes the controller; None for `ai2thor.controller.Controller`.

    Yields:
      A scene per name, or why it cannot be used. Failures of the simulator itself are not caught.

    Raises:
      InputError: the package `ai2thor` is not installed.
    """
    controller_class = controller_factory or _import_controller_class()
    controller = controller_class(gridSize=CELL_SIZE, renderDepthImage=False)
    try:
        for name in names:
            yield from scene_and_count(_build_scene_in_simulator, controller, name, split)
    finally:
        controller.stop()


def _import_controller_class() -> Callable[..., Any]:
    try:
        return importlib.import_module("ai2thor.controller").Controller
    except ImportError as error:
        raise InputError(f"--from-controller: {error}; install the simulator with `pip install ai2thor`") from error


def _build_scene_in_simulator(controller: Any, name: str, split: str, object_count: ImportCount) -> Scene:
    location = f"controller, {name!r}"
    # The apartments are made for another robot than the rooms; the controller warns of a wrong one.
    robot = "locobot" if world_and_room_type(name)[0] == "robothor" else "default"
    try:
        controller.reset(scene=name, agentMode=robot)
        metadata = controller.step(action="GetReachablePositions").metadata
    except ValueError as error:  # there is no such scene; the lines after the first list those that there are
        problem = str(error).strip().partition("\n")[0]
        raise InputError(f"{location}: {problem} Give the name of a scene of the simulator") from error
    if not metadata["lastActionSuccess"]:
        problem = f"GetReachablePositions failed ({metadata['errorMessage']})"
        raise InputError(f"{location}: {problem}; leave the scene out")
    return build_scene_from_metadata(location, metadata, split, object_count)


# Offline folders


def read_scene_data(path: Path, split: str) -> Iterator[Scene | InputError | ImportCount]:
    """Read an offline folder.

    Cells come from `grid.json`, or else from the nodes of `graph.json`; objects from the ids in the visibility map,
    except those that are visible from nowhere. The files have no sizes, so objects get typical ones. Other files are
    not opened.

    Args:
      path: the folder `Scene_Data`, or that of one scene.
      split: split of the scenes.

    Yields:
      A scene per folder in the order of the names, or why it cannot be used.

    Raises:
      InputError: `path` is no folder, or no folder of scenes.
    """
    if not path.is_dir():
        raise InputError(f"{path}: is not a folder; give Scene_Data or the folder of one scene")
    scene_folders = [path]
    if not _is_scene_folder(path):
        scene_folders = [folder for folder in list_visible_files(path) if _is_scene_folder(folder)]
    if not scene_folders:
        raise InputError(
            f"{path}: holds no scene; give a folder with subfolders that have {_GRID_FILE} and {_MAP_FILES[0]}"
        )
    for scene_folder in scene_folders:
        yield from scene_and_count(_build_scene_of_folder, scene_folder, split)


def _is_scene_folder(folder: Path) -> bool:
    return any((folder / file_name).is_file() for file_name in (_GRID_FILE, _GRAPH_FILE, *_MAP_FILES))


def _build_scene_of_folder(folder: Path, split: str, object_count: ImportCount) -> Scene:
    name = strip_physics_suffix(folder.resolve().name)
    standable_cells, floor_height = _read_standable_cells(folder, name)
    visible_objects = _read_visible_objects(folder, name, floor_height, object_count)
    return build_scene_from_cells(name, *world_and_room_type(name), split, standable_cells, visible_objects)


def _load_file(file: Path, name: str) -> tuple[JsonRecord, Any]:
    """Return a record that names a file in errors, and the content of the file."""
    location = f"{file}, scene {name!r}"
    return JsonRecord(location, {}), parse_json(location, read_bytes(file))


def _read_standable_cells(folder: Path, name: str) -> tuple[np.ndarray, float]:
    """Read standable lattice indices and the height of the floor.

    Returns:
      int [N, 2], (iz, ix), and metres.
    """
    grid_file = folder / _GRID_FILE
    graph_file = folder / _GRAPH_FILE
    node_cells = _parse_graph(*_load_file(graph_file, name)) if graph_file.is_file() else None
    if node_cells is not None and not grid_file.is_file():
        return node_cells, 0.0

    record, grid_positions = _load_file(grid_file, name)
    grid_cells, floor_height = parse_agent_positions(record, "grid", record.check_list("grid", grid_positions))

    # The grid must hold all nodes of the graph; the files of some releases do not fit each other.
    if node_cells is not None:
        missing_cells = set(map(tuple, node_cells.tolist())) - set(map(tuple, grid_cells.tolist()))
        if missing_cells:
            iz, ix = min(missing_cells)
            problem = f"lacks x {CELL_SIZE * ix}, z {CELL_SIZE * iz}, a node of {_GRAPH_FILE}"
            raise record.error("grid", f"{problem}; take both files from one release")
    return grid_cells, floor_height


def _parse_graph(record: JsonRecord, value: Any) -> np.ndarray:
    """Read the lattice indices (iz, ix) of the nodes of a networkx node-link graph; its edges are not needed."""
    graph = record.check_record("graph", value)
    node_points: list[list[float]] = []
    for graph_node in graph.iterate_records("nodes", graph.get("nodes")):
        state_id = graph_node.get_text("id")
        id_match = _STATE_ID.fullmatch(state_id)
        if id_match is None:
            problem = f"is {reprlib.repr(state_id)}; give x|z|rotation|horizon, such as 0.25|-1.50|90|0"
            raise graph_node.error("id", problem)
        node_points.append(graph_node.check_numbers("id", map(float, id_match.groups())))
    node_cells = lattice_cells(graph, "nodes", node_points)
    check_lattice_spacing(graph, "nodes", node_cells)
    return node_cells


def _read_visible_objects(folder: Path, name: str, floor_height: float, object_count: ImportCount) -> list[SceneObject]:
    """Read the objects that are visible from somewhere, from their ids."""
    map_file = folder / _MAP_FILES[0]
    older_file = folder / _MAP_FILES[1]
    if older_file.is_file() and not map_file.is_file():
        map_file = older_file
    record, value = _load_file(map_file, name)

    # The map lists the states from which each object is visible, by the object's id.
    states_by_id = record.check_record("map", value).fields
    object_count.num_read = len(states_by_id)
    visible_objects: list[SceneObject] = []
    for object_id, visible_states in states_by_id.items():
        id_label = reprlib.repr(object_id)
        if not record.check_list(id_label, visible_states):
            object_count.skipped["visible from nowhere"] += 1
            continue
        id_match = _OBJECT_ID.fullmatch(object_id)
        if id_match is None:
            raise record.error(id_label, "is not an id; give Type|x|y|z or remove the object")
        # Parts such as the basin of a sink have a type of their own.
        object_type = id_match[5] or id_match[1]
        if object_type in STRUCTURE_TYPES:
            object_count.skipped[_IS_STRUCTURE] += 1
        else:
            x, y, z = record.check_numbers(id_label, map(float, id_match.group(2, 3, 4)))
            visible_objects.append(SceneObject(object_type, box_at_pivot(object_type, x, y - floor_height, z)))
    if not visible_objects:
        raise record.error("map", "names no object that is visible from somewhere; give at least one")
    return visible_objects


# Re-placements


def read_replacements(path: Path, base: Path) -> Iterator[Scene | InputError | ImportCount]:
    """Read one scene for every set of every room.

    Scenes are in the order of the file and named `<room>-replaced-<number of the set>`. The rows of a type go to the
    objects of this type in the order of the base scene; those that are left over stay where they are. Sizes, yaws,
    cells and walls are those of the base scene. The pivot is the middle of the underside, unless the object's `id` in
    the base file shows that it is higher up in the box. Moved objects, and those that rested on them, rest on nothing.

    Args:
      path: the re-placements, one JSON object per line, plain or gzip.
      base: scene file of the original rooms.

    Yields:
      A scene, or why a room or one of its sets cannot be used.

    Raises:
      InputError: one of the files cannot be read, or `path` is empty.
    """
    base_rooms = _read_base_rooms(base)
    room_lines = numbered_lines(read_bytes(path))
    if not room_lines:
        raise InputError(f"{path}: holds no room; write one JSON object per line")
    for line_number, line_bytes in room_lines:
        # Check the room once, for all of its sets.
        try:
            line_record = JsonRecord(f"{path}, line {line_number}", {})
            record = line_record.check_record("record", parse_json(line_record.location, line_bytes))
            name = record.get_text("name")
            if name not in base_rooms:
                raise record.error("name", f"is {reprlib.repr(name)}, which is not in {base}; give its scene file")
            if record.get("columns") != _REPLACEMENT_COLUMNS:
                problem = f"is {reprlib.repr(record.get('columns'))}; give {_REPLACEMENT_COLUMNS}"
                raise record.error("columns", problem)
            num_sets = len(record.get_list("sets"))
        except InputError as error:
            yield error
            continue
        for set_index in range(num_sets):
            # A row moves an object of the room; all objects of the room are kept.
            object_count = ImportCount("objects", num_read=len(base_rooms[name][0].types))
            for result in scene_and_count(_replace_objects, record, set_index, *base_rooms[name], unit="rows"):
                if isinstance(result, InputError):
                    object_count.skip_all(IN_REFUSED_SCENE)
                yield result
            yield object_count


def _read_base_rooms(base: Path) -> dict[str, tuple[Scene, np.ndarray]]:
    """Return scene and pivot offsets (`_pivot_offsets`) of each room by name."""
    base_scenes = read_scenes(base)  # also checks the fields that are read below
    base_rooms: dict[str, tuple[Scene, np.ndarray]] = {}
    for scene, (_, line_bytes) in zip(base_scenes, scene_lines(read_bytes(base)), strict=True):
        base_rooms[scene.name] = (scene, _pivot_offsets(scene, parse_json(str(base), line_bytes)))
    return base_rooms


def _pivot_offsets(scene: Scene, fields: dict[str, Any]) -> np.ndarray:
    """Return how far the centre of each object's box is above its pivot, float64 [N], metres."""
    # Ids of the objects that have a place; the scene lacks the others.
    object_ids: list[str] = []
    for row_values in fields["objects"]:
        object_row = dict(zip(fields["columns"], row_values, strict=True))
        if object_row["x"] is not None or object_row["z"] is not None:
            object_ids.append(str(object_row.get("id")))

    centre_heights = scene.boxes[:, 1]
    half_heights = scene.boxes[:, 4] / 2

    # The y of the pivot stands in the id; objects with another id have it at the middle of their underside.
    pivot_offsets = half_heights.copy()
    for object_index, object_id in enumerate(object_ids):
        id_match = _PIVOT_ID.fullmatch(object_id)
        if id_match:
            pivot_offsets[object_index] = centre_heights[object_index] - float(id_match[2])

    # An id has the place of an object before it fell, sometimes far from its box.
    return np.where(np.abs(pivot_offsets) < half_heights - _PIVOT_ROUNDING, pivot_offsets, half_heights)


def _replace_objects(
    record: JsonRecord, set_index: int, scene: Scene, pivot_offsets: np.ndarray, row_count: ImportCount
) -> Scene:
    """Return a scene with its objects where a set puts them."""
    # The objects of each type that no row has moved so far.
    waiting_objects: dict[str, list[int]] = {}
    for object_index, object_type in enumerate(scene.types):
        waiting_objects.setdefault(object_type, []).append(object_index)

    # The n-th row of a type moves the n-th object of this type.
    moved_boxes = scene.boxes.copy()
    has_moved = np.zeros(len(scene.types), bool)
    set_rows = record.check_list(f"sets[{set_index}]", record.get("sets")[set_index])
    row_count.num_read = len(set_rows)
    for row_index, set_row in enumerate(set_rows):
        field = f"sets[{set_index}][{row_index}]"
        object_type, *pivot_values = record.check_list(field, set_row, len(_REPLACEMENT_COLUMNS))
        candidates = waiting_objects.get(record.check_text(field, object_type))
        if not candidates:
            raise record.error(field, f"is one {reprlib.repr(object_type)} more than the room has; remove it")
        object_index = candidates.pop(0)
        x, y, z = record.check_numbers(field, pivot_values)
        moved_boxes[object_index, :3] = (x, y + pivot_offsets[object_index], z)
        has_moved[object_index] = True
    row_count.num_kept = int(has_moved.sum())

    # Moved objects rest on nothing, nor do objects whose parent has moved.
    still_rests = (scene.parents >= 0) & ~has_moved
    still_rests[still_rests] = ~has_moved[scene.parents[still_rests]]
    parents = np.where(still_rests, scene.parents, -1)
    return dataclasses.replace(scene, name=f"{scene.name}-replaced-{set_index}", boxes=moved_boxes, parents=parents)
