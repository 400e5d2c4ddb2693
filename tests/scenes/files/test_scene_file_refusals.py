"""Refusals of unreadable scene files."""

import functools
import gzip
import json
from pathlib import Path

import pytest
from hypothesis import given
from support.mutations import changed, mutated, mutated_bytes, mutated_text, without
from support.refusals import assert_message_names
from support.scene_records import RECORD, write_records

from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import Scene


@pytest.mark.parametrize(
    ("record", "field_name", "remedy"),
    [
        *[(without(RECORD, field_name), field_name, "add it") for field_name in RECORD],
        (changed(RECORD, "name", ""), "name", "give a string"),
        (changed(RECORD, "room_type", 3), "room_type", "give a string"),
        (changed(RECORD, "split", "training"), "split", "give one of train, val, test"),
        (changed(RECORD, "cell", 0.5), "cell", "only 0.25"),
        (changed(RECORD, "origin", [0.1, 0]), "origin", "both must be multiples of 0.25"),
        (changed(RECORD, "origin", [0.0, 0.271]), "origin", "both must be multiples of 0.25"),
        (changed(RECORD, "origin", [0.0]), "origin", "give a list of 2"),
        (changed(RECORD, "origin", [None, 0]), "origin", "give the number or leave the object out"),
        (changed(RECORD, "shape", [0, 3]), "shape", "give two whole numbers"),
        (changed(RECORD, "shape", [2.0, 3]), "shape", "give two whole numbers"),
        (changed(RECORD, "reach", ["..#"]), "reach", "give a list of 2"),
        (changed(RECORD, "reach", 1, "#.##"), "reach[1]", "give 3 characters"),
        (changed(RECORD, "reach", 0, "..x"), "reach[0]", "give 3 characters '.' or '#'"),
        (changed(RECORD, "reach", ["###", "###"]), "reach", "mark at least one with '.'"),
        (changed(RECORD, "walls", ["...", "??."]), "walls[1]", "give 3 characters '.' or '#'"),
        (changed(RECORD, "walls", None), "walls", "give a list of 2"),
        (changed(RECORD, "episode_starts", [".."] * 2), "episode_starts[0]", "give 3 characters '.' or '#'"),
        (changed(RECORD, "columns", ["type", "x"]), "columns", "add the missing names"),
        (changed(RECORD, "columns", ["type"] * 10), "columns", "give names, each once"),
        (changed(RECORD, "columns", [["type"]]), "columns", "give names, each once"),
        (changed(RECORD, "objects", 1, ["Cup"]), "objects[1]", "give a list of 10"),
        (changed(RECORD, "objects", 1, 0, None), "objects[1].type", "give a string"),
        (changed(RECORD, "objects", 1, 1, float("nan")), "objects[1].x", "finite number"),
        (changed(RECORD, "objects", 1, 2, float("-inf")), "objects[1].y", "finite number"),
        (changed(RECORD, "objects", 1, 3, 10**400), "objects[1].z", "finite number"),
        (changed(RECORD, "objects", 1, 1, True), "objects[1].x", "finite number"),
        (
            changed(RECORD, "objects", 0, 1, None),
            "objects[0].x",
            "give the number or leave the object out",
        ),  # z is there, so the object is not left out
        (changed(RECORD, "objects", 0, 4, -0.1), "objects[0].sx", "of at least 0"),
        (changed(RECORD, "objects", 0, 7, "north"), "objects[0].yaw", "finite number"),
        (changed(RECORD, "objects", 1, 8, 2), "objects[1].parent", "give the index of another object or -1"),
        (changed(RECORD, "objects", 1, 8, 1), "objects[1].parent", "give the index of another object or -1"),
        (changed(RECORD, "objects", 1, 8, 0.0), "objects[1].parent", "give the index of another object or -1"),
    ],
)
def test_read_scenes_refuses_bad_fields_naming_line_scene_and_remedy(tmp_path, record, field_name, remedy):
    with pytest.raises(InputError) as error:
        read_scenes(write_records(tmp_path / "scenes.jsonl.gz", RECORD | {"name": "first"}, record))
    scene_name = "'den': " if record.get("name") == "den" else ": "
    assert_message_names(error.value, "scenes.jsonl.gz, line 2, scene ", scene_name, f"{field_name} ", remedy)


def test_read_scenes_refuses_a_repeated_name(tmp_path):
    with pytest.raises(InputError, match=r"line 3, scene 'den': name .*line 1"):
        read_scenes(write_records(tmp_path / "scenes.jsonl.gz", RECORD, RECORD | {"name": "other"}, RECORD))


#: Compress bytes to bytes that are equal in every run.
compressed = functools.partial(gzip.compress, mtime=0)


@pytest.mark.parametrize(
    ("file_bytes", "expected_part"),
    [
        (b"", "no scene"),
        (compressed(b""), "no scene"),
        (b"{}\n", "line 1, scene '(no name)': name"),
        (compressed(json.dumps(RECORD).encode())[:-12], "cut short"),
        (compressed(json.dumps(RECORD).encode() + b"\n{"), "line 2: not JSON"),
        (compressed(b"\xff\xfe"), "line 1: not JSON"),
        (compressed(b"[" * 100_000), "line 1: not JSON"),
        (compressed(b"[1]"), "line 1: [1]"),
        # One of the two values would be lost.
        (compressed(b'{"name": "den", "name": "attic"}'), "line 1: an object gives 'name' twice"),
        (compressed(b'{"objects": [{"x": 1, "x": 2}]}'), "line 1: an object gives 'x' twice"),
    ],
)
def test_read_scenes_refuses_broken_files(tmp_path, file_bytes, expected_part):
    scene_file = tmp_path / "broken.jsonl.gz"
    scene_file.write_bytes(file_bytes)
    with pytest.raises(InputError) as error:
        read_scenes(scene_file)
    assert str(error.value).startswith(str(scene_file))
    assert expected_part in str(error.value)


@pytest.mark.parametrize("file_name", ["none.jsonl.gz", "."])
def test_read_scenes_refuses_a_missing_file_and_a_folder(tmp_path, file_name):
    with pytest.raises(InputError, match="cannot be read"):
        read_scenes(tmp_path / file_name)


def assert_read_or_refused(scene_file: Path) -> None:
    try:
        for scene in read_scenes(scene_file):
            assert isinstance(scene, Scene)
    except InputError as error:
        assert str(error).startswith(str(scene_file))  # noqa: PT017  (reading may also succeed)


@given(mutated_bytes(compressed(json.dumps(RECORD).encode())))
def test_read_scenes_reads_or_refuses_mutated_bytes(tmp_path_factory, file_bytes):
    scene_file = tmp_path_factory.getbasetemp() / "bytes.jsonl.gz"
    scene_file.write_bytes(file_bytes)
    assert_read_or_refused(scene_file)


@given(mutated_text(json.dumps(RECORD)))
def test_read_scenes_reads_or_refuses_mutated_text(tmp_path_factory, record_text):
    scene_file = tmp_path_factory.getbasetemp() / "text.jsonl.gz"
    scene_file.write_bytes(gzip.compress(record_text.encode()))
    assert_read_or_refused(scene_file)


@given(mutated(RECORD | {"walls": ["...", "#.#"], "episode_starts": ["#..", "###"]}))
def test_read_scenes_reads_or_refuses_mutated_fields(tmp_path_factory, record):
    scene_file = tmp_path_factory.getbasetemp() / "fields.jsonl.gz"
    write_records(scene_file, record)
    assert_read_or_refused(scene_file)
