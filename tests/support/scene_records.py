"""Scene files of a few records, and checks of the scenes that are read or imported."""

import collections
import dataclasses
import gzip
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.account import ImportCount
from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.scene import Scene

RECORD: dict[str, Any] = {
    "name": "den",
    "world": "test",
    "room_type": "bedroom",
    "split": "val",
    "cell": 0.25,
    "origin": [-1.0, 0.5],
    "shape": [2, 3],
    "reach": ["..#", "#.#"],
    "columns": ["type", "x", "y", "z", "sx", "sy", "sz", "yaw", "parent", "id"],
    "objects": [["Bed", 0.1, 0.3, 0.2, 1.5, 0.6, 2, 90, -1, "a"], ["Book", 0.1, 0.65, 0.2, 0.2, 0, 0.3, 0, 0, "b"]],
}


def write_records(path: Path, *records: object) -> Path:
    """Write a scene file, one record a line."""
    path.write_bytes(gzip.compress("".join(json.dumps(record) + "\n" for record in records).encode()))
    return path


def as_scene(result: Scene | InputError) -> Scene:
    """Check that a result is a scene, and return it."""
    assert isinstance(result, Scene), result
    return result


def without_counts(results: Iterable[Any]) -> list[Any]:
    """Return the results of an importer without the counts of what it read."""
    return [result for result in results if not isinstance(result, ImportCount)]


def scenes_and_errors(
    results: Iterable[Scene | InputError | ImportNote | ImportCount],
) -> tuple[list[Scene], list[str]]:
    """Return the scenes among results, and the errors' messages."""
    scenes = []
    messages = []
    for result in results:
        if isinstance(result, Scene):
            scenes.append(result)
        elif isinstance(result, InputError):
            messages.append(str(result))
    return scenes, messages


def assert_scenes_equal(result: Scene | InputError, expected: Scene | InputError) -> None:
    """Check that two scenes are equal, types and dtypes included."""
    scene = as_scene(result)
    expected_scene = as_scene(expected)
    for field in dataclasses.fields(Scene):
        value = getattr(scene, field.name)
        expected_value = getattr(expected_scene, field.name)
        assert type(value) is type(expected_value), field.name
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, expected_value, field.name, strict=True)
        elif field.name != "rooms":
            assert value == expected_value, field.name

    # Rooms hold arrays, which have no equality.
    assert [room.type for room in scene.rooms] == [room.type for room in expected_scene.rooms]
    for room, expected_room in zip(scene.rooms, expected_scene.rooms, strict=True):
        np.testing.assert_array_equal(room.cells, expected_room.cells, strict=True)


def check_outcomes(
    results: Iterable[Scene | InputError | ImportNote | ImportCount], outcomes: collections.Counter[type], path: Path
) -> None:
    """Check that each scene can be written and read, and that each error names its file; count results by type."""
    scene_file = path.parent / "fuzzed.jsonl.gz"
    for result in results:
        outcomes[type(result)] += 1
        if isinstance(result, ImportNote):
            assert result.number > 0
        elif isinstance(result, ImportCount):
            assert min(result.num_read, result.num_added, result.num_kept) >= 0
            assert all(count >= 0 for count in result.skipped.values())
        elif isinstance(result, InputError):
            assert str(result).startswith(str(path))
        else:
            write_scenes(scene_file, [result])
            assert_scenes_equal(read_scenes(scene_file)[0], result)
