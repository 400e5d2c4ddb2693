"""Rooms whose movable objects the simulator has placed anew."""

import collections
import gzip
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.mutations import mutated
from support.real_scenes import ITHOR, ITHOR_SHUFFLES, require
from support.scene_records import as_scene, check_outcomes, write_records

from jaxnav.__main__ import main
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.files.importers.ai2thor import read_replacements
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import ROOMS

MUG, PEN, CUP = 4, 5, 7
ROOM: dict[str, Any] = {
    "name": "den",
    "world": "ithor",
    "room_type": "bedroom",
    "split": "train",
    "cell": 0.25,
    "origin": [0, 0],
    "shape": [2, 4],
    "reach": ["....", "...."],
    "columns": ["type", "x", "y", "z", "sx", "sy", "sz", "yaw", "parent", "id"],
    "objects": [
        ["Desk", 0.5, 0.4, 1.0, 1.0, 0.8, 0.5, 0, -1, "Desk|+00.50|+00.00|+01.00"],
        ["Book", 0.2, 0.85, 1.0, 0.2, 0.1, 0.3, 30, 0, "Book|+00.20|+00.80|+01.00"],  # pivot: underside
        ["Book", 0.5, 0.85, 1.0, 0.4, 0.1, 0.1, 0, 0, "a book"],  # no pivot
        ["BasketBall", 0.9, 0.12, 0.1, 0.24, 0.24, 0.24, 0, -1, "BasketBall|+00.90|+00.12|+00.10"],  # pivot: centre
        ["Mug", 0.8, 0.85, 1.0, 0.1, 0.1, 0.1, 0, 0, "Mug|+00.80|+01.20|+01.00"],  # it fell since
        ["Pen", 0.8, 0.95, 1.0, 0.01, 0.2, 0.01, 0, 5, "Pen|+00.80|+00.90|+01.00"],  # rests in the mug
        ["Vase", None, None, None, None, None, None, None, -1, "Vase|+00.80|+00.90|+01.00"],  # left out
        ["Cup", 0.1, 0.85, 1.2, 0.1, 0.1, 0.1, 0, 0, None],
    ],
}
ROOM["objects"][PEN][8] = MUG
ROWS = [["Book", 0.0, 0.8, 0.9], ["Book", 0.1, 0.0, 0.0], ["BasketBall", 0.3, 0.92, 1.0], ["Mug", 0.25, 0.0, 0.5]]
SETS: dict[str, Any] = {
    "name": "den",
    "n_sets": 2,
    "columns": ["type", "x", "y", "z"],
    "sets": [ROWS, [["Cup", 0.2, 0.8, 1.1]]],
}


@pytest.fixture
def base(tmp_path):
    return write_records(tmp_path / "base.jsonl.gz", ROOM)


def test_every_set_is_a_scene_with_its_objects_there(tmp_path, base):
    path = write_records(tmp_path / "sets.jsonl.gz", SETS)
    first, second = map(as_scene, read_replacements(path, base))
    (room,) = read_scenes(base)
    assert [first.name, second.name] == ["den-replaced-0", "den-replaced-1"]
    assert first.types == room.types == ("Desk", "Book", "Book", "BasketBall", "Mug", "Pen", "Cup")
    expected = [
        [0.5, 0.4, 1.0, 1.0, 0.8, 0.5],
        [0.0, 0.85, 0.9, 0.2, 0.1, 0.3],  # underside on the desk: 0.8 + 0.1 / 2
        [0.1, 0.05, 0.0, 0.4, 0.1, 0.1],  # the second row is the second book; underside on the floor
        [0.3, 0.92, 1.0, 0.24, 0.24, 0.24],  # the pivot of a ball is its centre
        [0.25, 0.05, 0.5, 0.1, 0.1, 0.1],  # a pivot outside the box says nothing
        [0.8, 0.95, 1.0, 0.01, 0.2, 0.01],
        [0.1, 0.85, 1.2, 0.1, 0.1, 0.1],
    ]
    np.testing.assert_allclose(first.boxes, expected, atol=1e-12)
    # The moved rest on nothing, nor does the pen, whose mug is elsewhere; the cup stays on the desk.
    np.testing.assert_array_equal(room.parents, [-1, 0, 0, -1, 0, 4, 0])
    np.testing.assert_array_equal(first.parents, [-1, -1, -1, -1, -1, -1, 0])
    np.testing.assert_array_equal(second.parents, [-1, 0, 0, -1, 0, 4, -1])
    np.testing.assert_allclose(second.boxes[:-1], room.boxes[:-1])
    np.testing.assert_allclose(second.boxes[-1], [0.2, 0.85, 1.1, 0.1, 0.1, 0.1])
    for scene in (first, second):
        np.testing.assert_array_equal(scene.reach, room.reach)
        np.testing.assert_array_equal(scene.walls, room.walls)
        np.testing.assert_array_equal(scene.yaws, room.yaws)


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"name": "attic"}, "name is 'attic', which is no scene of"),
        ({"columns": ["type", "x", "z", "y"]}, "columns is"),
        ({"sets": {}}, "sets is {}; give a list"),
        ({"sets": [[["Book", 0, 0]]]}, "sets[0][0] is"),
        ({"sets": [[["Cup", 0, None, 0]]]}, "sets[0][0] is null"),
        ({"sets": [[["Sofa", 0, 0, 0]]]}, "sets[0][0] is one 'Sofa' more than the room has; leave it out"),
        ({"sets": [[["Cup", 0, 0, 0], ["Cup", 1, 0, 0]]]}, "sets[0][1] is one 'Cup' more than the room has"),
    ],
)
def test_rooms_that_cannot_be_used_are_named_and_the_others_kept(tmp_path, base, fields, problem):
    path = write_records(tmp_path / "sets.jsonl.gz", SETS | fields, SETS)
    refused, *scenes = read_replacements(path, base)
    assert isinstance(refused, InputError)
    assert str(refused).startswith(f"{path}, line 1: record")
    assert problem in str(refused)
    assert [scene.name for scene in scenes if isinstance(scene, Scene)] == ["den-replaced-0", "den-replaced-1"]


def test_a_bad_set_leaves_the_others(tmp_path, base):
    path = write_records(tmp_path / "sets.jsonl.gz", SETS | {"sets": [[["Sofa", 0, 0, 0]], ROWS]})
    refused, scene = read_replacements(path, base)
    assert isinstance(refused, InputError)
    assert isinstance(scene, Scene)
    assert scene.name == "den-replaced-1"


def test_files_that_cannot_be_read_at_all(tmp_path, base):
    empty = write_records(tmp_path / "empty.jsonl.gz")
    with pytest.raises(InputError, match=r"empty.jsonl.gz: holds no room"):
        list(read_replacements(empty, base))
    with pytest.raises(InputError, match=r"none.jsonl.gz: cannot be read"):
        list(read_replacements(base, tmp_path / "none.jsonl.gz"))


def test_mutated_records_are_imported_or_refused(tmp_path, base):
    outcomes = collections.Counter()

    @given(mutated(SETS))
    def check(sets):
        path = write_records(tmp_path / "sets.jsonl.gz", sets, SETS)
        results = list(read_replacements(path, base))
        check_outcomes(results[:-2], outcomes, path)
        assert [type(result) for result in results[-2:]] == [Scene, Scene]

    check()
    assert outcomes[InputError] >= 10
    assert outcomes[Scene] >= 1


@given(st.one_of(st.text("Cup|+-.0123456789e\u0663 ", max_size=24), st.just(None), st.integers(), st.just([])))
def test_strange_ids_put_the_underside_at_the_pivot(tmp_path_factory, key):
    folder = tmp_path_factory.getbasetemp() / "ids"
    folder.mkdir(exist_ok=True)
    room = write_records(folder / "room.jsonl.gz", ROOM | {"objects": [[*ROOM["objects"][CUP][:8], -1, key]]})
    path = write_records(folder / "sets.jsonl.gz", SETS | {"sets": SETS["sets"][1:]})
    (scene,) = read_replacements(path, room)
    assert isinstance(scene, Scene)
    assert scene.boxes[0, 1] == pytest.approx(0.85)


def test_the_command_writes_a_scene_file(tmp_path, base, capsys):
    path, out = write_records(tmp_path / "sets.jsonl.gz", SETS), tmp_path / "out.jsonl.gz"
    options = ("--base", str(base), "--val", "*-1")
    assert main(["scenes", "import", "replacements", str(path), str(out), *options]) == 0
    assert [(scene.name, scene.split) for scene in read_scenes(out)] == [
        ("den-replaced-0", "train"),
        ("den-replaced-1", "val"),
    ]
    assert "2 scenes imported, 0 refused" in capsys.readouterr().err


def test_the_simulators_file_is_ten_sets_of_eighty_rooms():
    scenes = list(map(as_scene, read_replacements(require(ITHOR_SHUFFLES), require(ITHOR))))
    rooms = {scene.name: scene for scene in read_scenes(ITHOR)}
    assert [type(scene) for scene in scenes] == [Scene] * 800
    assert collections.Counter(scene.name.split("-")[0] for scene in scenes) == dict.fromkeys(
        (name for name, room in rooms.items() if room.split == "train"), 10
    )
    moved = 0
    for scene in scenes:
        room = rooms[scene.name.split("-")[0]]
        assert scene.types == room.types
        np.testing.assert_array_equal(scene.boxes[:, 3:], room.boxes[:, 3:])
        moved += np.any(scene.boxes != room.boxes, axis=1).sum()
    assert 9700 <= moved <= 9830  # rows of the file; a few stay where they were


def test_objects_put_back_on_their_pivots_are_where_they_were(tmp_path):
    """Check the rule for heights against the rooms themselves.

    The pivots in the ids of the base file give its boxes.
    """
    records = [json.loads(line) for line in gzip.decompress(require(ITHOR).read_bytes()).splitlines()]
    movable = {row[0] for line in gzip.decompress(require(ITHOR_SHUFFLES).read_bytes()).splitlines()
               for row in json.loads(line)["sets"][0]}  # fmt: skip
    sets = [
        {
            "name": record["name"],
            "columns": ["type", "x", "y", "z"],
            "sets": [[[o[0], *map(float, o[9].split("|")[1:4])] for o in record["objects"] if o[0] in movable]],
        }
        for record in records
    ]
    scenes = list(read_replacements(write_records(tmp_path / "sets.jsonl.gz", *sets), ITHOR))
    off = [
        np.abs(scene.boxes[i, 1] - room.boxes[i, 1])
        for scene, room in zip(scenes, read_scenes(ITHOR), strict=True)
        if isinstance(scene, Scene)
        for i in np.flatnonzero(np.isin(room.types, list(movable)))
    ]
    assert len(off) >= 900
    assert np.mean(np.array(off) <= 0.02) >= 0.95


@pytest.mark.slow
def test_nearly_every_object_can_be_reached_in_the_simulators_rooms():
    present = reachable = 0
    for scene in map(as_scene, read_replacements(require(ITHOR_SHUFFLES), require(ITHOR))):
        present += len(set(category_ids(scene.types, ITHOR_CATEGORIES)) - {-1})
        reachable += (compile_scene(scene, ROOMS).best_length > 0).any(axis=0).sum()
    assert present == 6700
    assert reachable / present >= 0.97
