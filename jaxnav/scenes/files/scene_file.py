"""Reading and writing of scene files, and checked access to the JSON of users' files.

`read_scenes` and `write_scenes` convert between files `*.jsonl.gz` (docs/scene_format.md) and `Scene`s;
`iterate_scenes` reads line by line and reports bad scenes instead of raising. `derive_walls` gives scenes walls where
their file has none. The importers of other formats read files by the functions of this module too: they skip blank
lines, byte order marks and hidden files, and every error names the place of the bad value and how to fix it.
"""

import codecs
import dataclasses
import gzip
import io
import json
import re
import reprlib
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount, account_to_json
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import cells_near_boxes
from jaxnav.scenes.scene import CELL_SIZE, MAX_SIDE_CELLS, SPLITS, Room, Scene, box_footprints
from jaxnav.store.files import expand_home, write_atomic

#: Distance in metres that a position in a file may lie off the lattice.
SNAP_TOLERANCE = 0.02

_NUMBER_LIMIT = 1e6  # metres or degrees; a number beyond it is a mistake

_HALF_CHARACTER = re.compile("[\ud800-\udfff]")  # a surrogate without its partner

# Header of a scene file, one line before the scenes; joined files have several.
_HEADER_FIELD = "account"
_HEADER_LINE = re.compile(rb'^(?:\xef\xbb\xbf)?[ \t]*\{"account":.*\n?', re.MULTILINE)

_CENTRE_COLUMNS = ("x", "y", "z")
_SIZE_COLUMNS = ("sx", "sy", "sz")
_REQUIRED_COLUMNS = ("type", *_CENTRE_COLUMNS, *_SIZE_COLUMNS)
_COLUMNS = (*_REQUIRED_COLUMNS, "yaw", "parent")

_WALL_DISTANCE = 3  # cells
_BOX_DISTANCE = 0.25 + 1e-9  # metres


def read_scenes(path: str | Path) -> list[Scene]:
    """Read a scene file.

    Cells of `episode_starts` count as standable; `walls` are derived where the file has none (`derive_walls`). An
    object whose x and z are both null is omitted, and objects that rest on it then rest on nothing.

    Args:
      path: a `*.jsonl.gz` file (or the same without gzip).

    Returns:
      The scenes in the order of the file, at least one.

    Raises:
      InputError: the file is missing, damaged or empty, or a field is missing or wrong; names file, line, scene,
        field and remedy.
    """
    path = expand_home(path)
    return parse_scenes(path, read_bytes(path))


def parse_scenes(path: Path, content: bytes) -> list[Scene]:
    """Parse the content of a scene file, whose path errors name; see `read_scenes`."""
    scenes: list[Scene] = []
    for scene in _iterate_content(path, content):
        if isinstance(scene, ImportCount):
            continue
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
    for result in iterate_counted_scenes(path):
        if not isinstance(result, ImportCount):
            yield result


def iterate_counted_scenes(path: Path) -> Iterator[Scene | InputError | ImportCount]:
    """Read a scene file line by line, as `iterate_scenes`, and count the objects of each line after its scene."""
    yield from _iterate_content(path, read_bytes(path))


def _iterate_content(path: Path, content: bytes) -> Iterator[Scene | InputError | ImportCount]:
    """Parse the content of a scene file line by line; see `iterate_counted_scenes`."""
    line_by_name: dict[str, int] = {}
    for line_number, line_bytes in scene_lines(content):
        object_count = ImportCount("objects")
        try:
            record = _parse_line(path, line_number, line_bytes)
            object_count.num_read = count_items(record.fields.get("objects"))
            scene = _decode_scene(record)

            # Names must be unique, because results and shifts refer to scenes by name.
            if scene.name in line_by_name:
                raise record.error("name", f"is also that of line {line_by_name[scene.name]}; make it unique")
        except InputError as error:
            object_count.skip_all(IN_REFUSED_SCENE)
            yield error
        else:
            line_by_name[scene.name] = line_number
            object_count.skipped["without a place"] = object_count.num_read - len(scene.types)
            yield scene
        yield object_count


def write_scenes(
    path: str | Path,
    scenes: Iterable[Scene],
    account: Mapping[str, ImportCount] | None = None,
    replace: bool = True,
) -> None:
    """Write a scene file, whole or not at all.

    Equal scenes and accounts give equal bytes.

    Args:
      path: the file.
      scenes: the scenes.
      account: counts of an import by their unit, for a header line; None for no header.
      replace: whether to replace a file that holds anything else.

    Raises:
      InputError: the file holds something else, and is not to be replaced.
      ValueError: a number is NaN or infinite.
    """
    # One compact line per scene; without a time in the gzip header equal scenes give equal bytes.
    file_records: list[dict[str, Any]] = []
    if account is not None:
        file_records.append({_HEADER_FIELD: account_to_json(account)})
    file_records.extend(map(_encode_scene, scenes))
    file_lines = [json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n" for record in file_records]
    content = "".join(file_lines).encode()
    path = expand_home(path)
    if not replace and path.exists() and read_bytes(path) != content:
        raise InputError(f"{path}: holds other scenes or another account of an import; remove it, or give another name")
    write_atomic(path, gzip.compress(content, mtime=0))


# Checked access to JSON


@dataclasses.dataclass(frozen=True)
class JsonRecord:
    """A JSON object and its name in errors.

    The methods `get_*` read a required member, and `check_*` a value that the caller looked up under the name `field`.
    All of them raise an `InputError` for a missing or unsuitable value.

    Attributes:
      location: place of the object, for example `rooms.jsonl.gz, line 3, scene 'FloorPlan1'`.
      fields: members of the object.
    """

    location: str
    fields: dict[str, Any]

    def error(self, field: str, problem: str) -> InputError:
        """Return an error about one field, to be raised."""
        return InputError(f"{self.location}: {field} {problem}")

    def get(self, field: str) -> Any:
        """Return a required member."""
        if field not in self.fields:
            raise self.error(field, "is missing; add it")
        return self.fields[field]

    def get_text(self, field: str) -> str:
        """Return a required member that is a text, not empty."""
        return self.check_text(field, self.get(field))

    def get_list(self, field: str, length: int | None = None) -> list[Any]:
        """Return a required member that is a list (of `length`)."""
        return self.check_list(field, self.get(field), length)

    def get_list_or_empty(self, field: str) -> list[Any]:
        """Return a member that is a list; an empty one where it is missing or null."""
        return self.check_list(field, self.fields.get(field) or [])

    def get_record(self, field: str) -> "JsonRecord":
        """Return a required member that is an object."""
        return self.check_record(field, self.get(field))

    def get_numbers(self, fields: Iterable[str] = "xyz") -> list[float]:
        """Return required members that are finite numbers, such as those of the position {"x": 0, "y": 0, "z": 0}."""
        return [self.check_number(field, self.get(field)) for field in fields]

    def check_text(self, field: str, value: Any) -> str:
        """Return a value that must be a text, not empty."""
        if not isinstance(value, str) or not value:
            raise self.error(field, f"is {reprlib.repr(value)}; give a string")
        # Half of a surrogate pair can be read but not written.
        if _HALF_CHARACTER.search(value):
            raise self.error(
                field,
                f"is {reprlib.repr(value)}, which contains half a character; write the whole character",
            )
        return value

    def check_number(self, field: str, value: Any) -> float:
        """Return a value that must be a finite number."""
        if value is None:
            raise self.error(field, "is null; give the number or leave the object out")
        if type(value) not in (int, float) or not abs(value) <= _NUMBER_LIMIT:  # also refuses NaN
            raise self.error(field, f"is {reprlib.repr(value)}; give a finite number, at most {_NUMBER_LIMIT:g}")
        return float(value)

    def check_list(self, field: str, value: Any, length: int | None = None) -> list[Any]:
        """Return a value that must be a list (of `length`)."""
        if not isinstance(value, list) or length not in (None, len(value)):
            expected = "a list" if length is None else f"a list of {length}"
            raise self.error(field, f"is {reprlib.repr(value)}; give {expected}")
        return value

    def check_record(self, field: str, value: Any) -> "JsonRecord":
        """Return a value that must be an object; its errors name `field` too."""
        if not isinstance(value, dict):
            raise self.error(field, f"is {reprlib.repr(value)}; give a JSON object")
        return JsonRecord(f"{self.location}: {field}", value)

    def check_numbers(self, field: str, values: Iterable[Any]) -> list[float]:
        """Return values that must be finite numbers."""
        return [self.check_number(field, value) for value in values]

    def iterate_records(self, field: str, values: Any) -> Iterator["JsonRecord"]:
        """Yield the items of a list of objects, named `field[0]`, `field[1]`, ... in their errors."""
        for index, value in enumerate(self.check_list(field, values)):
            yield self.check_record(f"{field}[{index}]", value)


def read_bytes(path: Path) -> bytes:
    """Read a file, and decompress it if it is gzip.

    Raises:
      InputError: the file is missing or damaged, or too large when decompressed.
    """
    try:
        content = path.read_bytes()
        if content[:2] != b"\x1f\x8b":
            return content
        # Reading one byte more than the limit shows that there is more, without decompressing all of it.
        max_size = max_decompressed_size(len(content))
        with gzip.open(io.BytesIO(content)) as file:
            content = file.read(max_size + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: is cut short or damaged ({error}); download or write it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if len(content) > max_size:
        raise InputError(f"{path}: holds more than {max_size:,} bytes; split it, or give it uncompressed")
    return content


def numbered_lines(content: bytes) -> list[tuple[int, bytes]]:
    """Return number and text of each line that is not blank; numbers begin at 1."""
    text_lines: list[tuple[int, bytes]] = []
    for line_number, line_bytes in enumerate(content.splitlines(), start=1):
        if line_bytes.removeprefix(codecs.BOM_UTF8).strip():
            text_lines.append((line_number, line_bytes))
    return text_lines


def scene_lines(content: bytes) -> list[tuple[int, bytes]]:
    """Return number and text of each line of a scene file that is neither blank nor a header."""
    return [numbered_line for numbered_line in numbered_lines(content) if not _HEADER_LINE.match(numbered_line[1])]


def remove_headers(content: bytes) -> bytes:
    """Return the content of a scene file without its header lines, as it was before scene files had headers."""
    return _HEADER_LINE.sub(b"", content)


def count_items(value: Any) -> int:
    """Return the number of items of a JSON list or object; 0 for any other value."""
    return len(value) if isinstance(value, list | dict) else 0


def read_json_texts(path: Path) -> list[tuple[str, bytes]]:
    """Read the JSON texts of a file, whether it is one text or has one on every line.

    Returns:
      Location and text of each; none for a file of lines that are all blank.

    Raises:
      InputError: the file is missing or damaged.
    """
    content = read_bytes(path)
    text_lines = numbered_lines(content)

    # The first line is JSON by itself only in a file of lines; the name decides for damaged files.
    has_json_lines = path.name.removesuffix(".gz").endswith(".jsonl")
    if text_lines and not has_json_lines:
        has_json_lines = _is_json(text_lines[0][1])
    if not has_json_lines:
        return [(str(path), content)]
    return [(f"{path}, line {line_number}", line_bytes) for line_number, line_bytes in text_lines]


def list_visible_files(folder: Path) -> list[Path]:
    """Return the sorted members of a folder, without hidden ones such as the `._*` that archives of macOS add."""
    return sorted(member for member in folder.iterdir() if not member.name.startswith("."))


def max_decompressed_size(compressed_size: int) -> int:
    """Return the number of bytes that a gzip file of `compressed_size` bytes may hold.

    Scenes hold 4 to 10 times as many; 64 MiB are allowed in any case.
    """
    return max(2**26, 50 * compressed_size)


def _is_json(text: bytes) -> bool:
    """True for JSON, with or without a byte order mark."""
    try:
        json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        return False
    return True


class _RepeatedFieldError(Exception):
    """A JSON object that gives a field twice."""


def parse_json(location: str, text: bytes) -> Any:
    """Parse JSON, with or without a byte order mark.

    Raises:
      InputError: the bytes are not JSON, or an object gives a field twice, so that one of its values would be lost.
    """
    try:
        return json.loads(text.decode("utf-8-sig"), object_pairs_hook=_collect_fields)
    except _RepeatedFieldError as error:
        raise InputError(f"{location}: an object gives {error} twice; give every field of an object once") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{location}: not JSON ({error}); give valid JSON") from error


def _collect_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Collect the fields of a JSON object.

    Raises:
      _RepeatedFieldError: names the first field that is given twice.
    """
    fields: dict[str, Any] = {}
    for name, value in pairs:
        if name in fields:
            raise _RepeatedFieldError(reprlib.repr(name))
        fields[name] = value
    return fields


# From JSON to scenes


def _parse_line(path: Path, line_number: int, line_bytes: bytes) -> JsonRecord:
    location = f"{path}, line {line_number}"
    fields = parse_json(location, line_bytes)
    if not isinstance(fields, dict):
        raise InputError(f"{location}: {reprlib.repr(fields)} is not a scene; write one JSON object per line")
    return JsonRecord(f"{location}, scene {reprlib.repr(fields.get('name', '(no name)'))}", fields)


def _decode_scene(record: JsonRecord) -> Scene:
    """Build the scene of one line."""
    # The names that describe the scene.
    name = record.get_text("name")
    world = record.get_text("world")
    room_type = record.get_text("room_type")
    split = record.get_text("split")
    if split not in SPLITS:
        raise record.error("split", f"is {split!r}; give one of {', '.join(SPLITS)}")

    # The lattice has one spacing, and its sides are limited.
    if record.get("cell") != CELL_SIZE:
        raise record.error("cell", f"is {reprlib.repr(record.get('cell'))}; only {CELL_SIZE} is supported")
    origin = _decode_origin(record)
    shape = record.get_list("shape", 2)
    for side in shape:
        if type(side) is not int or not 0 < side <= MAX_SIDE_CELLS:
            expected = f"give two whole numbers [nz, nx] from 1 to {MAX_SIDE_CELLS}"
            raise record.error("shape", f"is {reprlib.repr(shape)}; {expected}")

    # Episodes may start next to the reachable cells, so the agent can stand there too.
    reach = _decode_mask(record, "reach", shape)
    if "episode_starts" in record.fields:
        reach |= _decode_mask(record, "episode_starts", shape)
    if not reach.any():
        raise record.error("reach", "has no standable cell; mark at least one with '.'")

    types, boxes, yaws, parents = _decode_objects(record)

    # In the file '.' marks the cells that are no wall.
    walls = ~_decode_mask(record, "walls", shape) if "walls" in record.fields else derive_walls(reach, origin, boxes)

    return Scene(
        name=name,
        world=world,
        room_type=room_type,
        split=split,
        origin=origin,
        reach=reach,
        walls=walls,
        types=types,
        boxes=boxes,
        yaws=yaws,
        parents=parents,
        rooms=_decode_rooms(record, shape),
    )


def _decode_origin(record: JsonRecord) -> tuple[float, float]:
    x, z = record.check_numbers("origin", record.get_list("origin", 2))
    # Small errors of rounding are corrected, larger ones are mistakes.
    snapped_origin = (round(x / CELL_SIZE) * CELL_SIZE, round(z / CELL_SIZE) * CELL_SIZE)
    if max(abs(x - snapped_origin[0]), abs(z - snapped_origin[1])) > SNAP_TOLERANCE:
        expected = f"both must be multiples of {CELL_SIZE} (within {SNAP_TOLERANCE})"
        raise record.error("origin", f"is [{x}, {z}]; {expected}")
    return snapped_origin


def _decode_mask(record: JsonRecord, field: str, shape: Sequence[int]) -> np.ndarray:
    """Read a mask, bool [nz, nx], True at '.'."""
    # Each row is checked on its own, so that an error can name it.
    mask_rows = record.get_list(field, shape[0])
    for row_index, mask_row in enumerate(mask_rows):
        if not isinstance(mask_row, str) or len(mask_row) != shape[1] or not set(mask_row) <= {".", "#"}:
            expected = f"give {shape[1]} characters '.' or '#'"
            raise record.error(f"{field}[{row_index}]", f"is {reprlib.repr(mask_row)}; {expected}")
    return np.array([list(mask_row) for mask_row in mask_rows]) == "."


def _decode_rooms(record: JsonRecord, shape: Sequence[int]) -> tuple[Room, ...]:
    decoded_rooms: list[Room] = []
    for room_record in record.iterate_records("rooms", record.fields.get("rooms", [])):
        decoded_rooms.append(Room(room_record.get_text("type"), _decode_mask(room_record, "cells", shape)))
    return tuple(decoded_rooms)


def _decode_objects(record: JsonRecord) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    """Read the objects that have a place.

    Returns:
      Types [N], boxes float64 [N, 6], yaws float64 [N] and parents int64 [N], as in `Scene`.
    """
    # The file may order the columns as it likes, and may have more of them.
    column_names = record.get_list("columns")
    if not all(isinstance(column, str) for column in column_names) or len(set(column_names)) < len(column_names):
        raise record.error("columns", f"is {reprlib.repr(column_names)}; give names, each once")
    missing_columns = [column for column in _REQUIRED_COLUMNS if column not in column_names]
    if missing_columns:
        raise record.error("columns", f"lacks {', '.join(missing_columns)}; add the missing names")

    # One dict per object, by column.
    object_rows: list[dict[str, Any]] = []
    for object_index, row_values in enumerate(record.get_list("objects")):
        cell_values = record.check_list(f"objects[{object_index}]", row_values, len(column_names))
        object_rows.append(dict(zip(column_names, cell_values, strict=True)))

    # Objects without a place are omitted, so other objects get new indices; parents refer to the old ones.
    new_index: dict[int, int] = {}
    for object_index, object_row in enumerate(object_rows):
        if object_row["x"] is not None or object_row["z"] is not None:
            new_index[object_index] = len(new_index)

    object_types: list[str] = []
    object_boxes: list[list[float]] = []
    object_yaws: list[float] = []
    parent_indices: list[int] = []
    for object_index in new_index:
        # A value that is null counts as missing.
        object_row = _without_nulls(object_rows[object_index])
        object_type = record.check_text(f"objects[{object_index}].type", object_row.get("type"))
        object_types.append(object_type)
        object_boxes.append(_decode_box(record, object_index, object_type, object_row))
        object_yaws.append(record.check_number(f"objects[{object_index}].yaw", object_row.get("yaw", 0.0)))
        old_parent = _decode_parent(record, object_index, object_row.get("parent", -1), len(object_rows))
        parent_indices.append(new_index.get(old_parent, -1))

    return (
        tuple(object_types),
        np.array(object_boxes, np.float64).reshape(-1, 6),
        np.array(object_yaws, np.float64),
        np.array(parent_indices, np.int64),
    )


def _without_nulls(object_row: dict[str, Any]) -> dict[str, Any]:
    return {column_name: cell_value for column_name, cell_value in object_row.items() if cell_value is not None}


def _decode_box(record: JsonRecord, object_index: int, object_type: str, object_row: dict[str, Any]) -> list[float]:
    """Read centre and size; the size and the height y default to those typical of the type."""
    typical_values = dict(zip((*_SIZE_COLUMNS, "y"), typical_box(object_type), strict=True))
    object_row = typical_values | object_row

    # Centre x, y, z and size sx, sy, sz, in the order of a scene's boxes.
    box: list[float] = []
    for column_name in (*_CENTRE_COLUMNS, *_SIZE_COLUMNS):
        box.append(record.check_number(f"objects[{object_index}].{column_name}", object_row.get(column_name)))
    for column_name, side_length in zip(_SIZE_COLUMNS, box[3:], strict=True):
        if side_length < 0:
            raise record.error(f"objects[{object_index}].{column_name}", f"is {side_length}; give a size of at least 0")
    return box


def _decode_parent(record: JsonRecord, object_index: int, parent_index: Any, num_objects: int) -> int:
    if type(parent_index) is not int or not -1 <= parent_index < num_objects or parent_index == object_index:
        expected = "give the index of another object or -1"
        raise record.error(f"objects[{object_index}].parent", f"is {reprlib.repr(parent_index)}; {expected}")
    return parent_index


def derive_walls(reach: np.ndarray, origin: tuple[float, float], boxes: np.ndarray) -> np.ndarray:
    """Return the cells that can be neither floor nor furniture.

    Args:
      reach: bool [nz, nx], standable cells.
      origin: world (x, z) in metres of the centre of cell [0, 0].
      boxes: float [N, 6], centre and full size of the objects in metres.

    Returns:
      bool [nz, nx], True where every standable cell is three or more cells away in x or in z, and every box more than
      0.25 m (horizontally) from the cell's centre.
    """
    # Cells with no standable cell in the square around them.
    radius = _WALL_DISTANCE - 1
    window_shape = (2 * radius + 1, 2 * radius + 1)
    reach_windows = np.lib.stride_tricks.sliding_window_view(np.pad(reach, radius), window_shape)
    wall_mask = np.logical_not(reach_windows.any(axis=(2, 3)))

    # Without the cells near boxes.
    column_x = origin[0] + CELL_SIZE * np.arange(reach.shape[1])
    row_z = origin[1] + CELL_SIZE * np.arange(reach.shape[0])
    return wall_mask & ~cells_near_boxes(box_footprints(boxes), column_x, row_z, _BOX_DISTANCE)


# From scenes to JSON


def _encode_scene(scene: Scene) -> dict[str, Any]:
    # The order of the fields is part of the file's bytes.
    fields: dict[str, Any] = {
        "name": scene.name,
        "world": scene.world,
        "room_type": scene.room_type,
        "split": scene.split,
        "cell": CELL_SIZE,
        "origin": list(scene.origin),
        "shape": list(scene.reach.shape),
        "reach": _encode_mask(scene.reach),
        "walls": _encode_mask(~scene.walls),
    }
    if scene.rooms:
        fields["rooms"] = []
        for room in scene.rooms:
            fields["rooms"].append({"type": room.type, "cells": _encode_mask(room.cells)})

    # One row per object, in the order of the columns.
    fields["columns"] = list(_COLUMNS)
    fields["objects"] = []
    object_attributes = zip(scene.types, scene.boxes.tolist(), scene.yaws.tolist(), scene.parents.tolist(), strict=True)
    for object_type, box, yaw, parent in object_attributes:
        fields["objects"].append([object_type, *box, yaw, parent])
    return fields


def _encode_mask(mask: np.ndarray) -> list[str]:
    """Write a mask, bool [nz, nx], as rows of '.' where it is True and '#' elsewhere."""
    return ["".join(row) for row in np.where(mask, ".", "#").tolist()]
