"""Scene files that cannot be read."""

import functools
import gzip
import json
from pathlib import Path

import pytest
from hypothesis import given
from support.mutations import changed, mutated, mutated_bytes, mutated_text
from support.scene_records import RECORD, write_records

from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import Scene


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        *[({k: v for k, v in RECORD.items() if k != field}, f"{field} is missing") for field in RECORD],
        (changed(RECORD, "name", ""), "name is ''"),
        (changed(RECORD, "room_type", 3), "room_type is 3"),
        (changed(RECORD, "split", "training"), "split is 'training'; give one of train, val, test"),
        (changed(RECORD, "cell", 0.5), "cell is 0.5; only 0.25"),
        (changed(RECORD, "origin", [0.1, 0]), "origin is [0.1, 0.0]; both must be multiples of 0.25"),
        (changed(RECORD, "origin", [0.0, 0.271]), "origin is [0.0, 0.271]; both"),
        (changed(RECORD, "origin", [0.0]), "origin is [0.0]; give a list of 2"),
        (changed(RECORD, "origin", [None, 0]), "origin is null"),
        (changed(RECORD, "shape", [0, 3]), "shape is [0, 3]; give two whole numbers"),
        (changed(RECORD, "shape", [2.0, 3]), "shape is [2.0, 3]; give two whole numbers"),
        (changed(RECORD, "reach", ["..#"]), "reach is ['..#']; give a list of 2"),
        (changed(RECORD, "reach", 1, "#.##"), "reach[1] is '#.##'; give 3 characters"),
        (changed(RECORD, "reach", 0, "..x"), "reach[0] is '..x'; give 3 characters '.' or '#'"),
        (changed(RECORD, "reach", ["###", "###"]), "reach has no standable cell"),
        (changed(RECORD, "walls", ["...", "??."]), "walls[1] is '??.'"),
        (changed(RECORD, "walls", None), "walls is None"),
        (changed(RECORD, "episode_starts", [".."] * 2), "episode_starts[0] is '..'"),
        (changed(RECORD, "columns", ["type", "x"]), "columns lacks y, z, sx, sy, sz"),
        (changed(RECORD, "columns", ["type"] * 10), "columns is ['type',"),
        (changed(RECORD, "columns", [["type"]]), "columns is [['type']]"),
        (changed(RECORD, "objects", 1, ["Cup"]), "objects[1] is ['Cup']; give a list of 10"),
        (changed(RECORD, "objects", 1, 0, None), "objects[1].type is None"),
        (changed(RECORD, "objects", 1, 1, float("nan")), "objects[1].x is nan; give a finite number"),
        (changed(RECORD, "objects", 1, 2, float("-inf")), "objects[1].y is -inf; give a finite number"),
        (changed(RECORD, "objects", 1, 3, 10**400), "objects[1].z is 1"),
        (changed(RECORD, "objects", 1, 1, True), "objects[1].x is True"),
        (changed(RECORD, "objects", 0, 1, None), "objects[0].x is null"),  # z is there, so the object is not left out
        (changed(RECORD, "objects", 0, 4, -0.1), "objects[0].sx is -0.1; a size is at least 0"),
        (changed(RECORD, "objects", 0, 7, "north"), "objects[0].yaw is 'north'"),
        (changed(RECORD, "objects", 1, 8, 2), "objects[1].parent is 2; give the index of another object or -1"),
        (changed(RECORD, "objects", 1, 8, 1), "objects[1].parent is 1"),
        (changed(RECORD, "objects", 1, 8, 0.0), "objects[1].parent is 0.0"),
    ],
)
def test_bad_fields_are_refused_with_their_place(tmp_path, record, problem):
    with pytest.raises(InputError) as error:
        read_scenes(write_records(tmp_path / "scenes.jsonl.gz", RECORD | {"name": "first"}, record))
    scene = "'den'" if record.get("name") == "den" else ""
    assert f"scenes.jsonl.gz, line 2, scene {scene}" in str(error.value)
    assert problem in str(error.value)


def test_a_name_used_twice_is_refused(tmp_path):
    with pytest.raises(InputError, match="line 3, scene 'den': name is that of line 1 too"):
        read_scenes(write_records(tmp_path / "scenes.jsonl.gz", RECORD, RECORD | {"name": "other"}, RECORD))


compressed = functools.partial(gzip.compress, mtime=0)  # equal in every run


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "holds no scene"),
        (compressed(b""), "holds no scene"),
        (b"{}\n", "line 1, scene '(no name)': name is missing"),
        (compressed(json.dumps(RECORD).encode())[:-12], "is cut short or damaged"),
        (compressed(json.dumps(RECORD).encode() + b"\n{"), "line 2: not JSON"),
        (compressed(b"\xff\xfe"), "line 1: not JSON"),
        (compressed(b"[" * 100_000), "line 1: not JSON"),
        (compressed(b"[1]"), "line 1: [1] is no scene"),
    ],
)
def test_broken_files_are_refused(tmp_path, data, problem):
    path = tmp_path / "broken.jsonl.gz"
    path.write_bytes(data)
    with pytest.raises(InputError) as error:
        read_scenes(path)
    assert str(error.value).startswith(str(path))
    assert problem in str(error.value)


def test_missing_file_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.jsonl.gz", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_scenes(path)


def assert_read_or_refused(path: Path) -> None:
    try:
        assert all(isinstance(scene, Scene) for scene in read_scenes(path))
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)


@given(mutated_bytes(compressed(json.dumps(RECORD).encode())))
def test_mutated_bytes_never_raise_another_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "bytes.jsonl.gz"
    path.write_bytes(content)
    assert_read_or_refused(path)


@given(mutated_text(json.dumps(RECORD)))
def test_mutated_text_never_raises_another_error(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "text.jsonl.gz"
    path.write_bytes(gzip.compress(text.encode()))
    assert_read_or_refused(path)


@given(mutated(RECORD | {"walls": ["...", "#.#"], "episode_starts": ["#..", "###"]}))
def test_mutated_fields_never_raise_another_error(tmp_path_factory, record):
    path = tmp_path_factory.getbasetemp() / "fields.jsonl.gz"
    write_records(path, record)
    assert_read_or_refused(path)
