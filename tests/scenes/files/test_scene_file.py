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
def read_records(tmp_path):
    """Return a reader of scene records, which are written to a file first."""

    def read(*records: dict) -> list[Scene]:
        return read_scenes(write_records(tmp_path / "scenes.jsonl.gz", *records))

    return read


def test_read_scenes_reads_the_documented_fields(read_records):
    (scene,) = read_records(RECORD)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("den", "test", "bedroom", "val")
    assert scene.origin == (-1.0, 0.5)
    np.testing.assert_array_equal(scene.reach, [[True, True, False], [False, True, False]])
    assert scene.types == ("Bed", "Book")
    np.testing.assert_array_equal(scene.boxes, [[0.1, 0.3, 0.2, 1.5, 0.6, 2.0], [0.1, 0.65, 0.2, 0.2, 0.0, 0.3]])
    np.testing.assert_array_equal(scene.yaws, [90.0, 0.0])
    np.testing.assert_array_equal(scene.parents, [-1, 0])
    assert not scene.walls.any()  # no cell is three away from a standable one


def test_read_scenes_reads_optional_columns_and_masks(read_records):
    record = RECORD | {
        "columns": ["sz", "sy", "sx", "z", "y", "x", "type"],  # the order is that of the file
        "objects": [[6, 5, 4, 3, 2, 1, "Desk"]],
        "walls": ["..#", "..."],
        "episode_starts": ["#..", "###"],
        "unknown": {"kept": False},
    }
    (scene,) = read_records(record)
    np.testing.assert_array_equal(scene.boxes, [[1, 2, 3, 4, 5, 6]])
    assert (scene.yaws.tolist(), scene.parents.tolist()) == ([0.0], [-1])
    np.testing.assert_array_equal(scene.walls, [[False, False, True], [False, False, False]])
    np.testing.assert_array_equal(scene.reach, [[True, True, True], [False, True, False]])


def test_read_scenes_snaps_an_origin_slightly_off_the_lattice(read_records):
    (scene,) = read_records(RECORD | {"origin": [-1.018, 0.517]})
    assert scene.origin == (-1.0, 0.5)


def test_read_scenes_leaves_out_objects_without_a_position(read_records):
    unplaced_ghost = ["Ghost", None, None, None, None, None, None, None, None, "g"]
    on_ghost = ["Cup", 1, 1, 1, 0, 0, 0, 0, 0, "c"]
    on_bed = ["Book", 1, 1, 1, 0, 0, 0, 0, 2, "d"]
    (scene,) = read_records(RECORD | {"objects": [unplaced_ghost, on_ghost, RECORD["objects"][0], on_bed]})
    assert scene.types == ("Cup", "Bed", "Book")
    assert scene.parents.tolist() == [-1, -1, 1]  # the cup's parent is left out; the bed moved from 2 to 1


def test_read_scenes_accepts_a_scene_without_objects(read_records):
    (scene,) = read_records(RECORD | {"objects": []})
    assert (scene.boxes.shape, scene.yaws.shape, scene.parents.shape) == ((0, 6), (0,), (0,))


def test_read_scenes_replaces_null_numbers_by_typical_ones(read_records):
    column_names = ["type", "x", "y", "z", "sx", "sy", "sz", "yaw", "parent"]
    object_rows = [
        ["Fridge", 1.0, None, 2.0, None, None, None, None, None],
        ["Fridge", 1.0, 0.9, 2.0, 0.5, None, 0.6, 90, -1],
        ["Gizmo", 1.0, None, 2.0, None, None, None, 0, 0],
        ["Apple", None, None, None, None, None, None, None, -1],
    ]
    (scene,) = read_records(RECORD | {"columns": column_names, "objects": object_rows})

    # A number that is null is that of the type, or that of an unknown type.
    width, height, depth, y = typical_box("Fridge")
    assert scene.types == ("Fridge", "Fridge", "Gizmo")  # the apple has no place
    assert scene.boxes[0].tolist() == [1.0, y, 2.0, width, height, depth]
    assert scene.boxes[1].tolist() == [1.0, 0.9, 2.0, 0.5, height, 0.6]
    assert scene.boxes[2].tolist() == [1.0, UNKNOWN_BOX[3], 2.0, *UNKNOWN_BOX[:3]]

    # A type has its own size before its alias's.
    assert typical_box("Stool") != typical_box("Chair")
    assert typical_box("couch") == typical_box("Sofa")


def random_scene(rng: np.random.Generator, num_objects: int) -> Scene:
    """Return a scene of 4 x 6 cells with at most three objects, whose names are not ASCII."""
    reach = rng.random((4, 6)) < 0.5
    reach[0, 0] = True
    return Scene(
        name=f"küche {num_objects}\n",
        world="wörld",
        room_type="kitchen",
        split="test",
        origin=(0.25 * int(rng.integers(-99, 99)), 0.25 * int(rng.integers(-99, 99))),
        reach=reach,
        walls=rng.random((4, 6)) < 0.5,
        types=("Bed", "Cup", "Cup")[:num_objects],
        boxes=rng.uniform(0, 10, (num_objects, 6)),
        yaws=rng.uniform(-180, 180, num_objects),
        parents=np.arange(num_objects) - 1,
    )


@given(st.integers(0, 2**32 - 1))
def test_write_scenes_round_trips_with_reproducible_bytes(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    scenes = [random_scene(rng, num_objects) for num_objects in range(3)]
    scene_file = tmp_path_factory.getbasetemp() / "new folder" / "scenes.jsonl.gz"
    write_scenes(scene_file, scenes)
    for written_scene, scene_read in zip(scenes, read_scenes(scene_file), strict=True):
        assert_scenes_equal(written_scene, scene_read)

    # The bytes depend on the scenes alone, and no temporary file remains.
    first_bytes = scene_file.read_bytes()
    write_scenes(scene_file, scenes)
    assert scene_file.read_bytes() == first_bytes
    assert [file.name for file in scene_file.parent.iterdir()] == ["scenes.jsonl.gz"]


def test_write_scenes_round_trips_rooms_of_a_home(tmp_path):
    kitchen = {"type": "kitchen", "cells": [".##", "###"]}
    hall = {"type": "hall", "cells": ["###", "..#"]}
    scenes = read_scenes(write_records(tmp_path / "home.jsonl.gz", RECORD | {"rooms": [kitchen, hall]}))
    assert [room.type for room in scenes[0].rooms] == ["kitchen", "hall"]
    assert np.argwhere(scenes[0].rooms[1].cells).tolist() == [[1, 0], [1, 1]]
    write_scenes(tmp_path / "again.jsonl.gz", scenes)
    assert_scenes_equal(read_scenes(tmp_path / "again.jsonl.gz")[0], scenes[0])


def test_write_scenes_keeps_the_old_file_when_it_fails(read_records, tmp_path):
    (scene,) = read_records(RECORD)
    scene_file = tmp_path / "scenes.jsonl.gz"
    bytes_before = scene_file.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        write_scenes(scene_file, [dataclasses.replace(scene, yaws=np.array([np.nan, 0.0]))])
    assert scene_file.read_bytes() == bytes_before
    assert list(tmp_path.iterdir()) == [scene_file]


def free_cells(record: dict, field: str) -> np.ndarray:
    """Return the cells marked `.` in a mask of a record, bool [H, W]; none without the mask."""
    if field not in record:
        return np.zeros(record["shape"], bool)
    return np.array([list(row) for row in record[field]]) == "."


def test_read_scenes_reads_the_real_ithor_rooms(tmp_path):
    scenes = read_scenes(require(ITHOR))
    assert collections.Counter(scene.split for scene in scenes) == {"train": 80, "val": 20}
    room_types = ("kitchen", "living_room", "bedroom", "bathroom")
    assert collections.Counter(scene.room_type for scene in scenes) == dict.fromkeys(room_types, 25)
    assert sum(len(scene.types) for scene in scenes) == 4586
    assert all(not (scene.walls & scene.reach).any() for scene in scenes)

    # Standable cells are those of either mask in the file.
    with gzip.open(ITHOR) as file:
        records = [json.loads(line) for line in file]
    for scene, record in zip(scenes, records, strict=True):
        np.testing.assert_array_equal(scene.reach, free_cells(record, "reach") | free_cells(record, "episode_starts"))

    # The scenes survive a copy of the file.
    write_scenes(tmp_path / "copy.jsonl.gz", scenes)
    for scene, copied_scene in zip(scenes, read_scenes(tmp_path / "copy.jsonl.gz"), strict=True):
        assert_scenes_equal(scene, copied_scene)
