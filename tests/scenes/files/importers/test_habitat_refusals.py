"""Refusals of unusable Habitat ObjectNav files."""

import gzip
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.habitat import EPISODES, STARTS, episode, write_json
from support.importer_inputs.semantic_maps import l_shaped_floor, write_maps
from support.mutations import changed, mutated, mutated_bytes
from support.refusals import assert_message_names
from support.scene_records import scenes_and_errors

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes


def test_read_habitat_reports_bad_scenes_and_floors_and_imports_the_rest(tmp_path):
    # Of three scenes one has no map and one is cut short; of the third one's floors two have damaged maps.
    map_file = write_maps(tmp_path / "m.pbz2", {"Home": {0: l_shaped_floor(), 1: {"floor_height": 3.0}, 2: 5}})
    file_content = tmp_path / "val" / "content"
    write_json(file_content / "A.json.gz", {"episodes": [episode(0, 0, 0, scene_id="x/Away.glb")]})
    (file_content / "B.json.gz").write_bytes(gzip.compress(b"{}")[:-5])
    write_json(file_content / "Home.json.gz", {"episodes": STARTS[:72]})

    # One floor is imported, and four refusals are reported.
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val", map_file))
    assert [scene.name for scene in scenes] == ["Home_floor0"]
    missing_map, cut_file, first_floor, second_floor = errors
    assert_message_names(missing_map, "'Away': ", "give the maps of this split")
    assert_message_names(cut_file, "B.json.gz: ", "cut short")
    assert_message_names(first_floor, "floor 1: origin ", "add it")
    assert_message_names(second_floor, "floor 2: floor_height ", "add it")


CHAIR_GOAL = ("goals_by_category", "Home.glb_chair", 0)


@pytest.mark.parametrize(
    ("file_content", "field_name", "remedy"),
    [
        (
            changed(EPISODES, "episodes", 1, "start_position", [0, float("nan"), 0]),
            "episodes[1]: start_position",
            "finite number",
        ),
        (
            changed(EPISODES, "episodes", 1, "start_position", [0, 0]),
            "episodes[1]: start_position",
            "give a list of 3",
        ),
        (changed(EPISODES, "goals_by_category", {}), "floor 0: goals", "give a semantic"),
        (changed(EPISODES, "goals_by_category", 3), "goals_by_category", "give a JSON object"),
        (
            changed(EPISODES, *CHAIR_GOAL, "position", None),
            "goals_by_category: Home.glb_chair[0]: position",
            "give a list of 3",
        ),
        (changed(EPISODES, *CHAIR_GOAL, "object_category", ""), "object_category", "give a string"),
        (changed(EPISODES, *CHAIR_GOAL, "view_points", [{}]), "view_points[0]: agent_state", "add it"),
        (
            changed(EPISODES, "episodes", EPISODES["episodes"][:9:3]),
            "5 cells",
            "give a semantic",
        ),
        (
            changed(EPISODES, "episodes", 0, "start_position", [9e5, 0, 0]),
            "floor 0: start_position",
            "give one",
        ),
    ],
)
def test_read_habitat_refuses_bad_scenes_naming_field_and_remedy(tmp_path, file_content, field_name, remedy):
    _, errors = scenes_and_errors(read_habitat(write_json(tmp_path / "Home.json.gz", file_content), "val"))
    assert_message_names(errors[0], "Home.json.gz, scene 'Home': ", field_name, remedy)


@pytest.mark.parametrize(
    ("file_content", "field_name", "remedy"),
    [
        ([], "Home.json.gz", "give an ObjectNav episode file"),
        ({}, "episodes", "add it"),
        ({"episodes": [3]}, "episodes[0]", "give a JSON object"),
        ({"episodes": [{"scene_id": 3}]}, "episodes[0]: scene_id", "give a string"),
    ],
)
def test_read_habitat_refuses_bad_files_naming_field_and_remedy(tmp_path, file_content, field_name, remedy):
    with pytest.raises(InputError) as error:
        list(read_habitat(write_json(tmp_path / "Home.json.gz", file_content), "val"))
    assert_message_names(error.value, field_name, remedy)


def test_read_habitat_refuses_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        list(read_habitat(tmp_path / "none.json.gz", "val"))


@pytest.mark.slow
@given(mutated(EPISODES), st.booleans())
def test_read_habitat_reads_or_refuses_mutated_episodes(tmp_path_factory, file_content, use_maps):
    base_folder = tmp_path_factory.getbasetemp()
    episode_file = write_json(base_folder / "mutated.json.gz", file_content)
    map_file = write_maps(base_folder / "maps.pbz2", {"Home": {0: l_shaped_floor()}}) if use_maps else None

    # Either reading raises one error, or every result is a scene or an error, and scenes can be stored.
    try:
        scenes, errors = scenes_and_errors(read_habitat(episode_file, "val", map_file))
    except InputError as error:
        assert str(error).startswith(str(episode_file))  # noqa: PT017  (reading may also succeed)
    else:
        assert scenes or errors
        write_scenes(base_folder / "mutated.jsonl.gz", scenes)
        if scenes:
            read_scenes(base_folder / "mutated.jsonl.gz")


@given(mutated_bytes(gzip.compress(json.dumps(EPISODES).encode(), mtime=0)))
def test_read_habitat_reads_or_refuses_mutated_bytes(tmp_path_factory, file_content):
    episode_file = tmp_path_factory.getbasetemp() / "bytes.json.gz"
    episode_file.write_bytes(file_content)
    try:
        list(read_habitat(episode_file, "val"))
    except InputError as error:
        assert str(error).startswith(str(episode_file))  # noqa: PT017  (reading may also succeed)
