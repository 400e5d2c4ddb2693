"""World that supplies the categories and rules for a file of scenes."""

import dataclasses

import pytest
from support.scenes import coarse_scene

from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.worlds import WORLDS, SceneSource


@pytest.mark.parametrize(
    ("recorded_world", "expected_world"),
    [("ithor", "rooms"), ("robothor", "apartments"), ("procthor", "houses"), ("gibson", "houses"), ("mine", "rooms")],
)
def test_scene_source_infers_the_world_of_a_file(tmp_path, recorded_world, expected_world):
    scene_file = tmp_path / "scenes.jsonl.gz"
    write_scenes(scene_file, [dataclasses.replace(coarse_scene(0), world=recorded_world)])
    scene_source = SceneSource(str(scene_file))
    assert scene_source.world_name == expected_world
    assert scene_source.task == WORLDS[expected_world].task
    assert SceneSource(str(scene_file), world="rooms").world_name == "rooms"  # an explicit world takes precedence


def test_scene_source_of_a_generated_world_has_its_name():
    assert SceneSource("apartments").world_name == "apartments"


def test_scene_source_of_a_file_without_scenes_defaults_to_rooms(tmp_path):
    scene_file = tmp_path / "scenes.jsonl"
    scene_file.write_text("[]\n")
    assert SceneSource(str(scene_file)).world_name == "rooms"
    with pytest.raises(InputError, match="cannot be read"):
        _ = SceneSource(str(tmp_path / "absent.jsonl.gz")).world_name


@pytest.mark.parametrize("number", [2**32, 2**63, 10**23])
def test_scene_source_refuses_indices_that_are_too_large(number):
    with pytest.raises(InputError, match=f"{number + 1} scenes of split 'val'; request 1 to 4,294,967,296"):
        SceneSource("rooms").select_scene(index=number)
