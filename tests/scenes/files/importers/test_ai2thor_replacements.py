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
from support.refusals import assert_message_names
from support.scene_records import as_scene, check_outcomes, without_counts, write_records

from jaxnav.__main__ import main
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.files.importers.ai2thor import read_replacements
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import ROOMS

MUG = 4
PEN = 5
CUP = 7
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
def base_file(tmp_path):
    """Return the scene file of the room before its objects are placed anew."""
    return write_records(tmp_path / "base.jsonl.gz", ROOM)


def test_read_replacements_moves_the_objects_of_every_set(tmp_path, base_file):
    sets_file = write_records(tmp_path / "sets.jsonl.gz", SETS)
    first_scene, second_scene = map(as_scene, without_counts(read_replacements(sets_file, base_file)))
    (base_room,) = read_scenes(base_file)
    assert [first_scene.name, second_scene.name] == ["den-replaced-0", "den-replaced-1"]
    assert first_scene.types == base_room.types == ("Desk", "Book", "Book", "BasketBall", "Mug", "Pen", "Cup")

    # The first set moves all but the desk, the pen and the cup.
    expected_boxes = [
        [0.5, 0.4, 1.0, 1.0, 0.8, 0.5],
        [0.0, 0.85, 0.9, 0.2, 0.1, 0.3],  # underside on the desk: 0.8 + 0.1 / 2
        [0.1, 0.05, 0.0, 0.4, 0.1, 0.1],  # the second row is the second book; underside on the floor
        [0.3, 0.92, 1.0, 0.24, 0.24, 0.24],  # the pivot of a ball is its centre
        [0.25, 0.05, 0.5, 0.1, 0.1, 0.1],  # a pivot outside the box says nothing
        [0.8, 0.95, 1.0, 0.01, 0.2, 0.01],
        [0.1, 0.85, 1.2, 0.1, 0.1, 0.1],
    ]
    np.testing.assert_allclose(first_scene.boxes, expected_boxes, atol=1e-12)

    # Moved objects have no parent, nor has the pen, whose mug is elsewhere; the cup stays on the desk.
    np.testing.assert_array_equal(base_room.parents, [-1, 0, 0, -1, 0, 4, 0])
    np.testing.assert_array_equal(first_scene.parents, [-1, -1, -1, -1, -1, -1, 0])
    np.testing.assert_array_equal(second_scene.parents, [-1, 0, 0, -1, 0, 4, -1])

    # The second set moves the cup alone.
    np.testing.assert_allclose(second_scene.boxes[:-1], base_room.boxes[:-1])
    np.testing.assert_allclose(second_scene.boxes[-1], [0.2, 0.85, 1.1, 0.1, 0.1, 0.1])

    # Neither changes the rest of the scene.
    for scene in (first_scene, second_scene):
        np.testing.assert_array_equal(scene.reach, base_room.reach)
        np.testing.assert_array_equal(scene.walls, base_room.walls)
        np.testing.assert_array_equal(scene.yaws, base_room.yaws)


@pytest.mark.parametrize(
    ("changed_fields", "field_name", "remedy"),
    [
        ({"name": "attic"}, "name", "give its scene file"),
        ({"columns": ["type", "x", "z", "y"]}, "columns", "give ['type', 'x', 'y', 'z']"),
        ({"sets": {}}, "sets", "give a list"),
        ({"sets": [[["Book", 0, 0]]]}, "sets[0][0]", "give a list of 4"),
        ({"sets": [[["Cup", 0, None, 0]]]}, "sets[0][0]", "give the number or leave the object out"),
        ({"sets": [[["Sofa", 0, 0, 0]]]}, "sets[0][0]", "remove it"),
        ({"sets": [[["Cup", 0, 0, 0], ["Cup", 1, 0, 0]]]}, "sets[0][1]", "remove it"),
    ],
)
def test_read_replacements_refuses_bad_rooms_and_imports_the_rest(
    tmp_path, base_file, changed_fields, field_name, remedy
):
    sets_file = write_records(tmp_path / "sets.jsonl.gz", SETS | changed_fields, SETS)
    error, *scenes = without_counts(read_replacements(sets_file, base_file))
    assert isinstance(error, InputError)
    assert str(error).startswith(f"{sets_file}, line 1: record")
    assert_message_names(error, f"{field_name} ", remedy)
    assert [as_scene(scene).name for scene in scenes] == ["den-replaced-0", "den-replaced-1"]


def test_read_replacements_refuses_a_bad_set_and_imports_the_rest(tmp_path, base_file):
    sets_file = write_records(tmp_path / "sets.jsonl.gz", SETS | {"sets": [[["Sofa", 0, 0, 0]], ROWS]})
    error, scene = without_counts(read_replacements(sets_file, base_file))
    assert isinstance(error, InputError)
    assert as_scene(scene).name == "den-replaced-1"


def test_read_replacements_refuses_empty_and_missing_files(tmp_path, base_file):
    empty_file = write_records(tmp_path / "empty.jsonl.gz")
    with pytest.raises(InputError, match=r"empty\.jsonl\.gz: .*no room"):
        list(read_replacements(empty_file, base_file))
    with pytest.raises(InputError, match=r"none\.jsonl\.gz: cannot be read"):
        list(read_replacements(base_file, tmp_path / "none.jsonl.gz"))


def test_read_replacements_imports_or_refuses_mutated_records(tmp_path, base_file):
    outcomes = collections.Counter()

    @given(mutated(SETS))
    def check_import(mutated_sets):
        sets_file = write_records(tmp_path / "sets.jsonl.gz", mutated_sets, SETS)
        results = without_counts(read_replacements(sets_file, base_file))
        check_outcomes(results[:-2], outcomes, sets_file)
        assert [type(result) for result in results[-2:]] == [Scene, Scene]

    check_import()
    assert outcomes[InputError] >= 10
    assert outcomes[Scene] >= 1


@given(st.one_of(st.text("Cup|+-.0123456789e\u0663 ", max_size=24), st.just(None), st.integers(), st.just([])))
def test_read_replacements_puts_the_underside_at_the_pivot_for_strange_ids(tmp_path_factory, object_id):
    # The room has a cup with a strange id; the second set moves it.
    folder = tmp_path_factory.getbasetemp() / "ids"
    folder.mkdir(exist_ok=True)
    room_file = write_records(
        folder / "room.jsonl.gz", ROOM | {"objects": [[*ROOM["objects"][CUP][:8], -1, object_id]]}
    )
    sets_file = write_records(folder / "sets.jsonl.gz", SETS | {"sets": SETS["sets"][1:]})
    (scene,) = without_counts(read_replacements(sets_file, room_file))
    assert as_scene(scene).boxes[0, 1] == pytest.approx(0.85)


def test_scenes_import_replacements_writes_a_scene_file(tmp_path, base_file, capsys):
    sets_file = write_records(tmp_path / "sets.jsonl.gz", SETS)
    scene_file = tmp_path / "out.jsonl.gz"
    options = ("--base", str(base_file), "--val", "*-1")
    assert main(["scenes", "import", "replacements", str(sets_file), str(scene_file), *options]) == 0
    splits = {scene.name: scene.split for scene in read_scenes(scene_file)}
    assert splits == {"den-replaced-0": "train", "den-replaced-1": "val"}
    assert_message_names(capsys.readouterr().err, "2 scenes imported", "0 refused")


def test_read_replacements_reads_ten_sets_of_eighty_real_rooms():
    scenes = list(map(as_scene, without_counts(read_replacements(require(ITHOR_SHUFFLES), require(ITHOR)))))
    rooms = {scene.name: scene for scene in read_scenes(ITHOR)}
    train_rooms = [name for name, base_room in rooms.items() if base_room.split == "train"]
    assert len(scenes) == 800
    assert collections.Counter(scene.name.split("-")[0] for scene in scenes) == dict.fromkeys(train_rooms, 10)

    # Objects are moved, but keep their types and sizes.
    num_moved = 0
    for scene in scenes:
        base_room = rooms[scene.name.split("-")[0]]
        assert scene.types == base_room.types
        np.testing.assert_array_equal(scene.boxes[:, 3:], base_room.boxes[:, 3:])
        num_moved += np.any(scene.boxes != base_room.boxes, axis=1).sum()
    assert 9700 <= num_moved <= 9830  # rows of the file; a few stay where they were


def read_json_lines(sets_file) -> list[Any]:
    return [json.loads(line) for line in gzip.decompress(sets_file.read_bytes()).splitlines()]


def test_read_replacements_restores_real_heights_from_pivots(tmp_path):
    """The rule for heights agrees with the real rooms: pivots, which stand in the ids, give back the boxes."""
    movable_types = set()
    for room_sets in read_json_lines(require(ITHOR_SHUFFLES)):
        movable_types |= {row[0] for row in room_sets["sets"][0]}

    # Put every movable object on the pivot in its id, `type|x|y|z`.
    all_sets = []
    for record in read_json_lines(require(ITHOR)):
        rows = []
        for type_name, *_, object_id in record["objects"]:
            if type_name in movable_types:
                rows.append([type_name, *map(float, object_id.split("|")[1:4])])
        all_sets.append({"name": record["name"], "columns": ["type", "x", "y", "z"], "sets": [rows]})
    scenes = without_counts(read_replacements(write_records(tmp_path / "sets.jsonl.gz", *all_sets), ITHOR))

    # At least 95 % of the heights are within 2 cm.
    height_errors = []
    for scene, base_room in zip(scenes, read_scenes(ITHOR), strict=True):
        if isinstance(scene, Scene):
            is_movable = np.isin(base_room.types, list(movable_types))
            height_errors.extend(np.abs(scene.boxes[is_movable, 1] - base_room.boxes[is_movable, 1]))
    assert len(height_errors) >= 900
    assert np.mean(np.array(height_errors) <= 0.02) >= 0.95


@pytest.mark.exhaustive
def test_replaced_real_rooms_keep_nearly_all_categories_reachable():
    num_present = 0
    num_reachable = 0
    for scene in map(as_scene, without_counts(read_replacements(require(ITHOR_SHUFFLES), require(ITHOR)))):
        num_present += len(set(category_ids(scene.types, ITHOR_CATEGORIES)) - {-1})
        num_reachable += (compile_scene(scene, ROOMS).best_length > 0).any(axis=0).sum()
    assert num_present == 6700
    assert num_reachable / num_present >= 0.97
