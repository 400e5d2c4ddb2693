"""Controller metadata to scenes, worked out by hand."""

import numpy as np
import pytest
from support.importer_inputs.ai2thor import METADATA, PLACES, TABLE
from support.mutations import changed, without
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.files.importers.ai2thor import strip_physics_suffix, world_and_room_type
from jaxnav.scenes.files.scene_file import derive_walls, read_scenes, write_scenes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells


def test_a_room_worked_out_by_hand(read_metadata):
    scene = read_metadata(METADATA)
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


def test_a_scene_survives_its_file(tmp_path, read_metadata):
    scene = read_metadata(METADATA)
    write_scenes(tmp_path / "scenes.jsonl.gz", [scene])
    (back,) = read_scenes(tmp_path / "scenes.jsonl.gz")
    assert_scenes_equal(back, scene)


@pytest.mark.parametrize(
    "record",
    [
        METADATA | {"reachablePositions": [], "actionReturn": PLACES},
        without(METADATA, "actionReturn") | {"reachablePositions": PLACES},
        METADATA | {"actionReturn": None, "reachablePositions": PLACES},
        {"metadata": METADATA | {"actionReturn": None}, "reachablePositions": PLACES},
        {"metadata": METADATA},
        changed(METADATA, "objects", {row["objectId"]: row for row in METADATA["objects"]}),
        changed(METADATA, "sceneName", "FloorPlan201"),
        METADATA | {"colors": [1, 2], "fov": 90.0},
    ],
)
def test_forms_of_other_releases_give_the_same_scene(read_metadata, record):
    assert_scenes_equal(read_metadata(record), read_metadata(METADATA))


def test_older_boxes_are_corners(read_metadata):
    # Low corner (1, 0.25, -0.5), high corner (2, 1.05, 0.7): centre (1.5, 0.65, 0.1), size (1, 0.8, 1.2).
    row = TABLE | {"axisAlignedBoundingBox": None, "bounds3D": [1.0, 0.25, -0.5, 2.0, 1.05, 0.7]}
    scene = read_metadata(changed(METADATA, "objects", [row]))
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
    assert [strip_physics_suffix(name) for name in ("FloorPlan1_physics", "FloorPlan1", "_physics")] == [
        "FloorPlan1",
        "FloorPlan1",
        "_physics",
    ]
