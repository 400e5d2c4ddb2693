"""Importer of AI2-THOR metadata.

It is `event.metadata` after the action GetReachablePositions, saved as JSON. A record is the metadata object itself, or
{"metadata": ..., "reachablePositions": [...]} where the positions were saved separately.
"""

import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.assemble import Thing, lattice_cells, scene_of_cells
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.scene import Scene

#: Height of the agent's position above the floor, metres.
AGENT_HEIGHT = 0.9
#: Types that are the shell of a room. Doorways and windows are objects.
STRUCTURE = frozenset({"Floor", "Wall", "Ceiling", "Room"})

_ENDINGS = (".json", ".json.gz", ".jsonl", ".jsonl.gz")
_ITHOR_ROOMS = {0: "kitchen", 2: "living_room", 3: "bedroom", 4: "bathroom"}  # by the hundreds of the scene number


def read_ai2thor(path: Path, split: str) -> Iterator[Scene | InputError]:
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
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.name.endswith(_ENDINGS))
        if not files:
            raise InputError(f"{path}: holds no file {', '.join(_ENDINGS)}; give the folder of the metadata")
    for file in files:
        try:
            records = _records(file)
        except InputError as error:
            if file == path:
                raise
            yield error
            continue
        for where, text in records:
            yield _scene_or_error(where, text, split)


def scene_of_metadata(where: str, value: Any, split: str) -> Scene:
    """Build the scene of one record.

    Args:
      where: how errors name the record.
      value: the record, see the module.
      split: split of the scene.

    Raises:
      InputError: it cannot be used; names the scene, the field and how to mend it.
    """
    outer = Record(where, {}).record("record", value)
    metadata = outer.record("metadata", outer.fields.get("metadata", outer.fields)).fields | outer.fields
    record = Record(f"{where}, scene {reprlib.repr(metadata.get('sceneName', '(no name)'))}", metadata)
    name = scene_name(record.text("sceneName", record.get("sceneName")))
    # Releases 1-2 have the positions at the top level, later ones as what the action returned, some of them in both.
    filled = [field for field in ("reachablePositions", "actionReturn") if metadata.get(field)]
    if not filled:
        raise record.error("actionReturn", "has no positions; save event.metadata right after GetReachablePositions")
    points = record.sequence(filled[0], metadata[filled[0]])
    cells, floor = standable(record, filled[0], points)
    return scene_of_cells(name, *world_and_room_type(name), split, cells, _things(record, floor))


def scene_name(text: str) -> str:
    """Remove the suffix `_physics` that some releases add."""
    return re.sub(r"(?<=.)_physics\Z", "", text)


def world_and_room_type(name: str) -> tuple[str, str]:
    """Return world and room type by a scene's name."""
    if match := re.fullmatch(r"FloorPlan([0-9]{1,3})", name):
        hundreds, number = divmod(int(match[1]), 100)
        if hundreds in _ITHOR_ROOMS and 1 <= number <= 30:
            return "ithor", _ITHOR_ROOMS[hundreds]
    if name.startswith("FloorPlan_"):
        return "robothor", "apartment"
    return ("procthor", "house") if name == "Procedural" else ("ai2thor", "other")


def standable(record: Record, field: str, points: Sequence[Any]) -> tuple[np.ndarray, float]:
    """Return the standable cells and the height of the floor.

    Args:
      record: the scene's record.
      field: name of the field that holds the points.
      points: objects with x, y and z in metres: positions of the agent's body.

    Returns:
      Lattice indices (iz, ix), int [N, 2], and metres. The height comes from the agent because the box of `Floor`
      reaches far below the ground in many rooms.
    """
    xyz = np.array([record.vector(f"{field}[{i}]", point) for i, point in enumerate(points)]).reshape(-1, 3)
    cells = lattice_cells(record, field, xyz[:, [0, 2]].tolist())
    return cells, float(np.median(xyz[:, 1])) - AGENT_HEIGHT


def pivot_box(kind: str, x: float, y: float, z: float) -> list[float]:
    """Return a box of typical size around an object's pivot.

    It is raised out of the floor, because pivots may be at the bottom of objects.

    Args:
      kind: type of the object.
      x, y, z: the pivot, metres, y above the floor.

    Returns:
      Centre and full size, metres.
    """
    width, height, depth, _ = typical_box(kind)
    return [x, max(y, height / 2), z, width, height, depth]


def _records(path: Path) -> list[tuple[str, bytes]]:
    """Return the places and texts of a file's records."""
    content = read_bytes(path)
    if ".jsonl" not in path.suffixes:
        return [(str(path), content)]
    lines = content.splitlines()
    if not lines:
        raise InputError(f"{path}: holds no record; write one JSON object per line")
    return [(f"{path}, line {number}", line) for number, line in enumerate(lines, start=1)]


def _scene_or_error(where: str, text: bytes, split: str) -> Scene | InputError:
    try:
        return scene_of_metadata(where, parse_json(where, text), split)
    except InputError as error:
        return error


def _things(record: Record, floor: float) -> list[Thing]:
    """Read the objects without the shell of the room.

    The field `objects` is a list, or an object keyed by id.
    """
    objects = record.get("objects")
    items = objects.items() if isinstance(objects, dict) else enumerate(record.sequence("objects", objects))
    rows = [record.record(f"objects[{reprlib.repr(key)}]", value) for key, value in items]
    rows = [row for row in rows if _kind(row) not in STRUCTURE]
    if not rows:
        raise record.error("objects", "holds no object; give at least one")
    index = {row.text("objectId", row.get("objectId")): i for i, row in enumerate(rows)}
    boxes = [_box(row, floor) for row in rows]
    volumes = [float(np.prod(box[3:])) for box in boxes]
    things = []
    for i, row in enumerate(rows):
        (yaw,) = row.vector("rotation", row.get("rotation"), "y")
        things.append(Thing(_kind(row), boxes[i], yaw, _parent(row, i, index, volumes)))
    return things


def _kind(row: Record) -> str:
    return row.text("objectType", row.get("objectType"))


def _parent(row: Record, position: int, index: Mapping[str, int], volumes: Sequence[float]) -> int:
    """Return the smallest receptacle of an object, or -1.

    A drawer is more specific than its desk. `position` is the object's index.
    """
    ids = row.fields.get("parentReceptacles")
    ids = [] if ids is None else row.sequence("parentReceptacles", ids)
    parents = [index[key] for key in ids if isinstance(key, str) and index.get(key, position) != position]
    return min(parents, key=volumes.__getitem__, default=-1)


def _box(row: Record, floor: float) -> list[float]:
    """Return centre and size, metres, y above the floor."""
    field = next((field for field in ("axisAlignedBoundingBox", "bounds3D") if row.fields.get(field) is not None), None)
    centre, size = [0.0] * 3, [0.0] * 3
    if field == "axisAlignedBoundingBox":
        inner = row.record(field, row.fields[field])
        centre, size = (inner.vector(part, inner.get(part)) for part in ("center", "size"))
    elif field == "bounds3D":  # low corner, high corner
        corners = [row.number(field, number) for number in row.sequence(field, row.fields[field], 6)]
        low, high = np.reshape(corners, (2, 3))
        centre, size = ((low + high) / 2).tolist(), (high - low).tolist()
    if field and min(size) < 0:
        raise row.error(field, f"has the size {size}; a size is at least 0")
    if max(size) == 0:  # the object has no renderer
        x, y, z = row.vector("position", row.get("position"))
        return pivot_box(_kind(row), x, y - floor, z)
    return [centre[0], centre[1] - floor, centre[2], *size]
