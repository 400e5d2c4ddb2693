"""Refusals of unusable AI2-THOR metadata."""

import collections
import gzip
import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from support.importer_inputs.ai2thor import METADATA, PLACES, vector
from support.mutations import changed, mutated, mutated_text, without
from support.real_scenes import INPUTS, require
from support.refusals import assert_message_names
from support.scene_records import as_scene, check_outcomes, without_counts

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.scene import Scene


@pytest.mark.parametrize(
    ("record", "field_name", "remedy"),
    [
        (without(METADATA, "sceneName"), "sceneName", "add it"),
        (without(METADATA, "objects"), "objects", "add it"),
        (
            without(METADATA, "actionReturn"),
            "actionReturn",
            "save event.metadata right after GetReachablePositions",
        ),
        (
            changed(METADATA, "actionReturn", []),
            "actionReturn",
            "save event.metadata right after GetReachablePositions",
        ),
        (changed(METADATA, "actionReturn", True), "actionReturn", "give a list"),
        (changed(METADATA, "actionReturn", 4, 7), "actionReturn[4]", "give a JSON object"),
        (changed(METADATA, "actionReturn", 4, "x", float("nan")), "actionReturn[4]: x", "finite number"),
        (
            changed(METADATA, "actionReturn", 4, "z", 0.1),
            "actionReturn",
            "multiples of 0.25",
        ),
        (changed(METADATA, "actionReturn", 4, "x", 1e5), "actionReturn", "give one scene at a time"),
        (changed(METADATA, "objects", []), "objects", "give at least one"),
        (changed(METADATA, "objects", METADATA["objects"][:1]), "objects", "give at least one"),  # the floor is none
        (changed(METADATA, "objects", "none"), "objects", "give a list"),
        (changed(METADATA, "objects", 1, None), "objects[1]", "give a JSON object"),
        (without(METADATA, "objects", 1, "objectId"), "objects[1]: objectId", "add it"),
        (without(METADATA, "objects", 1, "objectType"), "objects[1]: objectType", "add it"),
        (without(METADATA, "objects", 1, "rotation"), "objects[1]: rotation", "add it"),
        (without(METADATA, "objects", 3, "position"), "objects[3]: position", "add it"),
        (
            changed(METADATA, "objects", 1, "rotation", "y", None),
            "objects[1]: rotation: y",
            "give the number or leave the object out",
        ),
        (
            changed(METADATA, "objects", 1, "axisAlignedBoundingBox", "center", "y", float("inf")),
            "objects[1]: axisAlignedBoundingBox: center: y",
            "finite number",
        ),
        (without(METADATA, "objects", 1, "axisAlignedBoundingBox", "size"), "axisAlignedBoundingBox: size", "add it"),
        (
            changed(METADATA, "objects", 1, "axisAlignedBoundingBox", "size", "x", -1.0),
            "objects[1]: axisAlignedBoundingBox",
            "of at least 0",
        ),
        (
            changed(METADATA, "objects", 3, "bounds3D", [0.0, 1.0]),
            "objects[3]: bounds3D",
            "give a list of 6",
        ),
        (
            changed(METADATA, "objects", 3, "bounds3D", [0, 0, 0, -1, 1, 1]),
            "objects[3]: bounds3D",
            "of at least 0",
        ),
        (
            changed(METADATA, "objects", 3, "parentReceptacles", "Shelf"),
            "objects[3]: parentReceptacles",
            "give a list",
        ),
        ({"metadata": 3}, "metadata", "give a JSON object"),
        ([METADATA], "record", "give a JSON object"),
    ],
)
def test_read_ai2thor_refuses_bad_records_naming_scene_field_and_remedy(
    tmp_path, read_metadata, record, field_name, remedy
):
    error = read_metadata(record)
    assert isinstance(error, InputError)
    assert str(error).startswith(str(tmp_path / "room.json"))
    scene_name = "scene 'FloorPlan201_physics'" if "sceneName" in record else ""
    assert_message_names(error, scene_name, f"{field_name} ", remedy)


def test_read_ai2thor_imports_all_good_records_of_a_file(tmp_path):
    metadata_file = tmp_path / "rooms.jsonl.gz"
    records = [METADATA, without(METADATA, "objects"), changed(METADATA, "sceneName", "FloorPlan2")]
    lines = [json.dumps(record) for record in records]
    metadata_file.write_bytes(gzip.compress("\n".join([*lines, '{"sceneName": "Flo']).encode()))
    first_scene, bad_record, second_scene, torn_line = without_counts(read_ai2thor(metadata_file, "train"))
    assert (as_scene(first_scene).name, as_scene(second_scene).name) == ("FloorPlan201", "FloorPlan2")
    assert_message_names(bad_record, f"{metadata_file}, line 2, scene 'FloorPlan201_physics': objects ", "add it")
    assert_message_names(torn_line, f"{metadata_file}, line 4: not JSON")


def grid_positions(steps: range, spacing: float) -> list[dict[str, float]]:
    """Return the positions of a square grid."""
    return [vector(spacing * i, 1.15, spacing * j) for i in steps for j in steps]


@pytest.mark.parametrize(("spacing", "num_steps"), [(0.5, 5), (0.5, 2), (0.75, 4), (1.0, 3)])
def test_read_ai2thor_refuses_grids_of_another_spacing(read_metadata, spacing, num_steps):
    positions = grid_positions(range(num_steps), spacing)
    for extra_positions in ([], grid_positions(range(2), 0.25)):
        if num_steps**2 > 4 * len(extra_positions):
            error = read_metadata(changed(METADATA, "actionReturn", [*positions, *extra_positions]))
            assert_message_names(error, "actionReturn has positions", f"{spacing:g} m apart", "0.25 m", "gridSize")


def test_read_ai2thor_imports_grids_with_gaps(read_metadata):
    # A single position, a diagonal, and two rooms with places of their own.
    diagonal = [vector(0.25 * i, 1.15, 0.25 * i) for i in range(4)]
    far_room = [vector(position["x"] + 5.0, 1.15, position["z"]) for position in PLACES]
    for positions in (PLACES[:1], diagonal, PLACES + far_room, [*PLACES, vector(3.0, 1.15, 3.0)]):
        scene = as_scene(read_metadata(changed(METADATA, "actionReturn", positions)))
        assert scene.reach.sum() == len(positions)


def test_read_ai2thor_refuses_the_grid_of_an_earlier_report():
    (error,) = without_counts(read_ai2thor(require(INPUTS / "a02_grid_half.json"), "train"))
    assert_message_names(error, "scene 'FloorPlan201_physics': actionReturn ", "0.5 m apart", "grid of 0.25 m")


def test_read_ai2thor_imports_all_good_files_of_a_folder(tmp_path):
    (tmp_path / "b.json").write_text(json.dumps(METADATA))
    (tmp_path / "a.json.gz").write_bytes(gzip.compress(json.dumps(METADATA).encode())[:-20])
    (tmp_path / "c.pkl").write_bytes(b"not opened")
    cut_file, scene = without_counts(read_ai2thor(tmp_path, "train"))
    assert_message_names(cut_file, "a.json.gz: ", "cut short")
    assert as_scene(scene).name == "FloorPlan201"


@pytest.mark.parametrize(
    ("file_name", "expected_part"),
    [("none.json", "cannot be read"), ("empty.jsonl", "no record"), ("folder", r"no file \.json,")],
)
def test_read_ai2thor_refuses_paths_without_a_record(tmp_path, file_name, expected_part):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.jsonl").touch()
    with pytest.raises(InputError, match=rf"{file_name}.*{expected_part}"):
        list(read_ai2thor(tmp_path / file_name, "train"))


def refusal_message(metadata_file: Path) -> str:
    """Return the message of the only refusal of a file, which is raised or among the results."""
    try:
        (result,) = without_counts(read_ai2thor(metadata_file, "train"))
    except InputError as error:
        return str(error)
    assert isinstance(result, InputError)
    return str(result)


def test_read_ai2thor_refuses_files_cut_short_anywhere(tmp_path):
    file_bytes = gzip.compress(json.dumps(METADATA).encode(), mtime=0)
    metadata_file = tmp_path / "room.json.gz"
    for length in range(0, len(file_bytes), 7):
        metadata_file.write_bytes(file_bytes[:length])
        assert re.search("cut short|not JSON", refusal_message(metadata_file))


def test_read_ai2thor_imports_or_refuses_mutated_records(tmp_path):
    outcomes = collections.Counter()
    metadata_file = tmp_path / "rooms.jsonl"

    @given(mutated(METADATA))
    def check_import(record):
        metadata_file.write_text(json.dumps(record) + "\n" + json.dumps(METADATA))
        results = without_counts(read_ai2thor(metadata_file, "train"))
        check_outcomes(results[:1], outcomes, metadata_file)
        assert isinstance(results[1], Scene)

    check_import()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_read_ai2thor_imports_or_refuses_mutated_text(tmp_path):
    outcomes = collections.Counter()
    metadata_file = tmp_path / "room.json"

    @given(mutated_text(json.dumps(METADATA)))
    def check_import(file_text):
        metadata_file.write_text(file_text)
        check_outcomes(without_counts(read_ai2thor(metadata_file, "train")), outcomes, metadata_file)

    check_import()
    assert outcomes[InputError] >= 10


@pytest.mark.parametrize(
    "file_text", ["[" * 100_000, '{"objects":' * 900 + "1" + "}" * 900, '{"sceneName": "\\ud800"}', ""]
)
def test_read_ai2thor_refuses_strange_texts(tmp_path, file_text):
    metadata_file = tmp_path / "room.json"
    metadata_file.write_text(file_text)
    (result,) = without_counts(read_ai2thor(metadata_file, "train"))
    assert isinstance(result, InputError)
