"""Controller metadata that cannot be used."""

import collections
import gzip
import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from support.importer_inputs.ai2thor import METADATA
from support.mutations import changed, mutated, mutated_text, without
from support.scene_records import as_scene, check_outcomes

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.scene import Scene


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        (without(METADATA, "sceneName"), "scene '(no name)': sceneName is missing"),
        (without(METADATA, "objects"), "objects is missing"),
        (
            without(METADATA, "actionReturn"),
            "actionReturn has no positions; save event.metadata right after GetReachable",
        ),
        (changed(METADATA, "actionReturn", []), "actionReturn has no positions"),
        (changed(METADATA, "actionReturn", True), "actionReturn is True; give a list"),
        (changed(METADATA, "actionReturn", 4, 7), "actionReturn[4] is 7; give an object"),
        (changed(METADATA, "actionReturn", 4, "x", float("nan")), "actionReturn[4]: x is nan; give a finite number"),
        (
            changed(METADATA, "actionReturn", 4, "z", 0.1),
            "actionReturn holds [0.25, 0.1]; x and z must be multiples of 0.25",
        ),
        (changed(METADATA, "actionReturn", 4, "x", 1e5), "actionReturn spans more than 500 m"),
        (changed(METADATA, "objects", []), "objects holds no object"),
        (changed(METADATA, "objects", METADATA["objects"][:1]), "objects holds no object"),  # the floor is none
        (changed(METADATA, "objects", "none"), "objects is 'none'; give a list"),
        (changed(METADATA, "objects", 1, None), "objects[1] is None; give an object"),
        (without(METADATA, "objects", 1, "objectId"), "objects[1]: objectId is missing"),
        (without(METADATA, "objects", 1, "objectType"), "objects[1]: objectType is missing"),
        (without(METADATA, "objects", 1, "rotation"), "objects[1]: rotation is missing"),
        (without(METADATA, "objects", 3, "position"), "objects[3]: position is missing"),
        (changed(METADATA, "objects", 1, "rotation", "y", None), "objects[1]: rotation: y is null"),
        (
            changed(METADATA, "objects", 1, "axisAlignedBoundingBox", "center", "y", float("inf")),
            "objects[1]: axisAlignedBoundingBox: center: y is inf",
        ),
        (without(METADATA, "objects", 1, "axisAlignedBoundingBox", "size"), "axisAlignedBoundingBox: size is missing"),
        (
            changed(METADATA, "objects", 1, "axisAlignedBoundingBox", "size", "x", -1.0),
            "objects[1]: axisAlignedBoundingBox has the size [-1.0, 0.8, 1.2]; a size is at least 0",
        ),
        (
            changed(METADATA, "objects", 3, "bounds3D", [0.0, 1.0]),
            "objects[3]: bounds3D is [0.0, 1.0]; give a list of 6",
        ),
        (
            changed(METADATA, "objects", 3, "bounds3D", [0, 0, 0, -1, 1, 1]),
            "objects[3]: bounds3D has the size [-1.0, 1.0, 1.0]",
        ),
        (
            changed(METADATA, "objects", 3, "parentReceptacles", "Shelf"),
            "objects[3]: parentReceptacles is 'Shelf'; give a list",
        ),
        ({"metadata": 3}, "metadata is 3; give an object"),
        ([METADATA], "give an object"),
    ],
)
def test_bad_records_are_refused_with_their_place(tmp_path, read_metadata, record, problem):
    result = read_metadata(record)
    assert isinstance(result, InputError)
    assert str(result).startswith(str(tmp_path / "room.json"))
    assert problem in str(result)
    if isinstance(record, dict) and "sceneName" in record:
        assert "scene 'FloorPlan201_physics'" in str(result)


def test_the_other_records_of_a_file_are_imported(tmp_path):
    path = tmp_path / "rooms.jsonl.gz"
    lines = [
        json.dumps(record)
        for record in (METADATA, without(METADATA, "objects"), changed(METADATA, "sceneName", "FloorPlan2"))
    ]
    path.write_bytes(gzip.compress("\n".join([*lines, '{"sceneName": "Flo']).encode()))
    first, second, third, last = read_ai2thor(path, "train")
    assert (as_scene(first).name, as_scene(third).name) == ("FloorPlan201", "FloorPlan2")
    assert str(second) == f"{path}, line 2, scene 'FloorPlan201_physics': objects is missing; add it"
    assert str(last).startswith(f"{path}, line 4: not JSON")


def test_the_other_files_of_a_folder_are_imported(tmp_path):
    (tmp_path / "b.json").write_text(json.dumps(METADATA))
    (tmp_path / "a.json.gz").write_bytes(gzip.compress(json.dumps(METADATA).encode())[:-20])
    (tmp_path / "c.pkl").write_bytes(b"not opened")
    broken, scene = read_ai2thor(tmp_path, "train")
    assert "a.json.gz: is cut short or damaged" in str(broken)
    assert as_scene(scene).name == "FloorPlan201"


def test_paths_without_any_record_are_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.jsonl").touch()
    for name, problem in {
        "none.json": "cannot be read",
        "empty.jsonl": "no record",
        "folder": "no file .json,",
    }.items():
        with pytest.raises(InputError, match=problem):
            list(read_ai2thor(tmp_path / name, "train"))


def refusal_of(path: Path) -> str:
    """Return the message of an error, raised or given."""
    try:
        (result,) = read_ai2thor(path, "train")
    except InputError as error:
        return str(error)
    assert isinstance(result, InputError)
    return str(result)


def test_files_that_end_anywhere_are_refused(tmp_path):
    content = gzip.compress(json.dumps(METADATA).encode(), mtime=0)
    path = tmp_path / "room.json.gz"
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        assert re.search("cut short|not JSON", refusal_of(path))


def test_mutated_records_are_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "rooms.jsonl"

    @given(mutated(METADATA))
    def check(record):
        path.write_text(json.dumps(record) + "\n" + json.dumps(METADATA))
        results = list(read_ai2thor(path, "train"))
        check_outcomes(results[:1], outcomes, path)
        assert isinstance(results[1], Scene)

    check()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_mutated_text_is_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "room.json"

    @given(mutated_text(json.dumps(METADATA)))
    def check(text):
        path.write_text(text)
        check_outcomes(list(read_ai2thor(path, "train")), outcomes, path)

    check()
    assert outcomes[InputError] >= 10


@pytest.mark.parametrize("text", ["[" * 100_000, '{"objects":' * 900 + "1" + "}" * 900, '{"sceneName": "\\ud800"}', ""])
def test_strange_texts_are_refused(tmp_path, text):
    path = tmp_path / "room.json"
    path.write_text(text)
    (result,) = read_ai2thor(path, "train")
    assert isinstance(result, InputError)
