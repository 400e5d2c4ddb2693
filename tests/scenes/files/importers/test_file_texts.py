"""Tests that all importers accept blank lines, byte order marks, hidden files and both forms of boxes."""

import codecs
import gzip
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.importer_inputs.ai2thor import METADATA, TABLE
from support.importer_inputs.habitat import EPISODES, write_json
from support.importer_inputs.procthor import ASSETS, HOUSE, point
from support.importer_inputs.scene_data import FILES
from support.mutations import changed
from support.real_scenes import INPUTS, require
from support.scene_records import RECORD, assert_scenes_equal, scenes_and_errors

from jaxnav.scenes.files.importers.ai2thor import read_replacements
from jaxnav.scenes.files.importing import SceneFormat, read_source

#: Two documents of each format that stores one document a line.
DOCUMENTS: dict[SceneFormat, list[object]] = {
    "procthor": [HOUSE, HOUSE],
    "ai2thor": [METADATA, METADATA | {"sceneName": "FloorPlan202_physics"}],
    "scenes": [RECORD, RECORD | {"name": "other"}],
}
BLANK_LINES = ("", "  \t", "\r\n")


def scene_names(scene_format: SceneFormat, path: Path) -> list[str]:
    """Names of the scenes of a file that is read without an error."""
    scenes, errors = scenes_and_errors(read_source(scene_format, str(path)))
    assert not errors
    return [scene.name for scene in scenes]


def marked_contents(documents: list[object]) -> Iterator[tuple[str, bytes]]:
    """Yield contents of the documents, one a line, with blank lines or byte order marks at different places."""
    texts = [json.dumps(document) for document in documents]
    for blank in BLANK_LINES:
        yield f"blank {blank!r} before", "\n".join([blank, *texts]).encode()
        yield f"blank {blank!r} between", f"\n{blank}\n".join(texts).encode()
        yield f"blank {blank!r} after", "\n".join([*texts, blank, ""]).encode()
    yield "mark", codecs.BOM_UTF8 + "\n".join(texts).encode()
    yield "mark and blank", codecs.BOM_UTF8 + "\n".join(["", *texts, ""]).encode()
    yield "joined files with marks", b"".join(codecs.BOM_UTF8 + text.encode() + b"\r\n" for text in texts)


@pytest.mark.parametrize("scene_format", DOCUMENTS)
@pytest.mark.parametrize("compress", [bytes, gzip.compress])
def test_importers_skip_blank_lines_and_byte_order_marks(tmp_path, scene_format, compress):
    source = tmp_path / ("scenes.jsonl" if compress is bytes else "scenes.jsonl.gz")
    documents = DOCUMENTS[scene_format]
    source.write_bytes(compress("\n".join(map(json.dumps, documents)).encode()))
    expected_names = scene_names(scene_format, source)
    assert len(expected_names) == 2

    # Blank lines and marks change nothing.
    for description, content in marked_contents(documents):
        source.write_bytes(compress(content))
        assert scene_names(scene_format, source) == expected_names, description


def test_replacements_and_their_rooms_may_have_blank_lines(tmp_path):
    replacements = {"name": "den", "columns": ["type", "x", "y", "z"], "sets": [[["Book", 0.0, 1.0, 0.0]]]}
    documents = {"sets.jsonl": replacements, "base.jsonl": RECORD}
    for name, document in documents.items():
        (tmp_path / name).write_bytes(codecs.BOM_UTF8 + f"\n{json.dumps(document)}\n\n".encode())
    scenes, errors = scenes_and_errors(read_replacements(tmp_path / "sets.jsonl", tmp_path / "base.jsonl"))
    assert not errors
    assert [scene.name for scene in scenes] == ["den-replaced-0"]


@pytest.mark.parametrize("indent", [None, 1])
def test_importers_skip_the_byte_order_mark_of_one_document(tmp_path, indent):
    # Formats of one file.
    contents: dict[SceneFormat, object] = {"procthor": HOUSE, "ai2thor": METADATA, "habitat": EPISODES}
    for scene_format, content in contents.items():
        source = tmp_path / f"{scene_format}.json"
        source.write_bytes(codecs.BOM_UTF8 + json.dumps(content, indent=indent).encode())
        assert scene_names(scene_format, source)

    # A format of a folder, in which every file has a mark.
    folder = tmp_path / "FloorPlan401"
    folder.mkdir()
    for name, content in FILES.items():
        (folder / name).write_bytes(codecs.BOM_UTF8 + json.dumps(content, indent=indent).encode())
    assert scene_names("scene-data", folder) == ["FloorPlan401"]

    # An asset database, which gives the first object its size.
    asset_file = tmp_path / "assets.json"
    asset_file.write_bytes(codecs.BOM_UTF8 + json.dumps(ASSETS, indent=indent).encode())
    scenes, _ = scenes_and_errors(read_source("procthor", str(tmp_path / "procthor.json"), assets=asset_file))
    assert scenes[0].boxes[0, 3:].tolist() == pytest.approx([0.6, 0.8, 1.0])


def test_importers_of_folders_skip_hidden_files(tmp_path):
    # An archive of macOS has a file `._NAME` for each file and folder NAME.
    resource_fork = b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X"
    metadata_folder = tmp_path / "metadata"
    metadata_folder.mkdir()
    (metadata_folder / "room.json").write_text(json.dumps(METADATA))
    (metadata_folder / "._room.json").write_bytes(resource_fork)
    assert scene_names("ai2thor", metadata_folder) == ["FloorPlan201"]

    # A folder of episodes.
    write_json(tmp_path / "val" / "content" / "Home.json.gz", EPISODES)
    (tmp_path / "val" / "content" / "._Home.json.gz").write_bytes(resource_fork)
    assert scene_names("habitat", tmp_path / "val") == ["Home_floor0", "Home_floor1"]

    # Hidden folders are skipped even if they hold complete scenes.
    for folder_name in ("FloorPlan401", "._FloorPlan401", ".cache"):
        folder = tmp_path / "Scene_Data" / folder_name
        folder.mkdir(parents=True)
        for name, content in FILES.items():
            (folder / name).write_text(json.dumps(content))
    assert scene_names("scene-data", tmp_path / "Scene_Data") == ["FloorPlan401"]


def test_boxes_may_be_given_by_their_corners(tmp_path, house_scene, read_metadata):
    # In an asset database only the size of a box counts: the table is 1.0 x 0.8 x 0.6 m.
    corners = {"min": point(-0.25, 0.0, -0.1), "max": point(0.75, 0.8, 0.5)}
    centre_and_size = {"center": point(0, 0.4, 0), "size": point(1.0, 0.8, 0.6)}
    for box in (corners, centre_and_size):
        table_asset = {"Dining_Table_27_1": {"objectType": "DiningTable", "boundingBox": box}}
        scene = house_scene(HOUSE, ASSETS | table_asset)
        np.testing.assert_allclose(scene.boxes, house_scene(HOUSE).boxes)

    # In metadata the table spans x 1 to 2, y 0.25 to 1.05 and z -0.6 to 0.6.
    box = {"min": point(1.0, 0.25, -0.6), "max": point(2.0, 1.05, 0.6)}
    record = changed(METADATA, "objects", [TABLE | {"axisAlignedBoundingBox": box}])
    assert_scenes_equal(read_metadata(record), read_metadata(changed(METADATA, "objects", [TABLE])))


@pytest.mark.parametrize(
    ("box", "field"),
    [({"min": point(0, 0, 0)}, "max"), ({"min": point(1, 1, 1), "max": point(0, 2, 2)}, "of at least 0")],
)
def test_boxes_with_bad_corners_are_refused(read_metadata, box, field):
    error = read_metadata(changed(METADATA, "objects", [TABLE | {"axisAlignedBoundingBox": box}]))
    assert field in str(error)


@pytest.mark.parametrize(
    ("file_name", "scene_format", "expected_names"),
    [
        ("e02_bom.json", "procthor", ["e02_bom-0"]),
        ("e05_blank_line.jsonl", "ai2thor", ["FloorPlan201", "FloorPlan202"]),
        ("e06_blank_line.jsonl", "procthor", ["e06_blank_line-0", "e06_blank_line-1"]),
        ("e15_blank_lines.jsonl", "scenes", ["e06_blank_line-0", "e06_blank_line-1"]),
    ],
)
def test_importers_read_the_files_of_earlier_reports(file_name, scene_format, expected_names):
    assert scene_names(scene_format, require(INPUTS / file_name)) == expected_names
