"""Controller metadata to scenes: a small room worked out by hand, older releases, a replayed controller, bad input."""

import collections
import copy
import functools
import gzip
import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_scene_io import assert_equal

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor, scene_name, world_and_room_type
from jaxnav.scenes.files.importers.controller import read_controller
from jaxnav.scenes.files.scene_file import derive_walls, read_scenes, write_scenes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene

NO_RENDERER = {"center": {"x": 0.0, "y": 0.0, "z": 0.0}, "size": {"x": 0.0, "y": 0.0, "z": 0.0}, "cornerPoints": []}


def vector(x: float, y: float, z: float) -> dict:
    return {"x": x, "y": y, "z": z}


def thing(kind: str, x: float, y: float, z: float, size: tuple | None, yaw: float = 0.0, parents=None) -> dict:
    box = {"center": vector(x, y, z), "size": vector(*size), "cornerPoints": [[0.0] * 3] * 8} if size else None
    return {
        "objectId": f"{kind}|{x:+06.2f}|{y:+06.2f}|{z:+06.2f}",
        "objectType": kind,
        "position": vector(x, y, z),
        "rotation": vector(0.0, yaw, 0.0),
        "axisAlignedBoundingBox": box,
        "parentReceptacles": parents,
        "visible": False,
    }


# Nine places at x 0 to 0.5 and z -0.25 to 0.25. The agent is at y 1.15, so the floor is at y 1.15 - 0.9 = 0.25.
PLACES = [vector(0.25 * i, 1.15, 0.25 * j) for i in range(3) for j in (-1, 0, 1)]
TABLE = thing("DiningTable", 1.5, 0.65, 0.0, (1.0, 0.8, 1.2), 90.0, ["Floor|+00.00|+00.00|+00.00"])
DRAWER = thing("Drawer", 1.5, 0.75, 0.0, (0.4, 0.1, 0.4), 90.0, [TABLE["objectId"]])
BOOK = thing("Book", 1.5, 0.76, 0.1, None, 10.0, [DRAWER["objectId"], TABLE["objectId"], "Lamp|gone"])
FRIDGE = thing("Fridge", 0.0, 0.25, 1.5, None) | {"axisAlignedBoundingBox": NO_RENDERER}
METADATA = {
    "sceneName": "FloorPlan201_physics",
    "lastAction": "GetReachablePositions",
    "lastActionSuccess": True,
    "errorMessage": "",
    "agent": {"position": vector(0.0, 1.15, 0.0), "rotation": vector(0.0, 270.0, 0.0), "cameraHorizon": 30.0},
    "objects": [thing("Floor", 0.0, 0.0, 0.0, (4.0, 1.0, 4.0)), TABLE, DRAWER, BOOK, FRIDGE],
    "actionReturn": PLACES,
}


def changed(*keys_and_value: object) -> dict:
    """METADATA with the value at a path of keys replaced."""
    record = copy.deepcopy(METADATA)
    *keys, last, value = keys_and_value
    functools.reduce(lambda node, key: node[key], keys, record)[last] = value
    return record


def without(*keys: object) -> dict:
    record = copy.deepcopy(METADATA)
    *keys, last = keys
    del functools.reduce(lambda node, key: node[key], keys, record)[last]
    return record


@pytest.fixture
def read(tmp_path):
    def read_record(record: object) -> Scene | InputError:
        path = tmp_path / "room.json"
        path.write_text(json.dumps(record))
        (result,) = read_ai2thor(path, "val")
        return result

    return read_record


def test_a_room_worked_out_by_hand(read):
    scene = read(METADATA)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("FloorPlan201", "ithor", "living_room", "val")
    # Three cells of margin on each side of 3 x 3: 9 x 9, its corner 0.75 m left of x 0 and before z -0.25.
    assert scene.origin == (-0.75, -1.0)
    expected = np.zeros((9, 9), bool)
    expected[3:6, 3:6] = True
    np.testing.assert_array_equal(scene.reach, expected)
    assert len(standable_cells(scene.reach)) == 9
    np.testing.assert_array_equal(scene.walls, derive_walls(scene.reach, scene.origin, scene.boxes))
    assert scene.types == ("DiningTable", "Drawer", "Book", "Fridge")  # no Floor
    book, fridge = typical_box("Book")[:3], typical_box("Fridge")[:3]
    np.testing.assert_allclose(
        scene.boxes,
        [
            [1.5, 0.4, 0.0, 1.0, 0.8, 1.2],  # 0.65 - 0.25
            [1.5, 0.5, 0.0, 0.4, 0.1, 0.4],  # 0.75 - 0.25
            [1.5, 0.51, 0.1, *book],  # no box: at its pivot, 0.76 - 0.25, which is above half its height
            [0.0, fridge[1] / 2, 1.5, *fridge],  # box of size 0, pivot on the floor: it stands there
        ],
    )
    np.testing.assert_array_equal(scene.yaws, [90.0, 90.0, 10.0, 0.0])
    # The table rests on Floor, which is no object; the book lies in drawer and table, and the drawer is smaller.
    np.testing.assert_array_equal(scene.parents, [-1, 0, 1, -1])


def test_a_scene_survives_its_file(tmp_path, read):
    scene = read(METADATA)
    write_scenes(tmp_path / "scenes.jsonl.gz", [scene])
    (back,) = read_scenes(tmp_path / "scenes.jsonl.gz")
    assert_equal(back, scene)


@pytest.mark.parametrize(
    "record",
    [
        METADATA | {"reachablePositions": [], "actionReturn": PLACES},
        without("actionReturn") | {"reachablePositions": PLACES},
        METADATA | {"actionReturn": None, "reachablePositions": PLACES},
        {"metadata": METADATA | {"actionReturn": None}, "reachablePositions": PLACES},
        {"metadata": METADATA},
        changed("objects", {row["objectId"]: row for row in METADATA["objects"]}),
        changed("sceneName", "FloorPlan201"),
        METADATA | {"colors": [1, 2], "fov": 90.0},
    ],
)
def test_forms_of_other_releases_give_the_same_scene(read, record):
    assert_equal(read(record), read(METADATA))


def test_older_boxes_are_corners(read):
    # Low corner (1, 0.25, -0.5), high corner (2, 1.05, 0.7): centre (1.5, 0.65, 0.1), size (1, 0.8, 1.2).
    row = TABLE | {"axisAlignedBoundingBox": None, "bounds3D": [1.0, 0.25, -0.5, 2.0, 1.05, 0.7]}
    scene = read(changed("objects", [row]))
    np.testing.assert_allclose(scene.boxes, [[1.5, 0.4, 0.1, 1.0, 0.8, 1.2]])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("FloorPlan1", ("ithor", "kitchen")),
        ("FloorPlan30", ("ithor", "kitchen")),
        ("FloorPlan31", ("ai2thor", "other")),
        ("FloorPlan101", ("ai2thor", "other")),
        ("FloorPlan230", ("ithor", "living_room")),
        ("FloorPlan301", ("ithor", "bedroom")),
        ("FloorPlan430", ("ithor", "bathroom")),
        ("FloorPlan400", ("ai2thor", "other")),
        ("FloorPlan_Train12_5", ("robothor", "apartment")),
        ("FloorPlan_Val3_1", ("robothor", "apartment")),
        ("Procedural", ("procthor", "house")),
        ("ArchitecTHOR-Val-00", ("ai2thor", "other")),
    ],
)
def test_names_tell_world_and_room_type(name, expected):
    assert world_and_room_type(name) == expected


def test_suffix_of_names_is_dropped():
    assert [scene_name(name) for name in ("FloorPlan1_physics", "FloorPlan1", "_physics")] == [
        "FloorPlan1",
        "FloorPlan1",
        "_physics",
    ]


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        (without("sceneName"), "scene '(no name)': sceneName is missing"),
        (without("objects"), "objects is missing"),
        (without("actionReturn"), "actionReturn has no positions; save event.metadata right after GetReachable"),
        (changed("actionReturn", []), "actionReturn has no positions"),
        (changed("actionReturn", True), "actionReturn is True; give a list"),
        (changed("actionReturn", 4, 7), "actionReturn[4] is 7; give an object"),
        (changed("actionReturn", 4, "x", float("nan")), "actionReturn[4]: x is nan; give a finite number"),
        (changed("actionReturn", 4, "z", 0.1), "actionReturn holds [0.25, 0.1]; x and z must be multiples of 0.25"),
        (changed("actionReturn", 4, "x", 1e5), "actionReturn spans more than 500 m"),
        (changed("objects", []), "objects holds no object"),
        (changed("objects", METADATA["objects"][:1]), "objects holds no object"),  # the floor is none
        (changed("objects", "none"), "objects is 'none'; give a list"),
        (changed("objects", 1, None), "objects[1] is None; give an object"),
        (without("objects", 1, "objectId"), "objects[1]: objectId is missing"),
        (without("objects", 1, "objectType"), "objects[1]: objectType is missing"),
        (without("objects", 1, "rotation"), "objects[1]: rotation is missing"),
        (without("objects", 3, "position"), "objects[3]: position is missing"),
        (changed("objects", 1, "rotation", "y", None), "objects[1]: rotation: y is null"),
        (
            changed("objects", 1, "axisAlignedBoundingBox", "center", "y", float("inf")),
            "objects[1]: axisAlignedBoundingBox: center: y is inf",
        ),
        (without("objects", 1, "axisAlignedBoundingBox", "size"), "axisAlignedBoundingBox: size is missing"),
        (
            changed("objects", 1, "axisAlignedBoundingBox", "size", "x", -1.0),
            "objects[1]: axisAlignedBoundingBox has the size [-1.0, 0.8, 1.2]; a size is at least 0",
        ),
        (changed("objects", 3, "bounds3D", [0.0, 1.0]), "objects[3]: bounds3D is [0.0, 1.0]; give a list of 6"),
        (changed("objects", 3, "bounds3D", [0, 0, 0, -1, 1, 1]), "objects[3]: bounds3D has the size [-1.0, 1.0, 1.0]"),
        (changed("objects", 3, "parentReceptacles", "Shelf"), "objects[3]: parentReceptacles is 'Shelf'; give a list"),
        ({"metadata": 3}, "metadata is 3; give an object"),
        ([METADATA], "give an object"),
    ],
)
def test_bad_records_are_refused_with_their_place(tmp_path, read, record, problem):
    result = read(record)
    assert isinstance(result, InputError)
    assert str(result).startswith(str(tmp_path / "room.json"))
    assert problem in str(result)
    if isinstance(record, dict) and "sceneName" in record:
        assert "scene 'FloorPlan201_physics'" in str(result)


def test_the_other_records_of_a_file_are_imported(tmp_path):
    path = tmp_path / "rooms.jsonl.gz"
    lines = [json.dumps(record) for record in (METADATA, without("objects"), changed("sceneName", "FloorPlan2"))]
    path.write_bytes(gzip.compress("\n".join([*lines, '{"sceneName": "Flo']).encode()))
    first, second, third, last = read_ai2thor(path, "train")
    assert (first.name, third.name) == ("FloorPlan201", "FloorPlan2")
    assert str(second) == f"{path}, line 2, scene 'FloorPlan201_physics': objects is missing; add it"
    assert str(last).startswith(f"{path}, line 4: not JSON")


def test_the_other_files_of_a_folder_are_imported(tmp_path):
    (tmp_path / "b.json").write_text(json.dumps(METADATA))
    (tmp_path / "a.json.gz").write_bytes(gzip.compress(json.dumps(METADATA).encode())[:-20])
    (tmp_path / "c.pkl").write_bytes(b"not opened")
    broken, scene = read_ai2thor(tmp_path, "train")
    assert "a.json.gz: is cut short or damaged" in str(broken)
    assert scene.name == "FloorPlan201"


def test_paths_without_any_record_are_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.jsonl").touch()
    for name, problem in {
        "none.json": "cannot be read",
        "empty.jsonl": "no record",
        "folder": "no file .json,",
    }.items():
        with pytest.raises(InputError, match=problem):
            list(read_ai2thor(tmp_path / name, "train"))


def test_files_cut_short_anywhere_are_refused(tmp_path):
    content = gzip.compress(json.dumps(METADATA).encode(), mtime=0)
    path = tmp_path / "room.json.gz"
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"cut short|not JSON"):
            raise next(read_ai2thor(path, "train"))


class FakeController:
    """Replays recorded metadata through the methods of `ai2thor.controller.Controller` that are used."""

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
    APARTMENT: changed("sceneName", APARTMENT),
    "FloorPlan3": changed("objects", 1, "rotation", 4),
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


def test_a_controller_gives_what_its_saved_metadata_gives(read, controllers, factory):
    scenes = list(read_controller(["FloorPlan201", APARTMENT], "val", factory))
    assert_equal(scenes[0], read(METADATA))
    assert_equal(scenes[1], read(RECORDINGS[APARTMENT]))
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
    assert scene.name == "FloorPlan201"
    assert controllers[0].stops == 1


def test_a_controller_is_stopped_whatever_happens(controllers, factory):
    with pytest.raises(RuntimeError, match="Unity crashed"):
        list(read_controller(["FloorPlan201", "FloorPlan5"], "val", factory))
    scenes = read_controller(["FloorPlan201", "FloorPlan201"], "val", factory)
    next(scenes)
    scenes.close()
    assert [controller.stops for controller in controllers] == [1, 1]


def test_the_installed_package_is_used(monkeypatch, factory):
    monkeypatch.setitem(sys.modules, "ai2thor", types.ModuleType("ai2thor"))
    monkeypatch.setitem(sys.modules, "ai2thor.controller", types.SimpleNamespace(Controller=factory))
    (scene,) = read_controller(["FloorPlan201"], "val")
    assert scene.name == "FloorPlan201"


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ai2thor", None)
    with pytest.raises(InputError, match=r"--from-controller: .*pip install ai2thor"):
        next(read_controller(["FloorPlan201"], "val"))


JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=4)
    | st.sampled_from([float("nan"), 1e308, 10**400, -1.0, "Floor", "\ud800"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=6,
)


def mutate(data: st.DataObject, value: object) -> object:
    """A copy of a JSON value with something at a random path deleted or replaced."""
    root = node = copy.deepcopy(value)
    while True:
        key = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(len(node))))
        if not isinstance(node[key], dict | list) or not node[key] or data.draw(st.integers(0, 4)) == 0:
            break
        node = node[key]
    if data.draw(st.booleans()):
        del node[key]
    else:
        node[key] = data.draw(JSON_VALUES)
    return root


def check_outcomes(results: list, outcomes: collections.Counter, path: Path) -> None:
    """Every result is a scene that a scene file can hold, or an error that names its file."""
    for result in results:
        outcomes[type(result)] += 1
        if isinstance(result, InputError):
            assert str(result).startswith(str(path))
        else:
            write_scenes(path.parent / "fuzzed.jsonl.gz", [result])
            assert_equal(read_scenes(path.parent / "fuzzed.jsonl.gz")[0], result)


def test_mutated_records_are_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "rooms.jsonl"

    @given(st.data())
    def check(data):
        path.write_text(json.dumps(mutate(data, METADATA)) + "\n" + json.dumps(METADATA))
        results = list(read_ai2thor(path, "train"))
        check_outcomes(results[:1], outcomes, path)
        assert isinstance(results[1], Scene)

    check()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_mutated_text_is_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    text, path = json.dumps(METADATA), tmp_path / "room.json"

    @given(st.integers(0, len(text)), st.integers(0, 20), st.text('[]{}",.:-0123456789eN\\u ', max_size=6))
    def check(at, length, inserted):
        path.write_text(text[:at] + inserted + text[at + length :])
        check_outcomes(list(read_ai2thor(path, "train")), outcomes, path)

    check()
    assert outcomes[InputError] >= 10


@pytest.mark.parametrize("text", ["[" * 100_000, '{"objects":' * 900 + "1" + "}" * 900, '{"sceneName": "\\ud800"}', ""])
def test_strange_texts_are_refused(tmp_path, text):
    path = tmp_path / "room.json"
    path.write_text(text)
    (result,) = read_ai2thor(path, "train")
    assert isinstance(result, InputError)
