"""Import of Habitat ObjectNav episodes with and without semantic maps."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.importer_inputs.habitat import EPISODES, STARTS, episode, goal, write_json
from support.importer_inputs.semantic_maps import bedroom, l_shaped_floor, write_maps
from support.real_scenes import INPUTS, require
from support.refusals import assert_message_names
from support.scene_geometry import points_of
from support.scene_records import assert_scenes_equal, scenes_and_errors, without_counts

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    """Return a file of semantic maps of a house with two floors, a chair on one and a bed on the other."""
    return write_maps(tmp_path / "val_info.pbz2", {"Home": {0: l_shaped_floor(), 1: bedroom()}})


def test_read_habitat_imports_the_floors_of_a_mapped_house(tmp_path, map_file):
    write_json(tmp_path / "val" / "content" / "Home_episodes.json.gz", {"episodes": STARTS})
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val", map_file))
    assert not errors
    assert [(scene.name, scene.types) for scene in scenes] == [("Home_floor0", ("Chair",)), ("Home_floor1", ("Bed",))]
    assert {(scene.world, scene.split) for scene in scenes} == {("gibson", "val")}

    # The bed: pixels 38-51 and 2-15, x 3.90 to 4.60 m, Habitat's z -0.90 to -0.20 m; typical height 0.91, centre 0.46.
    np.testing.assert_allclose(scenes[1].boxes, [[4.25, 0.46, 0.55, 0.7, 0.91, 0.7]], atol=1e-12)

    # The scenes survive their file.
    scene_file = tmp_path / "scenes.jsonl.gz"
    write_scenes(scene_file, scenes)
    for scene, scene_read in zip(scenes, read_scenes(scene_file), strict=True):
        assert_scenes_equal(scene_read, scene)


@pytest.mark.parametrize("episode_path", ["val", "val/content", "val/val.json.gz", "val/content/Home_episodes.json.gz"])
def test_read_habitat_accepts_folder_content_and_files_of_a_split(tmp_path, map_file, episode_path):
    content = tmp_path / "val" / "content"
    write_json(content / "Home_episodes.json.gz", {"episodes": STARTS})
    write_json(tmp_path / "val" / "val.json.gz", {"episodes": []})

    # Files of Habitat rather than SemExp, with the same scene, do not count.
    for habitat_name in ("Home.json.gz", "Home.glb.json.gz"):
        write_json(content / habitat_name, {"episodes": [episode(99.0, 0.0, 99.0)]})
    scenes, _ = scenes_and_errors(read_habitat(tmp_path / episode_path, "val", map_file))
    assert [scene.name for scene in scenes] == ["Home_floor0", "Home_floor1"]


def test_read_habitat_reads_uncompressed_files_of_a_folder(tmp_path):
    content = tmp_path / "val" / "content"
    write_json(content / "Home.json.gz", EPISODES)
    (content / "Home2.json").write_text(json.dumps(EPISODES).replace("Home", "Home2"))
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val"))
    assert not errors
    assert {scene.name.partition("_")[0] for scene in scenes} == {"Home", "Home2"}


@pytest.mark.parametrize("episode_path", ["train", "train/train.json.gz"])
def test_read_habitat_without_episodes_imports_every_mapped_floor(tmp_path, map_file, episode_path):
    write_json(tmp_path / "train" / "train.json.gz", {"episodes": []})
    scenes, _ = scenes_and_errors(read_habitat(tmp_path / episode_path, "train", map_file))
    assert len(scenes) == 2

    # Without a map either there is nothing to import.
    with pytest.raises(InputError, match="give the folder of a split, or a semantic floor map"):
        without_counts(read_habitat(tmp_path / episode_path, "train"))


def move_starts_upstairs(offset: float, num_moved: int) -> list[dict]:
    """Return STARTS, the last 72 of which are upstairs, with some of those moved along x, in metres."""
    episodes = []
    for i, start in enumerate(STARTS):
        x, y, z = start["start_position"]
        is_moved = 72 <= i < 72 + num_moved
        episodes.append(episode(x + offset * is_moved, y, z))
    return episodes


@pytest.mark.parametrize(
    ("offset", "num_moved", "has_fit"),
    [
        (-0.3, 72, True),  # beside the map
        (-3.0, 14, True),  # 58 of 72 are 80.6 %
        (-3.0, 15, False),
    ],
)
def test_read_habitat_refuses_a_map_that_fits_too_few_starts(tmp_path, map_file, offset, num_moved, has_fit):
    episode_path = write_json(tmp_path / "e.json.gz", {"episodes": move_starts_upstairs(offset, num_moved)})
    scenes, errors = scenes_and_errors(read_habitat(episode_path, "val", map_file))
    assert len(scenes) == 1 + has_fit
    assert len(errors) == 1 - has_fit
    if errors:
        assert_message_names(errors[0], "val_info.pbz2, scene 'Home': floor 1: sem_map ", "57 of 72")


def test_read_habitat_assigns_starts_by_floor_id(tmp_path, map_file):
    # By their height these starts are upstairs.
    episodes = [start | {"floor_id": 0} for start in move_starts_upstairs(-3.0, 72)[72:]]
    episode_path = write_json(tmp_path / "e.json.gz", {"episodes": episodes})
    scenes, errors = scenes_and_errors(read_habitat(episode_path, "val", map_file))
    assert [scene.name for scene in scenes] == ["Home_floor1"]
    assert_message_names(errors[0], "floor 0: sem_map ", "0 of 72")


def test_read_habitat_imports_floors_from_episodes_alone(tmp_path):
    episode_path = write_json(tmp_path / "Home.json.gz", EPISODES)
    (ground_floor, upper_floor), errors = scenes_and_errors(read_habitat(episode_path, "train"))
    assert not errors
    assert (ground_floor.name, ground_floor.world, ground_floor.room_type) == ("Home_floor0", "habitat", "house")

    # z is negated. Starts at x = 0.03 .. 2.03 m go to 0 .. 2 m; the view points add (2, 1.25) and (2, 1.5).
    standable_points = {(0.25 * i, 1.0) for i in range(9)} | {(2.0, 1.25), (2.0, 1.5)}
    assert points_of(ground_floor, ground_floor.reach) == standable_points

    # The chair's centre is at 0.6 - 0.1 m above the floor; a typical chair is 0.56 x 0.95 x 0.56 m.
    np.testing.assert_allclose(ground_floor.boxes, [[2.5, 0.5, 1.5, 0.56, 0.95, 0.56]], atol=1e-12)

    # The bed is in the file twice under one id, centre 3.5 - 3.1 m high and at z = -1.
    assert (ground_floor.types, upper_floor.types) == (("chair",), ("bed",))
    np.testing.assert_allclose(upper_floor.boxes, [[1.0, 0.4, -1.0, 1.84, 0.91, 1.84]], atol=1e-12)
    assert len(standable_cells(upper_floor.reach)) == upper_floor.reach.sum() == 9


def read_goals(path: Path, goals_by_category: dict[str, list[dict]]) -> list[list[tuple[str, float]]]:
    """Return type and x of the objects of each scene of `EPISODES` with other goals on its ground floor."""
    content = EPISODES | {"goals_by_category": EPISODES["goals_by_category"] | goals_by_category}
    scenes, errors = scenes_and_errors(read_habitat(write_json(path / "Home.json.gz", content), "train"))
    assert not errors
    return [list(zip(scene.types, scene.boxes[:, 0].tolist(), strict=True)) for scene in scenes]


def test_read_habitat_tells_goals_of_one_id_apart_by_category(tmp_path):
    sofa = goal("sofa", 7, [1.0, 0.5, -1.5], [])
    ground_floor, upper_floor = read_goals(tmp_path, {"Home.glb_sofa": [sofa]})
    assert ground_floor == [("chair", 2.5), ("sofa", 1.0)]
    assert upper_floor == [("bed", 1.0)]


def test_read_habitat_tells_goals_of_one_id_apart_by_place(tmp_path):
    chairs = [goal("chair", -1, [x, 0.6, -1.5], []) for x in (2.5, 0.0, 1.0, 0.0)]
    ground_floor, _ = read_goals(tmp_path, {"Home.glb_chair": chairs})
    assert ground_floor == [("chair", 2.5), ("chair", 0.0), ("chair", 1.0)]


@pytest.mark.parametrize(
    ("mesh", "scene_name"),
    [
        ("x/house.1.glb", "house.1"),
        ("house.glb", "house"),
        ("00800-TEEsavR23oF/TEEsavR23oF.basis.glb", "TEEsavR23oF"),
        ("fphab/102344049.scene_instance.json", "102344049"),
        ("v1.2/no-ending", "no-ending"),
        (".glb", ".glb"),
    ],
)
def test_read_habitat_keeps_dots_in_names_of_scenes(tmp_path, mesh, scene_name):
    home = goal("chair", 7, [0.5, 0.4, -0.5], [])
    starts = [episode(0.25 * i, 0.0, 0.0, goals=[home]) | {"scene_id": mesh} for i in range(9)]
    (scene,) = without_counts(read_habitat(write_json(tmp_path / "val.json.gz", {"episodes": starts}), "val"))
    assert isinstance(scene, Scene)
    assert scene.name == f"{scene_name}_floor0"


def test_read_habitat_replaces_files_by_their_whole_name(tmp_path):
    content = tmp_path / "val" / "content"
    names = ("house.1.json.gz", "house.1_episodes.json.gz", "house.2.json.gz", "house.3.glb.json.gz")
    for name in names:
        scene_name = "house." + name[6]
        episodes = [start | {"scene_id": f"{scene_name}.glb"} for start in EPISODES["episodes"]]
        goals = {f"{scene_name}.glb_chair": [goal("chair", 1, [2.0 + len(name) / 100, 0.6, -1.5], [])]}
        write_json(content / name, {"episodes": episodes[:9], "goals_by_category": goals})
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val"))
    assert not errors
    assert [scene.name for scene in scenes] == ["house.1_floor0", "house.2_floor0", "house.3_floor0"]
    assert scenes[0].boxes[0, 0] == 2.0 + len(names[1]) / 100


@pytest.mark.parametrize(
    ("folder_name", "types_by_scene"),
    [
        ("h01_same_id_two_categories", {"Home_floor0": ("chair", "sofa"), "Home_floor1": ("bed",)}),
        ("h02_all_ids_minus_one", {"Home_floor0": ("chair", "chair", "chair")}),
    ],
)
def test_read_habitat_imports_the_files_of_earlier_reports(folder_name, types_by_scene):
    scenes, _ = scenes_and_errors(read_habitat(require(INPUTS / folder_name / "Home.json.gz"), "train"))
    assert {scene.name: scene.types for scene in scenes} == types_by_scene


def test_read_habitat_tells_the_dotted_names_of_an_earlier_report_apart():
    # Each house has every second start of a row, so the places are too few to be connected.
    scenes, errors = scenes_and_errors(read_habitat(require(INPUTS / "h07_dots_in_names" / "Home.json.gz"), "train"))
    assert not scenes
    for scene_name, problem in {"house.1": "7 cells, of which only 3", "house.2": "5 cells, of which only 2"}.items():
        (message,) = [error for error in errors if scene_name in error and "connected" in error]
        assert_message_names(message, f"scene '{scene_name}': floor ", problem)


def test_read_habitat_uses_goals_and_shortest_paths_of_episodes(tmp_path):
    chair_goal = goal("chair", 7, [0.5, 0.4, 1.0], [[0.5, 0.0, 0.5]])
    shortest_path = [{"position": [0.25, 0.0, 0.25], "action": 1}, {"position": None, "action": 0}, 1, None]
    episodes = [
        episode(0, 0, 0, goals=[chair_goal], shortest_paths=[shortest_path]),
        episode(0, 0, 0, goals=[chair_goal]),
    ]
    (scene,) = without_counts(read_habitat(write_json(tmp_path / "e.json.gz", {"episodes": episodes}), "val"))
    assert isinstance(scene, Scene)
    assert scene.types == ("chair",)
    assert len(standable_cells(scene.reach)) == 3  # (0, 0), (0.25, 0.25), (0.5, 0.5): a diagonal
