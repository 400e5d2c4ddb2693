"""Offline Scene_Data folders to scenes."""

import collections
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.scene_data import FILES, GRAPH, GRID, NODES, VISIBLE, write_folder
from support.mutations import mutated
from support.scene_records import as_scene, assert_scenes_equal, check_outcomes

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_scene_data
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene


@pytest.fixture
def read(tmp_path):
    def read_folder(**others: object) -> Scene | InputError:
        files = FILES | {f"{name}.json": value for name, value in others.items()}
        (result,) = read_scene_data(write_folder(tmp_path / "FloorPlan401", files), "test")
        return result

    return read_folder


def test_a_room_worked_out_by_hand(read):
    scene = read()
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("FloorPlan401", "ithor", "bathroom", "test")
    # Three cells of margin on each side of 3 x 3: 9 x 9, its corner 0.75 m left of x 0 and before z -0.25.
    assert scene.origin == (-0.75, -1.0)
    expected = np.zeros((9, 9), bool)
    expected[3:6, 3:6] = True
    np.testing.assert_array_equal(scene.reach, expected)
    assert len(standable_cells(scene.reach)) == 9
    # No Apple, which is visible from nowhere, and no Floor; a part of an object has its own type.
    assert scene.types == ("Fridge", "Sink", "SinkBasin")
    fridge, sink, basin = (typical_box(name)[:3] for name in scene.types)
    np.testing.assert_allclose(
        scene.boxes,
        [
            [1.0, fridge[1] / 2, -0.25, *fridge],  # its pivot is on the floor: it stands there
            [-1.0, 0.9, 0.25, *sink],
            [-1.0, 0.9, 0.25, *basin],
        ],
    )


def test_a_scene_survives_its_file(tmp_path, read):
    scene = read()
    write_scenes(tmp_path / "scenes.jsonl.gz", [scene])
    (back,) = read_scenes(tmp_path / "scenes.jsonl.gz")
    assert_scenes_equal(back, scene)


@pytest.mark.parametrize(
    "others",
    [
        {"grid": None},  # cells from the nodes, where zero is negative
        {"graph": None},
        {"grid": GRID[::-1] + GRID[:2]},
        {"graph": GRAPH | {"edges": GRAPH["links"], "links": None}},
        {"visible_object_map_1.5": None, "visible_object_map": VISIBLE},
        {"visible_object_map": {"Mug|+01.00|+00.90|+01.00": ["0.00|0.00|0|0"]}},  # the map of 1.5 m comes first
        {"optimal_action": "not opened", "resnet18_featuremap.hdf5": "not opened"},
    ],
)
def test_other_forms_of_a_folder_give_the_same_scene(tmp_path, read, others):
    (plain,) = read_scene_data(write_folder(tmp_path / "data" / "FloorPlan401", FILES), "test")
    assert_scenes_equal(read(**others), plain)


def test_heights_are_above_the_floor(read):
    # The agent at 1.4 stands on a floor at 0.5; the sink at 0.9 is 0.4 above it.
    scene = read(grid=[point | {"y": 1.4} for point in GRID])
    assert scene.boxes[1, 1] == pytest.approx(0.4)


def test_all_scenes_of_a_folder_are_read(tmp_path):
    write_folder(tmp_path / "FloorPlan1_physics", FILES)
    write_folder(tmp_path / "FloorPlan2", FILES | {"grid.json": '[{"x": 0.0'})
    write_folder(tmp_path / "FloorPlan301", FILES)
    (tmp_path / "notes").mkdir()
    (tmp_path / "readme.txt").touch()
    first, broken, last = read_scene_data(tmp_path, "train")
    assert [(scene.name, scene.room_type) for scene in map(as_scene, (first, last))] == [
        ("FloorPlan1", "kitchen"),
        ("FloorPlan301", "bedroom"),
    ]
    assert f"{tmp_path / 'FloorPlan2' / 'grid.json'}, scene 'FloorPlan2': not JSON" in str(broken)


@pytest.mark.parametrize(
    ("others", "problem"),
    [
        ({"grid": None, "graph": None}, "grid.json: cannot be read"),
        ({"visible_object_map_1.5": None}, "visible_object_map_1.5.json: cannot be read"),
        ({"grid": {}}, "grid.json, scene 'FloorPlan401': grid is {}; give a list"),
        ({"grid": []}, "grid holds no point to stand on"),
        ({"grid": [*GRID, {"x": 0.0, "z": 0.0}]}, "grid[9]: y is missing"),
        ({"grid": [*GRID, {"x": float("nan"), "y": 0.9, "z": 0.0}]}, "grid[9]: x is nan; give a finite number"),
        ({"grid": [*GRID, {"x": 0.3, "y": 0.9, "z": 0.0}]}, "grid holds [0.3, 0.0]; x and z must be multiples of 0.25"),
        ({"grid": GRID[1:]}, "grid lacks x 0.0, z -0.25, a node of graph.json"),
        ({"graph": []}, "graph is []; give an object"),
        ({"graph": {"links": []}}, "graph: nodes is missing"),
        ({"graph": {"nodes": []}}, "nodes holds no point"),
        ({"graph": {"nodes": [3]}}, "nodes[0] is 3; give an object"),
        ({"graph": {"nodes": [{"id": 3}]}}, "nodes[0]: id is 3; give a text"),
        ({"graph": {"nodes": [{"id": "0.00|nan|0|0"}]}}, "nodes[0]: id is '0.00|nan|0|0'; give x|z|rotation|horizon"),
        ({"graph": {"nodes": [{"id": f"{'9' * 400}.0|0.00|0|0"}]}}, "nodes[0]: id is inf; give a finite number"),
        ({"visible_object_map_1.5": [1]}, "map is [1]; give an object"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+00.20|+00.30": 3}}, "'Cup|+00.10|+00.20|+00.30' is 3; give a list"),
        ({"visible_object_map_1.5": {"Cup|surface|3": ["a"]}}, "'Cup|surface|3' is no id; give Type|x|y|z"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+nan|+00.30": ["a"]}}, "is no id; give Type|x|y|z"),
        ({"visible_object_map_1.5": {f"Cup|{'9' * 9}.0|0.0|0.0": ["a"]}}, "is 999999999.0; give a finite number"),
        ({"visible_object_map_1.5": {}}, "map names no object that is visible"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+00.20|+00.30": []}}, "map names no object that is visible"),
    ],
)
def test_bad_files_are_refused_with_their_place(tmp_path, read, others, problem):
    result = read(**others)
    assert isinstance(result, InputError)
    assert str(result).startswith(str(tmp_path / "FloorPlan401"))
    assert problem in str(result)


def test_paths_without_any_scene_are_refused(tmp_path):
    (tmp_path / "notes").mkdir()
    for path, problem in ((tmp_path, "holds no scene"), (tmp_path / "none", "is no folder")):
        with pytest.raises(InputError, match=problem):
            list(read_scene_data(path, "train"))


SMALL = FILES | {
    "graph.json": {"nodes": NODES[::16]}
}  # one node per place, so that mutations reach every kind of value


@pytest.mark.parametrize("file", SMALL)
def test_mutated_files_are_imported_or_refused(tmp_path, file):
    outcomes = collections.Counter()
    folder = write_folder(tmp_path / "FloorPlan1", SMALL)
    if file == "grid.json":  # the nodes of a graph would miss every place that a mutation removes
        (folder / "graph.json").unlink()

    @given(mutated(SMALL[file]))
    def check(content):
        (folder / file).write_text(json.dumps(content))
        check_outcomes(list(read_scene_data(folder, "train")), outcomes, folder)

    check()
    assert outcomes[InputError] >= 10
    assert outcomes[Scene] >= 1


@given(st.text("|+-.0123456789eCupN_\u0663 ", max_size=24))
def test_strange_ids_are_imported_or_refused(tmp_path_factory, text):
    folder = write_folder(tmp_path_factory.getbasetemp() / "ids" / "FloorPlan1", SMALL)
    (folder / "visible_object_map_1.5.json").write_text(json.dumps(VISIBLE | {text: ["a"]}))
    check_outcomes(list(read_scene_data(folder, "train")), collections.Counter(), folder)
