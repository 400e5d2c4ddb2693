"""ProcTHOR files that cannot be used."""

import collections
import gzip
import json

import pytest
from hypothesis import given
from support.importer_inputs.procthor import ASSETS, BOWL, HOUSE, TABLE, point
from support.mutations import changed, mutated, mutated_text, without
from support.scene_records import assert_scenes_equal, check_outcomes, scenes_and_errors

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.scene import Scene

NAN = float("nan")
CROSSED = [point(x, 0, z) for x, z in [(0, 0), (3, 3), (3, 0), (0, 3)]]
BAD = [
    ([], "holds no house"),
    (3, "'house-0' is 3; give an object"),
    (without(HOUSE, "rooms"), "rooms is missing"),
    (without(HOUSE, "walls"), "walls is missing"),
    (without(HOUSE, "doors"), "doors is missing"),
    (without(HOUSE, "objects"), "objects is missing"),
    (without(HOUSE, "doors", 0, "holePolygon"), "doors[0]: holePolygon is missing"),
    (without(HOUSE, "rooms", 0, "roomType"), "rooms[0]: roomType is missing"),
    (without(HOUSE, "walls", 2, "polygon", 1, "z"), "walls[2]: polygon[1]: z is missing"),
    (without(HOUSE, "objects", 0, "children", 0, "position"), "objects[0].children[0]: position is missing"),
    (without(HOUSE, "objects", 0, "children", 0, "rotation"), "objects[0].children[0]: rotation is missing"),
    (changed(HOUSE, "rooms", []), "rooms is empty"),
    (changed(HOUSE, "objects", []), "objects is empty"),
    (changed(HOUSE, "rooms", 1, "floorPolygon", CROSSED), "rooms[1]: floorPolygon crosses or touches itself"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", CROSSED[:2]), "rooms[0]: floorPolygon has 2 corners"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", CROSSED * 300), "rooms[0]: floorPolygon has 1200 corners"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", 0, "x", -495.0), "rooms span more than 500 m"),
    (changed(HOUSE, "rooms", 0, "floorPolygon", 0, "x", NAN), "floorPolygon[0]: x is nan"),
    (changed(HOUSE, "walls", 0, "polygon", 0, "x", 1.0), "walls[0]: polygon has the corners"),
    (changed(HOUSE, "walls", 0, "polygon", [point(x, y, x) for y in (0, 3) for x in (0, 3)]), "along x or z"),
    (changed(HOUSE, "doors", 0, "wall0", "wall|9"), "doors[0]: wall0 is 'wall|9', which the house does not have"),
    (changed(HOUSE, "doors", 0, "wall1", "wall|9"), "doors[0]: wall1 is 'wall|9', which the house does not have"),
    (changed(HOUSE, "doors", 0, "room1", "room|9"), "doors[0]: room1 is 'room|9', which the house does not have"),
    (changed(HOUSE, "doors", 0, "holePolygon", 1, "x", 3.1), "doors[0]: holePolygon spans x [1.0, 3.1]"),
    (changed(HOUSE, "doors", 0, "holePolygon", 0, "x", 2.0), "doors[0]: holePolygon spans x [2.0, 2.0]"),
    (changed(HOUSE, "doors", 0, "openness", "wide"), "doors[0]: openness is 'wide'"),
    (changed(HOUSE, "objects", 0, "position", "y", NAN), "objects[0]: position: y is nan"),
    (changed(HOUSE, "objects", 0, "children", 0, BOWL | {"objectType": 5}), "objectType is 5"),
    (changed(HOUSE, "objects", 0, TABLE | {"position": point(3, 0.4, 1.5), "assetId": "Hall"}), "have no floor 0.2 m"),
]
BAD_AGENTS = [
    (without(HOUSE, "metadata", "agent"), "metadata: agent is missing"),
    (changed(HOUSE, "metadata", "agent", "position", "x", 4.9), "position holds [4.9, 0.5]"),
    (changed(HOUSE, "metadata", "agent", "position", point(4.5, 0.9, 3.5)), "where the agent cannot stand"),  # 3 cells
    (changed(HOUSE, "metadata", "agent", "position", point(-500, 0.9, 1.5)), "where the agent cannot stand"),
]


@pytest.mark.parametrize(("house", "problem"), BAD)
def test_bad_houses_are_refused_with_their_place(tmp_path, read_house, house, problem):
    if house == []:
        with pytest.raises(InputError, match=problem):
            read_house(house)
        return
    error = read_house(house, ASSETS | {"Hall": {"boundingBox": point(6, 2, 6)}})
    assert isinstance(error, InputError)
    assert str(error).startswith(f"{tmp_path / 'house.json'}, line 1: house 'house-0'")
    assert problem in str(error)


@pytest.mark.parametrize(("house", "problem"), BAD_AGENTS)
def test_a_bad_place_of_the_agent_matters_only_if_its_part_is_asked_for(read_house, house, problem):
    error = read_house(house, agent_part=True)
    assert isinstance(error, InputError)
    assert problem in str(error)
    assert_scenes_equal(read_house(house), read_house(HOUSE))


def test_the_other_houses_of_a_file_are_imported(tmp_path):
    path = tmp_path / "val.jsonl.gz"
    lines = [json.dumps(HOUSE), "{", "", json.dumps(without(HOUSE, "rooms")), json.dumps(HOUSE)]
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    scenes, (partial, bad) = scenes_and_errors(read_procthor(path, "val"))
    assert [scene.name for scene in scenes] == ["val-0", "val-3"]
    assert partial.startswith(f"{path}, line 2: not JSON")
    assert bad.startswith(f"{path}, line 4: house 'val-2': rooms is missing")


@pytest.mark.parametrize(
    ("name", "indent"), [("houses.json", None), ("houses.json", 2), ("houses.json.gz", 2), ("houses.jsonl", None)]
)
def test_whole_files_hold_a_house_or_a_list_of_them(tmp_path, name, indent):
    for houses in (HOUSE, [HOUSE, HOUSE]):
        text = json.dumps(houses, indent=indent).encode()
        (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
        names = [scene.name for scene in read_procthor(tmp_path / name, "val") if isinstance(scene, Scene)]
        assert names == ["houses-0", "houses-1"][: 2 if isinstance(houses, list) else 1]


def test_files_that_cannot_be_read_are_refused(tmp_path):
    whole, content = tmp_path / "house.json.gz", gzip.compress(json.dumps(HOUSE).encode())
    for path, text, problem in [
        (tmp_path / "gone.json", None, "cannot be read"),
        (tmp_path / "empty.jsonl", b"\n", "holds no house"),
        (tmp_path / "half.json", json.dumps(HOUSE, indent=1).encode()[:500], "not JSON"),
        *[(whole, content[:size], "cut short") for size in range(20, len(content), 97)],
    ]:
        if text is not None:
            path.write_bytes(text)
        with pytest.raises(InputError, match=problem):
            list(read_procthor(path, "val"))


@pytest.mark.parametrize(
    ("assets", "problem"),
    [
        ([1], "asset database is"),
        ({"Bowl_1": 3}, "Bowl_1 is 3"),
        ({"Bowl": [{"boundingBox": None}]}, "assetId is missing"),
        ({"Bowl_1": {"boundingBox": point(1, 1, NAN)}}, "boundingBox: z is nan"),
        ({"Bowl_1": {"boundingBox": point(1, -1, 1)}}, "boundingBox is"),
    ],
)
def test_bad_asset_databases_are_refused(tmp_path, read_house, assets, problem):
    with pytest.raises(InputError, match=problem) as caught:
        read_house(HOUSE, assets)
    assert str(caught.value).startswith(str(tmp_path / "assets.json"))


def test_mutated_houses_are_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "houses.jsonl"

    @given(mutated(HOUSE))
    def check(house):
        path.write_text(json.dumps(house) + "\n" + json.dumps(HOUSE))
        results = list(read_procthor(path, "train"))
        check_outcomes(results, outcomes, path)
        assert [result.name for result in results if isinstance(result, Scene)][-1] == "houses-1"

    check()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_mutated_text_is_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "house.json"

    @given(mutated_text(json.dumps(HOUSE)))
    def check(text):
        path.write_text(text)
        try:
            results = list(read_procthor(path, "train"))
        except InputError as error:
            results = [error]
        check_outcomes(results, outcomes, path)

    check()
    assert outcomes[InputError] >= 10
