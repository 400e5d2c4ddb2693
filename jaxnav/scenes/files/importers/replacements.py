"""Importer of re-placements: rooms with their movable objects moved.

A simulator put the movable objects of known rooms to new places. A record is one room: {"name": ..., "columns":
["type", "x", "y", "z"], "sets": [[["Book", 0.217, 1.099, -0.001], ...], ...]}. A set has one place of each movable
object; x, y, z in metres is an object's pivot, not the centre of its box.
"""

import dataclasses
import json
import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import Scene

_COLUMNS = ["type", "x", "y", "z"]
_NUMBER = r"[-+]?[0-9]+\.[0-9]+"
_ID = re.compile(rf"[^|]+\|{_NUMBER}\|({_NUMBER})\|{_NUMBER}.*")  # Type|x|y|z of the pivot
_ROUNDING = 0.01  # metres; ids have two decimals


def read_replacements(path: Path, base: Path) -> Iterator[Scene | InputError]:
    """Read one scene for every set of every room.

    Scenes are in the order of the file and named `<room>-replaced-<number of the set>`. The rows of a type go to the
    objects of this type in the order of the base scene; those that are left over stay where they are. Sizes, yaws,
    cells and walls are those of the base scene. The pivot is the middle of the underside, unless the object's `id` in
    the base file tells that it is higher up in the box. Moved objects, and what rested on them, rest on nothing.

    Args:
      path: the re-placements, one JSON object per line, plain or gzip.
      base: scene file of the original rooms.

    Yields:
      A scene, or why a room or one of its sets cannot be used.

    Raises:
      InputError: one of the files cannot be read, or `path` is empty.
    """
    rooms = _rooms(base)
    lines = read_bytes(path).splitlines()
    if not lines:
        raise InputError(f"{path}: holds no room; write one JSON object per line")
    for number, text in enumerate(lines, start=1):
        try:
            line = Record(f"{path}, line {number}", {})
            record = line.record("record", parse_json(line.where, text))
            name = record.text("name", record.get("name"))
            if name not in rooms:
                raise record.error("name", f"is {reprlib.repr(name)}, which is no scene of {base}; give its scene file")
            if record.get("columns") != _COLUMNS:
                raise record.error("columns", f"is {reprlib.repr(record.get('columns'))}; give {_COLUMNS}")
            count = len(record.sequence("sets", record.get("sets")))
        except InputError as error:
            yield error
            continue
        for i in range(count):
            yield _replaced_or_error(record, i, *rooms[name])


def _rooms(base: Path) -> dict[str, tuple[Scene, np.ndarray]]:
    """Return the scenes by name, with lifts of their objects.

    A lift is how far the centre of an object's box is above its pivot: float64 [N], metres.
    """
    scenes = read_scenes(base)  # also checks the fields that are read below
    lines = [json.loads(line) for line in read_bytes(base).splitlines()]
    return {scene.name: (scene, _lifts(scene, fields)) for scene, fields in zip(scenes, lines, strict=True)}


def _lifts(scene: Scene, fields: dict[str, Any]) -> np.ndarray:
    rows = [dict(zip(fields["columns"], values, strict=True)) for values in fields["objects"]]
    rows = [row for row in rows if row["x"] is not None or row["z"] is not None]  # the others are not in the scene
    ids = [_ID.fullmatch(str(row.get("id"))) for row in rows]
    heights, half = scene.boxes[:, 1], scene.boxes[:, 4] / 2
    lifts = np.array([y - float(match[1]) if match else np.inf for y, match in zip(heights, ids, strict=True)])
    # An id has the place of an object before it fell, sometimes far from its box.
    return np.where(np.abs(lifts) < half - _ROUNDING, lifts, half)


def _replaced_or_error(record: Record, i: int, scene: Scene, lifts: np.ndarray) -> Scene | InputError:
    try:
        return _replaced(record, i, scene, lifts)
    except InputError as error:
        return error


def _replaced(record: Record, i: int, scene: Scene, lifts: np.ndarray) -> Scene:
    left = {name: [k for k, other in enumerate(scene.types) if other == name] for name in scene.types}
    boxes, moved = scene.boxes.copy(), np.zeros(len(scene.types), bool)
    for j, row in enumerate(record.sequence(f"sets[{i}]", record.get("sets")[i])):
        field = f"sets[{i}][{j}]"
        kind, *place = record.sequence(field, row, len(_COLUMNS))
        candidates = left.get(record.text(field, kind))
        if not candidates:
            raise record.error(field, f"is one {reprlib.repr(kind)} more than the room has; leave it out")
        k = candidates.pop(0)
        x, y, z = (record.number(field, value) for value in place)
        boxes[k, :3] = x, y + lifts[k], z
        moved[k] = True
    rests = (scene.parents >= 0) & ~moved
    rests[rests] = ~moved[scene.parents[rests]]
    return dataclasses.replace(
        scene, name=f"{scene.name}-replaced-{i}", boxes=boxes, parents=np.where(rests, scene.parents, -1)
    )
