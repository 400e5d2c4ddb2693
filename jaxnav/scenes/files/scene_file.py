"""Reading and writing of scene files, see docs/scene_format.md."""

import gzip
import json
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.files.walls import derive_walls
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.scene import CELL, MAX_SIDE, SPLITS, Room, Scene
from jaxnav.store.files import write_atomic

_POSITION, _SIZE = ("x", "y", "z"), ("sx", "sy", "sz")
_REQUIRED = ("type", *_POSITION, *_SIZE)
_COLUMNS = (*_REQUIRED, "yaw", "parent")
_SNAP = 0.02  # metres; an origin may be this far off the lattice


def read_scenes(path: str | Path) -> list[Scene]:
    """Read a scene file.

    Cells of `episode_starts` count as standable; `walls` are derived where the file has none (`derive_walls`). An
    object whose x and z are both null is left out, and what rests on it rests on nothing.

    Args:
      path: a `*.jsonl.gz` file (or the same without gzip).

    Returns:
      The scenes in the order of the file, at least one.

    Raises:
      InputError: the file is missing, damaged or empty, or a field is missing or wrong; names file, line, scene, field
        and mend.
    """
    path = Path(path)
    scenes: list[Scene] = []
    for scene in iterate_scenes(path):
        if isinstance(scene, InputError):
            raise scene
        scenes.append(scene)
    if not scenes:
        raise InputError(f"{path}: holds no scene; write one JSON object per line")
    return scenes


def iterate_scenes(path: Path) -> Iterator[Scene | InputError]:
    """Read a scene file line by line; see `read_scenes`.

    Yields:
      A scene, or why it cannot be used.

    Raises:
      InputError: the file is missing or damaged.
    """
    lines: dict[str, int] = {}
    for line, text in enumerate(read_bytes(path).splitlines(), start=1):
        try:
            record = _parse(path, line, text)
            scene = _scene(record)
            if scene.name in lines:
                raise record.error("name", f"is that of line {lines[scene.name]} too; make it unique")
        except InputError as error:
            yield error
        else:
            lines[scene.name] = line
            yield scene


def write_scenes(path: str | Path, scenes: Iterable[Scene]) -> None:
    """Write a scene file, whole or not at all.

    Equal scenes give equal bytes.

    Raises:
      ValueError: a number is NaN or infinite.
    """
    lines = [json.dumps(_fields(scene), allow_nan=False, separators=(",", ":")) + "\n" for scene in scenes]
    write_atomic(Path(path), gzip.compress("".join(lines).encode(), mtime=0))


def _parse(path: Path, line: int, text: bytes) -> Record:
    where = f"{path}, line {line}"
    fields = parse_json(where, text)
    if not isinstance(fields, dict):
        raise InputError(f"{where}: {reprlib.repr(fields)} is no scene; write one JSON object per line")
    return Record(f"{where}, scene {reprlib.repr(fields.get('name', '(no name)'))}", fields)


def _scene(record: Record) -> Scene:
    name, world, room_type, split = (
        record.text(field, record.get(field)) for field in ("name", "world", "room_type", "split")
    )
    if split not in SPLITS:
        raise record.error("split", f"is {split!r}; give one of {', '.join(SPLITS)}")
    if record.get("cell") != CELL:
        raise record.error("cell", f"is {reprlib.repr(record.get('cell'))}; only {CELL} is known")
    origin = _origin(record)
    shape = record.sequence("shape", record.get("shape"), 2)
    if not all(type(n) is int and 0 < n <= MAX_SIDE for n in shape):
        raise record.error("shape", f"is {reprlib.repr(shape)}; give two whole numbers [nz, nx] from 1 to {MAX_SIDE}")
    reach = _mask(record, "reach", shape)
    if "episode_starts" in record.fields:
        reach |= _mask(record, "episode_starts", shape)
    if not reach.any():
        raise record.error("reach", "has no standable cell; mark at least one with '.'")
    types, boxes, yaws, parents = _objects(record)
    walls = ~_mask(record, "walls", shape) if "walls" in record.fields else derive_walls(reach, origin, boxes)
    return Scene(
        name, world, room_type, split, origin, reach, walls, types, boxes, yaws, parents, _rooms(record, shape)
    )


def _rooms(record: Record, shape: Sequence[int]) -> tuple[Room, ...]:
    rooms = []
    for i, value in enumerate(record.sequence("rooms", record.fields.get("rooms", []))):
        room = record.record(f"rooms[{i}]", value)
        rooms.append(Room(room.text("type", room.get("type")), _mask(room, "cells", shape)))
    return tuple(rooms)


def _origin(record: Record) -> tuple[float, float]:
    x, z = (record.number("origin", v) for v in record.sequence("origin", record.get("origin"), 2))
    snapped = (round(x / CELL) * CELL, round(z / CELL) * CELL)
    if max(abs(x - snapped[0]), abs(z - snapped[1])) > _SNAP:
        raise record.error("origin", f"is [{x}, {z}]; both must be multiples of {CELL} (within {_SNAP})")
    return snapped


def _mask(record: Record, field: str, shape: Sequence[int]) -> np.ndarray:
    """Read a mask, bool [nz, nx], True at '.'."""
    rows = record.sequence(field, record.get(field), shape[0])
    for i, row in enumerate(rows):
        if not isinstance(row, str) or len(row) != shape[1] or not set(row) <= {".", "#"}:
            raise record.error(f"{field}[{i}]", f"is {reprlib.repr(row)}; give {shape[1]} characters '.' or '#'")
    return np.array([[character == "." for character in row] for row in rows])


def _objects(record: Record) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    columns = record.sequence("columns", record.get("columns"))
    if not all(isinstance(c, str) for c in columns) or len(set(columns)) < len(columns):
        raise record.error("columns", f"is {reprlib.repr(columns)}; give names, each once")
    if missing := [column for column in _REQUIRED if column not in columns]:
        raise record.error("columns", f"lacks {', '.join(missing)}; add it")
    rows = [
        dict(zip(columns, record.sequence(f"objects[{i}]", values, len(columns)), strict=True))
        for i, values in enumerate(record.sequence("objects", record.get("objects")))
    ]
    placed = [i for i, row in enumerate(rows) if row["x"] is not None or row["z"] is not None]
    new_index = {old: new for new, old in enumerate(placed)}
    types, boxes, yaws, parents = [], [], [], []
    for i in placed:
        row = {column: value for column, value in rows[i].items() if value is not None}
        types.append(record.text(f"objects[{i}].type", row.get("type")))
        boxes.append(_box(record, i, dict(zip(("sx", "sy", "sz", "y"), typical_box(types[-1]), strict=True)) | row))
        yaws.append(record.number(f"objects[{i}].yaw", row.get("yaw", 0.0)))
        parents.append(new_index.get(_parent(record, i, row.get("parent", -1), len(rows)), -1))
    return (
        tuple(types),
        np.array(boxes, np.float64).reshape(-1, 6),
        np.array(yaws, np.float64),
        np.array(parents, np.int64),
    )


def _box(record: Record, i: int, row: dict[str, Any]) -> list[float]:
    box = [record.number(f"objects[{i}].{column}", row.get(column)) for column in (*_POSITION, *_SIZE)]
    for column, size in zip(_SIZE, box[3:], strict=True):
        if size < 0:
            raise record.error(f"objects[{i}].{column}", f"is {size}; a size is at least 0")
    return box


def _parent(record: Record, i: int, value: Any, count: int) -> int:
    if type(value) is not int or not -1 <= value < count or value == i:
        raise record.error(f"objects[{i}].parent", f"is {reprlib.repr(value)}; give the index of another object or -1")
    return value


def _fields(scene: Scene) -> dict[str, Any]:
    rooms = [{"type": room.type, "cells": _text(room.cells)} for room in scene.rooms]
    rows = zip(scene.types, scene.boxes.tolist(), scene.yaws.tolist(), scene.parents.tolist(), strict=True)
    return {
        "name": scene.name,
        "world": scene.world,
        "room_type": scene.room_type,
        "split": scene.split,
        "cell": CELL,
        "origin": list(scene.origin),
        "shape": list(scene.reach.shape),
        "reach": _text(scene.reach),
        "walls": _text(~scene.walls),
        **({"rooms": rooms} if rooms else {}),
        "columns": list(_COLUMNS),
        "objects": [[kind, *box, yaw, parent] for kind, box, yaw, parent in rows],
    }


def _text(mask: np.ndarray) -> list[str]:
    return ["".join("." if free else "#" for free in row) for row in mask]
