"""Refusals of unusable ProcTHOR files."""

import collections
import gzip
import itertools
import json

import pytest
from hypothesis import given
from support.importer_inputs.procthor import ASSETS, BOWL, HOUSE, TABLE, point
from support.mutations import changed, mutated, mutated_text, without
from support.refusals import assert_message_names
from support.scene_records import assert_scenes_equal, check_outcomes, scenes_and_errors

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.scene import Scene

NAN = float("nan")
CROSSED = [point(x, 0, z) for x, z in [(0, 0), (3, 3), (3, 0), (0, 3)]]
#: A wall that runs along neither axis.
DIAGONAL = [point(x, y, x) for y, x in itertools.product((0, 3), repeat=2)]
#: A table that fills the house.
HUGE_TABLE = TABLE | {"position": point(3, 0.4, 1.5), "assetId": "Hall"}


def with_agent_at(position):
    return changed(HOUSE, "metadata", "agent", "position", position)


BAD = [
    (3, "'house-0'", "give a JSON object"),
    (without(HOUSE, "rooms"), "rooms", "add it"),
    (without(HOUSE, "walls"), "walls", "add it"),
    (without(HOUSE, "doors"), "doors", "add it"),
    (without(HOUSE, "objects"), "objects", "add it"),
    (without(HOUSE, "doors", 0, "holePolygon"), "doors[0]: holePolygon", "add it"),
    (without(HOUSE, "rooms", 0, "roomType"), "rooms[0]: roomType", "add it"),
    (without(HOUSE, "walls", 2, "polygon", 1, "z"), "walls[2]: polygon[1]: z", "add it"),
    (without(HOUSE, "objects", 0, "children", 0, "position"), "objects[0].children[0]: position", "add it"),
    (without(HOUSE, "objects", 0, "children", 0, "rotation"), "objects[0].children[0]: rotation", "add it"),
    (changed(HOUSE, "rooms", []), "rooms", "give at least one"),
    (changed(HOUSE, "objects", []), "objects", "give at least one object to look for"),
    (changed(HOUSE, "rooms", 1, "floorPolygon", CROSSED), "rooms[1]: floorPolygon", "give the corners once around"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", CROSSED[:2]), "rooms[0]: floorPolygon", "give 3 to 1000"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", CROSSED * 300), "rooms[0]: floorPolygon", "give 3 to 1000"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", 0, "x", -495.0), "rooms", "give one house at a time"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", 0, "x", NAN), "floorPolygon[0]: x", "finite number"),
    (changed(HOUSE, "walls", 0, "polygon", 0, "x", 1.0), "walls[0]: polygon", "give an upright rectangle along x or z"),
    (changed(HOUSE, "walls", 0, "polygon", DIAGONAL), "walls[0]: polygon", "give an upright rectangle along x or z"),
    (changed(HOUSE, "doors", 0, "wall0", "wall|9"), "doors[0]: wall0", "give the id of one it has"),
    (changed(HOUSE, "doors", 0, "wall1", "wall|9"), "doors[0]: wall1", "give the id of one it has"),
    (changed(HOUSE, "doors", 0, "room1", "room|9"), "doors[0]: room1", "give the id of one it has"),
    (changed(HOUSE, "doors", 0, "holePolygon", 1, "x", 3.1), "doors[0]: holePolygon", "in its wall, 0 to 3"),
    (changed(HOUSE, "doors", 0, "holePolygon", 0, "x", 2.0), "doors[0]: holePolygon", "in its wall, 0 to 3"),
    (changed(HOUSE, "doors", 0, "openness", "wide"), "doors[0]: openness", "finite number"),
    (changed(HOUSE, "objects", 0, "position", "y", NAN), "objects[0]: position: y", "finite number"),
    (changed(HOUSE, "objects", 0, "children", 0, BOWL | {"objectType": 5}), "objectType", "give a string"),
    (changed(HOUSE, "objects", 0, HUGE_TABLE), "rooms", "leave the house out"),
]
BAD_AGENTS = [
    (without(HOUSE, "metadata", "agent"), "metadata: agent", "add it"),
    (changed(HOUSE, "metadata", "agent", "position", "x", 4.9), "metadata: agent: position", "multiples of 0.25"),
    # Three cells from the floor, and far from it.
    (with_agent_at(point(4.5, 0.9, 3.5)), "metadata: agent: position", "put it on free floor"),
    (with_agent_at(point(-500, 0.9, 1.5)), "metadata: agent: position", "put it on free floor"),
]


@pytest.mark.parametrize(("house", "field_name", "remedy"), BAD)
def test_read_procthor_refuses_bad_houses_naming_field_and_remedy(tmp_path, read_house, house, field_name, remedy):
    error = read_house(house, ASSETS | {"Hall": {"boundingBox": point(6, 2, 6)}})
    assert isinstance(error, InputError)
    assert str(error).startswith(f"{tmp_path / 'house.json'}, line 1: house 'house-0'")
    assert_message_names(error, f"{field_name} ", remedy)


def test_read_procthor_refuses_a_list_without_houses(read_house):
    with pytest.raises(InputError, match="no house"):
        read_house([])


@pytest.mark.parametrize(("house", "field_name", "remedy"), BAD_AGENTS)
def test_read_procthor_refuses_a_bad_agent_only_if_its_part_is_requested(read_house, house, field_name, remedy):
    error = read_house(house, agent_part=True)
    assert isinstance(error, InputError)
    assert_message_names(error, f"{field_name} ", remedy)
    assert_scenes_equal(read_house(house), read_house(HOUSE))


def test_read_procthor_imports_all_good_houses_of_a_file(tmp_path):
    house_file = tmp_path / "val.jsonl.gz"
    lines = [json.dumps(HOUSE), "{", "", json.dumps(without(HOUSE, "rooms")), json.dumps(HOUSE)]
    house_file.write_bytes(gzip.compress("\n".join(lines).encode()))
    scenes, (torn_line, bad_house) = scenes_and_errors(read_procthor(house_file, "val"))
    assert [scene.name for scene in scenes] == ["val-0", "val-3"]
    assert_message_names(torn_line, f"{house_file}, line 2: not JSON")
    assert_message_names(bad_house, f"{house_file}, line 4: house 'val-2': rooms ", "add it")


@pytest.mark.parametrize(
    ("file_name", "indent"), [("houses.json", None), ("houses.json", 2), ("houses.json.gz", 2), ("houses.jsonl", None)]
)
@pytest.mark.parametrize(("houses", "house_names"), [(HOUSE, ["houses-0"]), ([HOUSE, HOUSE], ["houses-0", "houses-1"])])
def test_read_procthor_reads_a_house_or_a_list_of_houses(tmp_path, file_name, indent, houses, house_names):
    file_bytes = json.dumps(houses, indent=indent).encode()
    house_file = tmp_path / file_name
    house_file.write_bytes(gzip.compress(file_bytes) if house_file.suffix == ".gz" else file_bytes)
    scenes, _ = scenes_and_errors(read_procthor(house_file, "val"))
    assert [scene.name for scene in scenes] == house_names


@pytest.mark.parametrize(
    ("file_name", "file_bytes", "expected_part"),
    [("empty.jsonl", b"\n", "no house"), ("half.json", json.dumps(HOUSE, indent=1).encode()[:500], "not JSON")],
)
def test_read_procthor_refuses_empty_and_torn_files(tmp_path, file_name, file_bytes, expected_part):
    house_file = tmp_path / file_name
    house_file.write_bytes(file_bytes)
    with pytest.raises(InputError, match=expected_part):
        list(read_procthor(house_file, "val"))


def test_read_procthor_refuses_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        list(read_procthor(tmp_path / "none.json", "val"))


def test_read_procthor_refuses_compressed_files_cut_short_anywhere(tmp_path):
    house_file = tmp_path / "house.json.gz"
    file_bytes = gzip.compress(json.dumps(HOUSE).encode())
    for size in range(20, len(file_bytes), 97):
        house_file.write_bytes(file_bytes[:size])
        with pytest.raises(InputError, match="cut short"):
            list(read_procthor(house_file, "val"))


@pytest.mark.parametrize(
    ("assets", "field_name"),
    [
        ([1], "asset database"),
        ({"Bowl_1": 3}, "Bowl_1"),
        ({"Bowl": [{"boundingBox": None}]}, "assetId"),
        ({"Bowl_1": {"boundingBox": point(1, 1, NAN)}}, "boundingBox: z"),
        ({"Bowl_1": {"boundingBox": point(1, -1, 1)}}, "boundingBox"),
    ],
)
def test_read_procthor_refuses_bad_asset_databases_naming_the_field(tmp_path, read_house, assets, field_name):
    with pytest.raises(InputError) as error:
        read_house(HOUSE, assets)
    assert_message_names(error.value, str(tmp_path / "assets.json"), f"{field_name} ")


@pytest.mark.slow
def test_read_procthor_imports_or_refuses_mutated_houses(tmp_path):
    outcomes = collections.Counter()
    house_file = tmp_path / "houses.jsonl"

    @given(mutated(HOUSE))
    def check_import(house):
        house_file.write_text(json.dumps(house) + "\n" + json.dumps(HOUSE))
        results = list(read_procthor(house_file, "train"))
        check_outcomes(results, outcomes, house_file)
        scenes, _ = scenes_and_errors(results)
        assert scenes[-1].name == "houses-1"

    check_import()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_read_procthor_imports_or_refuses_mutated_text(tmp_path):
    outcomes = collections.Counter()
    house_file = tmp_path / "house.json"

    @given(mutated_text(json.dumps(HOUSE)))
    def check_import(file_text):
        house_file.write_text(file_text)
        try:
            results = list(read_procthor(house_file, "train"))
        except InputError as error:
            results = [error]
        check_outcomes(results, outcomes, house_file)

    check_import()
    assert outcomes[InputError] >= 10
