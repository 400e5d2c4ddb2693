"""Scene files of a few records, and comparisons of scenes."""

import collections
import dataclasses
import gzip
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
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
    path.write_bytes(gzip.compress("".join(json.dumps(r) + "\n" for r in records).encode()))
    return path


def as_scene(result: Scene | InputError) -> Scene:
    """Return a result that must be a scene."""
    assert isinstance(result, Scene), result
    return result


def scenes_and_errors(results: Iterable[Scene | InputError | ImportNote]) -> tuple[list[Scene], list[str]]:
    """Return the scenes among results, and the errors' messages."""
    results = list(results)
    return [r for r in results if isinstance(r, Scene)], [str(r) for r in results if isinstance(r, InputError)]


def assert_scenes_equal(a: Scene | InputError, b: Scene | InputError) -> None:
    """Check that two scenes are equal, types and dtypes included."""
    a, b = as_scene(a), as_scene(b)
    for field in dataclasses.fields(Scene):
        a_value = getattr(a, field.name)
        b_value = getattr(b, field.name)
        assert type(a_value) is type(b_value), field.name
        if isinstance(a_value, np.ndarray):
            np.testing.assert_array_equal(a_value, b_value, field.name, strict=True)
        elif field.name != "rooms":
            assert a_value == b_value, field.name
    assert [room.type for room in a.rooms] == [room.type for room in b.rooms]
    for one, other in zip(a.rooms, b.rooms, strict=True):
        np.testing.assert_array_equal(one.cells, other.cells, strict=True)


def check_outcomes(
    results: Iterable[Scene | InputError | ImportNote], outcomes: collections.Counter[type], path: Path
) -> None:
    """Check that results are storable scenes or named errors.

    A scene file can hold the scenes, and errors name their file. They are counted by type.
    """
    for result in results:
        outcomes[type(result)] += 1
        if isinstance(result, ImportNote):
            assert result.number > 0
        elif isinstance(result, InputError):
            assert str(result).startswith(str(path))
        else:
            write_scenes(path.parent / "fuzzed.jsonl.gz", [result])
            assert_scenes_equal(read_scenes(path.parent / "fuzzed.jsonl.gz")[0], result)
