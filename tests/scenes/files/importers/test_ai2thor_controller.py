"""Import from a running AI2-THOR controller, with recorded metadata in its place."""

import sys
import types
from collections.abc import Generator

import pytest
from support.importer_inputs.ai2thor import METADATA
from support.mutations import changed
from support.refusals import assert_message_names
from support.scene_records import as_scene, assert_scenes_equal, without_counts

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_controller


class FakeController:
    """Replay recorded metadata, as `ai2thor.controller.Controller` gives it."""

    def __init__(self, recordings: dict[str, dict], **settings: object):
        self.recordings = recordings
        self.settings = settings
        self.scene = "FloorPlan9"
        self.num_stops = 0
        self.resets = []

    def reset(self, scene: str, **settings: object) -> None:
        if scene not in self.recordings:
            raise ValueError(f"\nScene '{scene}' not contained in build.\nPlease choose one of:\n\nFloorPlan1_physics")
        self.scene = scene
        self.resets.append((scene, settings["agentMode"]))

    def step(self, action: str) -> types.SimpleNamespace:
        assert action == "GetReachablePositions"
        if not self.recordings[self.scene]:
            raise RuntimeError("Unity crashed")
        return types.SimpleNamespace(metadata=self.recordings[self.scene])

    def stop(self) -> None:
        self.num_stops += 1


APARTMENT = "FloorPlan_Train1_1"
RECORDINGS = {
    "FloorPlan201": METADATA,
    APARTMENT: changed(METADATA, "sceneName", APARTMENT),
    "FloorPlan3": changed(METADATA, "objects", 1, "rotation", 4),
    "FloorPlan4": METADATA | {"lastActionSuccess": False, "actionReturn": None, "errorMessage": "out of bounds"},
    "FloorPlan5": {},
}


@pytest.fixture
def made_controllers():
    return []


@pytest.fixture
def make_controller(made_controllers):
    """Return a maker of controllers, which are listed in `controllers`."""

    def make_controller(**settings: object) -> FakeController:
        made_controllers.append(FakeController(RECORDINGS, **settings))
        return made_controllers[-1]

    return make_controller


def test_read_controller_equals_the_import_of_saved_metadata(read_metadata, made_controllers, make_controller):
    scenes = without_counts(read_controller(["FloorPlan201", APARTMENT], "val", make_controller))
    assert_scenes_equal(scenes[0], read_metadata(METADATA))
    assert_scenes_equal(scenes[1], read_metadata(RECORDINGS[APARTMENT]))

    # One controller has read both scenes.
    (controller,) = made_controllers
    assert controller.settings["gridSize"] == 0.25
    assert controller.resets == [("FloorPlan201", "default"), (APARTMENT, "locobot")]
    assert controller.num_stops == 1


def test_read_controller_reports_bad_scenes_and_imports_the_rest(made_controllers, make_controller):
    names = ["FloorPlan999", "FloorPlan3", "FloorPlan4", "FloorPlan201"]
    unknown_scene, bad_field, failed_action, scene = without_counts(read_controller(names, "val", make_controller))
    assert_message_names(unknown_scene, "controller, 'FloorPlan999': ", "Give the name")
    assert "FloorPlan1_physics" not in str(unknown_scene)
    assert_message_names(bad_field, "objects[1]: rotation ")
    assert_message_names(failed_action, "'FloorPlan4': ", "GetReachablePositions", "out of bounds")
    assert as_scene(scene).name == "FloorPlan201"
    assert made_controllers[0].num_stops == 1


def test_read_controller_stops_the_controller_on_errors_and_early_exit(made_controllers, make_controller):
    # The first controller fails.
    with pytest.raises(RuntimeError, match="Unity crashed"):
        list(read_controller(["FloorPlan201", "FloorPlan5"], "val", make_controller))

    # The second one is no longer needed.
    scenes = read_controller(["FloorPlan201", "FloorPlan201"], "val", make_controller)
    next(scenes)
    assert isinstance(scenes, Generator)
    scenes.close()
    assert [controller.num_stops for controller in made_controllers] == [1, 1]


def test_read_controller_uses_the_installed_package(monkeypatch, make_controller):
    monkeypatch.setitem(sys.modules, "ai2thor", types.ModuleType("ai2thor"))
    monkeypatch.setitem(sys.modules, "ai2thor.controller", types.SimpleNamespace(Controller=make_controller))
    (scene,) = without_counts(read_controller(["FloorPlan201"], "val"))
    assert as_scene(scene).name == "FloorPlan201"


def test_read_controller_names_a_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "ai2thor", None)
    with pytest.raises(InputError, match=r"--from-controller.*pip install ai2thor"):
        next(read_controller(["FloorPlan201"], "val"))
