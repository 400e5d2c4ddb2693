"""Habitat ObjectNav files that cannot be used."""

import gzip
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.habitat import EPISODES, STARTS, episode, write_json
from support.importer_inputs.semantic_maps import l_shaped_floor, write_maps
from support.mutations import changed, mutated, mutated_bytes
from support.scene_records import scenes_and_errors

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes


def test_scenes_and_floors_are_refused_one_by_one(tmp_path):
    maps = write_maps(tmp_path / "m.pbz2", {"Home": {0: l_shaped_floor(), 1: {"floor_height": 3.0}, 2: 5}})
    content = tmp_path / "val" / "content"
    write_json(content / "A.json.gz", {"episodes": [episode(0, 0, 0, scene_id="x/Away.glb")]})
    (content / "B.json.gz").write_bytes(gzip.compress(b"{}")[:-5])
    write_json(content / "Home.json.gz", {"episodes": STARTS[:72]})
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val", maps))
    assert [scene.name for scene in scenes] == ["Home_floor0"]
    for error, problem in zip(
        errors,
        [
            "'Away': is not in",
            "B.json.gz: is cut short",
            "floor 1: origin is missing",
            "floor 2: floor_height is missing",
        ],
        strict=True,
    ):
        assert problem in error


CHAIR_GOAL = ("goals_by_category", "Home.glb_chair", 0)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (
            changed(EPISODES, "episodes", 1, "start_position", [0, float("nan"), 0]),
            "episodes[1]: start_position is nan",
        ),
        (
            changed(EPISODES, "episodes", 1, "start_position", [0, 0]),
            "episodes[1]: start_position is [0, 0]; give a list of 3",
        ),
        (changed(EPISODES, "goals_by_category", {}), "floor 0: goals has no object on this floor; give a semantic"),
        (changed(EPISODES, "goals_by_category", 3), "goals_by_category is 3"),
        (changed(EPISODES, *CHAIR_GOAL, "position", None), "goals_by_category: Home.glb_chair[0]: position is None"),
        (changed(EPISODES, *CHAIR_GOAL, "object_category", ""), "object_category is ''"),
        (changed(EPISODES, *CHAIR_GOAL, "view_points", [{}]), "view_points[0]: agent_state is missing"),
        (
            changed(EPISODES, "episodes", EPISODES["episodes"][:9:3]),
            "are 5 cells, of which only 2 are connected; give a semantic",
        ),
        (
            changed(EPISODES, "episodes", 0, "start_position", [9e5, 0, 0]),
            "floor 0: start_position spans more than 500 m",
        ),
    ],
)
def test_scenes_that_cannot_be_used_are_named(tmp_path, content, problem):
    _, errors = scenes_and_errors(read_habitat(write_json(tmp_path / "Home.json.gz", content), "val"))
    assert "Home.json.gz, scene 'Home': " in errors[0]
    assert problem in errors[0]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ([], "is no object with episodes"),
        ({}, "episodes is missing"),
        ({"episodes": [3]}, "episodes[0] is 3; give an object"),
        ({"episodes": [{"scene_id": 3}]}, "episodes[0]: scene_id is 3; give a text"),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path, content, problem):
    with pytest.raises(InputError) as error:
        list(read_habitat(write_json(tmp_path / "Home.json.gz", content), "val"))
    assert problem in str(error.value)
    with pytest.raises(InputError, match="cannot be read"):
        list(read_habitat(tmp_path / "none.json.gz", "val"))


@given(mutated(EPISODES), st.booleans())
def test_mutated_episodes_never_raise_another_error(tmp_path_factory, content, mapped):
    folder = tmp_path_factory.getbasetemp()
    path = write_json(folder / "mutated.json.gz", content)
    maps = write_maps(folder / "maps.pbz2", {"Home": {0: l_shaped_floor()}}) if mapped else None
    try:
        scenes, errors = scenes_and_errors(read_habitat(path, "val", maps))
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)
    else:
        assert scenes or errors
        write_scenes(folder / "mutated.jsonl.gz", scenes)
        if scenes:
            read_scenes(folder / "mutated.jsonl.gz")


@given(mutated_bytes(gzip.compress(json.dumps(EPISODES).encode(), mtime=0)))
def test_mutated_bytes_never_raise_another_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "bytes.json.gz"
    path.write_bytes(content)
    try:
        list(read_habitat(path, "val"))
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)
