"""Scene files: fields, round trips and missing numbers."""

import collections
import dataclasses
import gzip
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.real_scenes import ITHOR, require
from support.scene_records import RECORD, assert_scenes_equal, write_records

from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.generate.sizes import UNKNOWN_BOX, typical_box
from jaxnav.scenes.scene import Scene


@pytest.fixture
def read(tmp_path):
    def read_records(*records: dict) -> list[Scene]:
        return read_scenes(write_records(tmp_path / "scenes.jsonl.gz", *records))

    return read_records


def test_fields_are_read_as_documented(read):
    (scene,) = read(RECORD)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("den", "test", "bedroom", "val")
    assert scene.origin == (-1.0, 0.5)
    np.testing.assert_array_equal(scene.reach, [[True, True, False], [False, True, False]])
    assert scene.types == ("Bed", "Book")
    np.testing.assert_array_equal(scene.boxes, [[0.1, 0.3, 0.2, 1.5, 0.6, 2.0], [0.1, 0.65, 0.2, 0.2, 0.0, 0.3]])
    np.testing.assert_array_equal(scene.yaws, [90.0, 0.0])
    np.testing.assert_array_equal(scene.parents, [-1, 0])
    assert not scene.walls.any()  # no cell is three away from a standable one


def test_optional_columns_and_masks(read):
    bare = RECORD | {
        "columns": ["sz", "sy", "sx", "z", "y", "x", "type"],  # the order is that of the file
        "objects": [[6, 5, 4, 3, 2, 1, "Desk"]],
        "walls": ["..#", "..."],
        "episode_starts": ["#..", "###"],
        "unknown": {"kept": False},
    }
    (scene,) = read(bare)
    np.testing.assert_array_equal(scene.boxes, [[1, 2, 3, 4, 5, 6]])
    assert (scene.yaws.tolist(), scene.parents.tolist()) == ([0.0], [-1])
    np.testing.assert_array_equal(scene.walls, [[False, False, True], [False, False, False]])
    np.testing.assert_array_equal(scene.reach, [[True, True, True], [False, True, False]])


def test_an_origin_slightly_off_the_lattice_is_snapped(read):
    (scene,) = read(RECORD | {"origin": [-1.018, 0.517]})
    assert scene.origin == (-1.0, 0.5)


def test_objects_without_a_position_are_left_out(read):
    ghost = ["Ghost", None, None, None, None, None, None, None, None, "g"]
    on_ghost = ["Cup", 1, 1, 1, 0, 0, 0, 0, 0, "c"]
    on_bed = ["Book", 1, 1, 1, 0, 0, 0, 0, 2, "d"]
    (scene,) = read(RECORD | {"objects": [ghost, on_ghost, RECORD["objects"][0], on_bed]})
    assert scene.types == ("Cup", "Bed", "Book")
    assert scene.parents.tolist() == [-1, -1, 1]  # the cup's parent is gone; the bed moved from 2 to 1


def test_a_scene_without_objects(read):
    (scene,) = read(RECORD | {"objects": []})
    assert (scene.boxes.shape, scene.yaws.shape, scene.parents.shape) == ((0, 6), (0,), (0,))


def test_numbers_that_are_null_become_those_typical_of_the_type(tmp_path):
    columns = ["type", "x", "y", "z", "sx", "sy", "sz", "yaw", "parent"]
    rows = [
        ["Fridge", 1.0, None, 2.0, None, None, None, None, None],
        ["Fridge", 1.0, 0.9, 2.0, 0.5, None, 0.6, 90, -1],
        ["Gizmo", 1.0, None, 2.0, None, None, None, 0, 0],
        ["Apple", None, None, None, None, None, None, None, -1],
    ]
    record = {**RECORD, "columns": columns, "objects": rows}
    scene = read_scenes(write_records(tmp_path / "null.jsonl.gz", record))[0]
    width, height, depth, y = typical_box("Fridge")
    assert scene.types == ("Fridge", "Fridge", "Gizmo")  # the apple has no place
    assert scene.boxes[0].tolist() == [1.0, y, 2.0, width, height, depth]
    assert scene.boxes[1].tolist() == [1.0, 0.9, 2.0, 0.5, height, 0.6]
    assert scene.boxes[2].tolist() == [1.0, UNKNOWN_BOX[3], 2.0, *UNKNOWN_BOX[:3]]
    assert typical_box("Stool") != typical_box("Chair")  # its own size before its alias's
    assert typical_box("couch") == typical_box("Sofa")


@given(st.integers(0, 2**32 - 1))
def test_written_scenes_read_back_equal(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    scenes = []
    for i in range(3):
        reach = rng.random((4, 6)) < 0.5
        reach[0, 0] = True
        scenes.append(
            Scene(
                name=f"küche {i}\n",
                world="wörld",
                room_type="kitchen",
                split="test",
                origin=(0.25 * int(rng.integers(-99, 99)), 0.25 * int(rng.integers(-99, 99))),
                reach=reach,
                walls=rng.random((4, 6)) < 0.5,
                types=("Bed", "Cup", "Cup")[:i],
                boxes=rng.uniform(0, 10, (i, 6)),
                yaws=rng.uniform(-180, 180, i),
                parents=np.arange(i) - 1,
            )
        )
    path = tmp_path_factory.getbasetemp() / "new folder" / "scenes.jsonl.gz"
    write_scenes(path, scenes)
    first = path.read_bytes()
    for written, back in zip(scenes, read_scenes(path), strict=True):
        assert_scenes_equal(written, back)
    write_scenes(path, scenes)
    assert path.read_bytes() == first  # no time stamp inside
    assert [p.name for p in path.parent.iterdir()] == ["scenes.jsonl.gz"]  # no temporary file left


def test_rooms_of_a_home_survive_the_file(tmp_path):
    record = {
        **RECORD,
        "rooms": [{"type": "kitchen", "cells": [".##", "###"]}, {"type": "hall", "cells": ["###", "..#"]}],
    }
    path = write_records(tmp_path / "home.jsonl.gz", record)
    scenes = read_scenes(path)
    assert [room.type for room in scenes[0].rooms] == ["kitchen", "hall"]
    assert np.argwhere(scenes[0].rooms[1].cells).tolist() == [[1, 0], [1, 1]]
    write_scenes(tmp_path / "again.jsonl.gz", scenes)
    assert_scenes_equal(read_scenes(tmp_path / "again.jsonl.gz")[0], scenes[0])


def test_a_failed_write_leaves_the_old_file(read, tmp_path):
    (scene,) = read(RECORD)
    path = tmp_path / "scenes.jsonl.gz"
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_scenes(path, [dataclasses.replace(scene, yaws=np.array([np.nan, 0.0]))])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_real_rooms(tmp_path):
    scenes = read_scenes(require(ITHOR))
    assert collections.Counter(s.split for s in scenes) == {"train": 80, "val": 20}
    assert collections.Counter(s.room_type for s in scenes) == dict.fromkeys(
        ("kitchen", "living_room", "bedroom", "bathroom"), 25
    )
    assert sum(len(s.types) for s in scenes) == 4586
    assert all(not (s.walls & s.reach).any() for s in scenes)
    with gzip.open(ITHOR) as file:
        raw = [json.loads(line) for line in file]
    for scene, record in zip(scenes, raw, strict=True):
        standable = {
            (iz, ix)
            for field in ("reach", "episode_starts")
            for iz, row in enumerate(record.get(field, []))
            for ix, character in enumerate(row)
            if character == "."
        }
        assert set(zip(*map(np.ndarray.tolist, np.nonzero(scene.reach)), strict=True)) == standable
    write_scenes(tmp_path / "copy.jsonl.gz", scenes)
    for scene, back in zip(scenes, read_scenes(tmp_path / "copy.jsonl.gz"), strict=True):
        assert_scenes_equal(scene, back)
