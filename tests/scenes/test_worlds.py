"""The world whose categories and rules count for a file of scenes."""

import dataclasses

import pytest
from support.scenes import coarse_scene

from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.worlds import WORLDS, SceneSource


@pytest.mark.parametrize(
    ("origin", "world"),
    [("ithor", "rooms"), ("robothor", "apartments"), ("procthor", "houses"), ("gibson", "houses"), ("mine", "rooms")],
)
def test_a_file_tells_its_world(tmp_path, origin, world):
    file = tmp_path / "scenes.jsonl.gz"
    write_scenes(file, [dataclasses.replace(coarse_scene(0), world=origin)])
    source = SceneSource(str(file))
    assert source.world_name == world
    assert source.task == WORLDS[world].task
    assert SceneSource(str(file), world="rooms").world_name == "rooms"  # what is asked for comes first


def test_a_generated_world_is_itself():
    assert SceneSource("apartments").world_name == "apartments"


def test_the_first_scene_that_can_be_used_decides(tmp_path):
    file = tmp_path / "scenes.jsonl"
    file.write_text("[]\n")
    assert SceneSource(str(file)).world_name == "rooms"
    with pytest.raises(InputError, match="cannot be read"):
        _ = SceneSource(str(tmp_path / "absent.jsonl.gz")).world_name
