"""Scenes of a running simulator, which a recording stands for."""

import sys
import types
from collections.abc import Generator

import pytest
from support.importer_inputs.ai2thor import METADATA
from support.mutations import changed
from support.scene_records import as_scene, assert_scenes_equal

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_controller


class FakeController:
    """Replay recorded metadata, as `ai2thor.controller.Controller` gives it."""

    def __init__(self, recordings: dict[str, dict], **settings: object):
        self.recordings, self.settings = recordings, settings
        self.scene, self.stops, self.resets = "FloorPlan9", 0, []

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
        self.stops += 1


APARTMENT = "FloorPlan_Train1_1"
RECORDINGS = {
    "FloorPlan201": METADATA,
    APARTMENT: changed(METADATA, "sceneName", APARTMENT),
    "FloorPlan3": changed(METADATA, "objects", 1, "rotation", 4),
    "FloorPlan4": METADATA | {"lastActionSuccess": False, "actionReturn": None, "errorMessage": "out of bounds"},
    "FloorPlan5": {},
}


@pytest.fixture
def controllers():
    return []


@pytest.fixture
def factory(controllers):
    def make(**settings: object) -> FakeController:
        controllers.append(FakeController(RECORDINGS, **settings))
        return controllers[-1]

    return make


def test_a_controller_gives_what_its_saved_metadata_gives(read_metadata, controllers, factory):
    scenes = list(read_controller(["FloorPlan201", APARTMENT], "val", factory))
    assert_scenes_equal(scenes[0], read_metadata(METADATA))
    assert_scenes_equal(scenes[1], read_metadata(RECORDINGS[APARTMENT]))
    (controller,) = controllers
    assert controller.settings["gridSize"] == 0.25
    assert controller.resets == [("FloorPlan201", "default"), (APARTMENT, "locobot")]
    assert controller.stops == 1


def test_bad_scenes_of_a_controller_leave_the_others(controllers, factory):
    unknown, field, failed, scene = read_controller(
        ["FloorPlan999", "FloorPlan3", "FloorPlan4", "FloorPlan201"], "val", factory
    )
    expected = "controller, 'FloorPlan999': Scene 'FloorPlan999' not contained in build. Give the name"
    assert str(unknown).startswith(expected)
    assert "FloorPlan1_physics" not in str(unknown)
    assert "objects[1]: rotation is 4" in str(field)
    assert "'FloorPlan4': GetReachablePositions failed (out of bounds)" in str(failed)
    assert as_scene(scene).name == "FloorPlan201"
    assert controllers[0].stops == 1


def test_a_controller_is_stopped_whatever_happens(controllers, factory):
    with pytest.raises(RuntimeError, match="Unity crashed"):
        list(read_controller(["FloorPlan201", "FloorPlan5"], "val", factory))
    scenes = read_controller(["FloorPlan201", "FloorPlan201"], "val", factory)
    next(scenes)
    assert isinstance(scenes, Generator)
    scenes.close()
    assert [controller.stops for controller in controllers] == [1, 1]


def test_the_installed_package_is_used(monkeypatch, factory):
    monkeypatch.setitem(sys.modules, "ai2thor", types.ModuleType("ai2thor"))
    monkeypatch.setitem(sys.modules, "ai2thor.controller", types.SimpleNamespace(Controller=factory))
    (scene,) = read_controller(["FloorPlan201"], "val")
    assert as_scene(scene).name == "FloorPlan201"


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ai2thor", None)
    with pytest.raises(InputError, match=r"--from-controller: .*pip install ai2thor"):
        next(read_controller(["FloorPlan201"], "val"))
