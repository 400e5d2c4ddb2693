"""World that supplies the categories and rules for a file of scenes."""

import dataclasses

import pytest
from support.scenes import coarse_scene

from jaxnav.errors import InputError
from jaxnav.scenes import worlds
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import Rules, Task
from jaxnav.scenes.worlds import WORLDS, FileScenes, SceneSource, load_scenes


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


def test_a_file_is_read_once(tmp_path, monkeypatch):
    """Scenes and identity are those of one content, though the file may be replaced between two reads."""
    scene_file = tmp_path / "scenes.jsonl.gz"
    write_scenes(scene_file, [coarse_scene(0)])
    reads = []
    read_bytes = worlds.read_bytes
    monkeypatch.setattr(worlds, "read_bytes", lambda path: reads.append(path) or read_bytes(path))
    monkeypatch.setattr("jaxnav.scenes.files.scene_file.read_bytes", lambda path: pytest.fail("read again"))
    load_scenes(scene_file, None)
    assert reads == [scene_file]


def test_rare_room_types_are_among_the_fitted_scenes():
    # Of 300 rooms an even spread of 100 leaves out the one at index 1.
    kitchen, bathroom = (
        dataclasses.replace(coarse_scene(0), room_type=room_type) for room_type in ("kitchen", "bathroom")
    )
    fitted_types = []

    def fit(scenes, task):
        fitted_types.extend(scene.room_type for scene in scenes)
        return {"kitchen": ((0, 1),)}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worlds, "fit_context_exchange", fit)
        worlds.fit_scene_exchange(FileScenes((kitchen, bathroom, *[kitchen] * 298), "file"), WORLDS["rooms"].task)
    assert (fitted_types.count("bathroom"), len(fitted_types)) == (1, 101)


@pytest.mark.parametrize(
    ("task", "problem"),
    [
        (Task(("Sofa", "Bed", "Sofa")), "Task.categories: 'Sofa' occurs more than once"),
        (Task(("Sofa", "Bed"), ("Sofa", "Bedd")), "Task.goals: 'Bedd' is no category; choose from Sofa, Bed"),
        (Task(("Sofa", "Bed"), detector=Detector(miss_near=float("nan"))), "Task.detector.miss_near nan"),
    ],
)
def test_impossible_tasks_are_refused_when_scenes_are_compiled(task, problem):
    with pytest.raises(InputError, match=f"^{problem}"):
        compile_bank([coarse_scene(0)], task)


@pytest.mark.parametrize("rules", [{"headings": 0}, {"headings": 4.0}, {"success": "Seen"}, {"front_cell": "moves"}])
def test_impossible_rules_are_refused(rules):
    with pytest.raises(InputError, match=f"^Rules.{next(iter(rules))} "):
        Rules(**rules)


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
