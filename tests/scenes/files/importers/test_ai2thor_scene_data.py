"""Import of offline AI2-THOR Scene_Data folders."""

import collections
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.scene_data import FILES, GRAPH, GRID, NODES, VISIBLE, write_folder
from support.mutations import mutated
from support.refusals import assert_message_names
from support.scene_records import as_scene, assert_scenes_equal, check_outcomes, without_counts

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_scene_data
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene


@pytest.fixture
def read_folder(tmp_path):
    """Return a reader of a Scene_Data folder, some of whose files are replaced or, with None, removed."""

    def read(**changed_files: object) -> Scene | InputError:
        files = FILES | {f"{name}.json": value for name, value in changed_files.items()}
        (result,) = without_counts(read_scene_data(write_folder(tmp_path / "FloorPlan401", files), "test"))
        return result

    return read


def test_read_scene_data_imports_a_room_worked_out_by_hand(read_folder):
    scene = read_folder()
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("FloorPlan401", "ithor", "bathroom", "test")

    # Three cells of margin on each side of 3 x 3: 9 x 9, its corner 0.75 m left of x 0 and before z -0.25.
    assert scene.origin == (-0.75, -1.0)
    expected_reach = np.zeros((9, 9), bool)
    expected_reach[3:6, 3:6] = True
    np.testing.assert_array_equal(scene.reach, expected_reach)
    assert len(standable_cells(scene.reach)) == 9

    # No Apple, which is visible from nowhere, and no Floor; a part of an object has its own type.
    assert scene.types == ("Fridge", "Sink", "SinkBasin")
    fridge_size, sink_size, basin_size = [typical_box(name)[:3] for name in scene.types]
    np.testing.assert_allclose(
        scene.boxes,
        [
            [1.0, fridge_size[1] / 2, -0.25, *fridge_size],  # its pivot is on the floor: it stands there
            [-1.0, 0.9, 0.25, *sink_size],
            [-1.0, 0.9, 0.25, *basin_size],
        ],
    )


@pytest.mark.parametrize(
    "changed_files",
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
def test_read_scene_data_imports_other_forms_of_a_folder(tmp_path, read_folder, changed_files):
    (plain_scene,) = without_counts(read_scene_data(write_folder(tmp_path / "data" / "FloorPlan401", FILES), "test"))
    assert_scenes_equal(read_folder(**changed_files), plain_scene)


def test_read_scene_data_measures_heights_from_the_floor(read_folder):
    # The agent at 1.4 stands on a floor at 0.5; the sink at 0.9 is 0.4 above it.
    scene = read_folder(grid=[point | {"y": 1.4} for point in GRID])
    assert scene.boxes[1, 1] == pytest.approx(0.4)


def test_read_scene_data_imports_all_good_scenes_of_a_folder(tmp_path):
    write_folder(tmp_path / "FloorPlan1_physics", FILES)
    write_folder(tmp_path / "FloorPlan2", FILES | {"grid.json": '[{"x": 0.0'})
    write_folder(tmp_path / "FloorPlan301", FILES)
    (tmp_path / "notes").mkdir()
    (tmp_path / "readme.txt").touch()

    # Two scenes are imported, and the one with a cut file is reported.
    first_scene, error, last_scene = without_counts(read_scene_data(tmp_path, "train"))
    room_types = {scene.name: scene.room_type for scene in map(as_scene, (first_scene, last_scene))}
    assert room_types == {"FloorPlan1": "kitchen", "FloorPlan301": "bedroom"}
    assert_message_names(error, f"{tmp_path / 'FloorPlan2' / 'grid.json'}, scene 'FloorPlan2': not JSON")


def test_read_scene_data_refuses_grids_of_another_spacing(read_folder):
    positions = [{"x": 0.5 * i, "y": 0.9, "z": 0.5 * j} for i in range(3) for j in range(3)]
    assert_message_names(read_folder(grid=positions, graph=None), "grid has positions", "0.5 m apart")
    nodes = [{"id": f"{position['x']:.2f}|{position['z']:.2f}|0|0"} for position in positions]
    error = read_folder(grid=None, graph={"nodes": nodes, "links": []})
    assert_message_names(error, "nodes has positions", "0.5 m apart")


@pytest.mark.parametrize(
    ("changed_files", "field_name", "remedy"),
    [
        ({"grid": None, "graph": None}, "grid.json", "check the path"),
        ({"visible_object_map_1.5": None}, "visible_object_map_1.5.json", "check the path"),
        ({"grid": {}}, "grid", "give a list"),
        ({"grid": []}, "grid", "give at least one"),
        ({"grid": [*GRID, {"x": 0.0, "z": 0.0}]}, "grid[9]: y", "add it"),
        ({"grid": [*GRID, {"x": float("nan"), "y": 0.9, "z": 0.0}]}, "grid[9]: x", "finite number"),
        ({"grid": [*GRID, {"x": 0.3, "y": 0.9, "z": 0.0}]}, "grid", "multiples of 0.25"),
        ({"grid": GRID[1:]}, "grid", "take both files from one release"),
        ({"graph": []}, "graph", "give a JSON object"),
        ({"graph": {"links": []}}, "graph: nodes", "add it"),
        ({"graph": {"nodes": []}}, "nodes", "give at least one"),
        ({"graph": {"nodes": [3]}}, "nodes[0]", "give a JSON object"),
        ({"graph": {"nodes": [{"id": 3}]}}, "nodes[0]: id", "give a string"),
        ({"graph": {"nodes": [{"id": "0.00|nan|0|0"}]}}, "nodes[0]: id", "give x|z|rotation|horizon"),
        ({"graph": {"nodes": [{"id": f"{'9' * 400}.0|0.00|0|0"}]}}, "nodes[0]: id", "finite number"),
        ({"visible_object_map_1.5": [1]}, "map", "give a JSON object"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+00.20|+00.30": 3}}, "'Cup|+00.10|+00.20|+00.30'", "give a list"),
        ({"visible_object_map_1.5": {"Cup|surface|3": ["a"]}}, "'Cup|surface|3'", "give Type|x|y|z"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+nan|+00.30": ["a"]}}, "'Cup|+00.10|+nan|+00.30'", "give Type|x|y|z"),
        ({"visible_object_map_1.5": {f"Cup|{'9' * 9}.0|0.0|0.0": ["a"]}}, "'Cup|999999999.0|0.0|0.0'", "finite number"),
        ({"visible_object_map_1.5": {}}, "map", "give at least one"),
        ({"visible_object_map_1.5": {"Cup|+00.10|+00.20|+00.30": []}}, "map", "give at least one"),
    ],
)
def test_read_scene_data_refuses_bad_files_naming_folder_field_and_remedy(
    tmp_path, read_folder, changed_files, field_name, remedy
):
    error = read_folder(**changed_files)
    assert isinstance(error, InputError)
    assert str(error).startswith(str(tmp_path / "FloorPlan401"))
    assert_message_names(error, field_name, remedy)


def test_read_scene_data_refuses_paths_without_a_scene(tmp_path):
    (tmp_path / "notes").mkdir()
    for path, expected_part in ((tmp_path, "no scene"), (tmp_path / "none", "not a folder")):
        with pytest.raises(InputError, match=expected_part):
            list(read_scene_data(path, "train"))


#: One node per place, so that mutations reach every kind of value.
SMALL = FILES | {"graph.json": {"nodes": NODES[::16]}}


@pytest.mark.parametrize("file_name", SMALL)
def test_read_scene_data_imports_or_refuses_mutated_files(tmp_path, file_name):
    outcomes = collections.Counter()
    folder = write_folder(tmp_path / "FloorPlan1", SMALL)
    if file_name == "grid.json":  # the nodes of a graph would miss every place that a mutation removes
        (folder / "graph.json").unlink()

    @given(mutated(SMALL[file_name]))
    def check_import(mutated_content):
        (folder / file_name).write_text(json.dumps(mutated_content))
        check_outcomes(without_counts(read_scene_data(folder, "train")), outcomes, folder)

    check_import()
    assert outcomes[InputError] >= 10
    assert outcomes[Scene] >= 1


@given(st.text("|+-.0123456789eCupN_\u0663 ", max_size=24))
def test_read_scene_data_imports_or_refuses_strange_ids(tmp_path_factory, object_id):
    folder = write_folder(tmp_path_factory.getbasetemp() / "ids" / "FloorPlan1", SMALL)
    (folder / "visible_object_map_1.5.json").write_text(json.dumps(VISIBLE | {object_id: ["a"]}))
    check_outcomes(without_counts(read_scene_data(folder, "train")), collections.Counter(), folder)
