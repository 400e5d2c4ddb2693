"""Import of AI2-THOR controller metadata, worked out by hand."""

import numpy as np
import pytest
from support.importer_inputs.ai2thor import METADATA, PLACES, TABLE, thing
from support.mutations import changed, without
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.files.importers.ai2thor import strip_physics_suffix, world_and_room_type
from jaxnav.scenes.files.scene_file import derive_walls
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells


def test_read_ai2thor_imports_a_room_worked_out_by_hand(read_metadata):
    scene = read_metadata(METADATA)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("FloorPlan201", "ithor", "living_room", "val")

    # Three cells of margin on each side of 3 x 3: 9 x 9, its corner 0.75 m left of x 0 and before z -0.25.
    assert scene.origin == (-0.75, -1.0)
    expected_reach = np.zeros((9, 9), bool)
    expected_reach[3:6, 3:6] = True
    np.testing.assert_array_equal(scene.reach, expected_reach)
    assert len(standable_cells(scene.reach)) == 9
    np.testing.assert_array_equal(scene.walls, derive_walls(scene.reach, scene.origin, scene.boxes))

    # Objects without a box have the typical size of their type; the floor is no object.
    assert scene.types == ("DiningTable", "Drawer", "Book", "Fridge")
    book_size = typical_box("Book")[:3]
    fridge_size = typical_box("Fridge")[:3]
    np.testing.assert_allclose(
        scene.boxes,
        [
            [1.5, 0.4, 0.0, 1.0, 0.8, 1.2],  # 0.65 - 0.25
            [1.5, 0.5, 0.0, 0.4, 0.1, 0.4],  # 0.75 - 0.25
            [1.5, 0.51, 0.1, *book_size],  # no box: at its pivot, 0.76 - 0.25, which is above half its height
            [0.0, fridge_size[1] / 2, 1.5, *fridge_size],  # box of size 0, pivot on the floor: it stands there
        ],
    )
    np.testing.assert_array_equal(scene.yaws, [90.0, 90.0, 10.0, 0.0])

    # The table rests on Floor, which is no object; the book lies in drawer and table, and the drawer is smaller.
    np.testing.assert_array_equal(scene.parents, [-1, 0, 1, -1])


@pytest.mark.parametrize(
    "record",
    [
        METADATA | {"reachablePositions": [], "actionReturn": PLACES},
        without(METADATA, "actionReturn") | {"reachablePositions": PLACES},
        METADATA | {"actionReturn": None, "reachablePositions": PLACES},
        {"metadata": METADATA | {"actionReturn": None}, "reachablePositions": PLACES},
        {"metadata": METADATA},
        changed(METADATA, "objects", {table_row["objectId"]: table_row for table_row in METADATA["objects"]}),
        changed(METADATA, "sceneName", "FloorPlan201"),
        METADATA | {"colors": [1, 2], "fov": 90.0},
    ],
)
def test_read_ai2thor_imports_the_forms_of_other_releases(read_metadata, record):
    assert_scenes_equal(read_metadata(record), read_metadata(METADATA))


def test_read_ai2thor_reads_older_boxes_as_corners(read_metadata):
    # Low corner (1, 0.25, -0.5), high corner (2, 1.05, 0.7): centre (1.5, 0.65, 0.1), size (1, 0.8, 1.2).
    table_row = TABLE | {"axisAlignedBoundingBox": None, "bounds3D": [1.0, 0.25, -0.5, 2.0, 1.05, 0.7]}
    scene = read_metadata(changed(METADATA, "objects", [table_row]))
    np.testing.assert_allclose(scene.boxes, [[1.5, 0.4, 0.1, 1.0, 0.8, 1.2]])


def test_read_ai2thor_tells_receptacles_of_one_id_apart_by_place(read_metadata):
    # Two tables of one id, and a book on each.
    tables = [changed(TABLE, "axisAlignedBoundingBox", "center", "z", z) for z in (0.0, 5.0)]
    books = [thing("Book", 1.5, 1.05, z, (0.2, 0.1, 0.2), parents=[TABLE["objectId"]]) for z in (0.1, 5.1)]
    scene = read_metadata(changed(METADATA, "objects", [*tables, *books]))
    assert scene.parents.tolist() == [-1, -1, 0, 1]


@pytest.mark.parametrize(
    ("scene_name", "world_and_type"),
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
def test_world_and_room_type_follow_from_the_scene_name(scene_name, world_and_type):
    assert world_and_room_type(scene_name) == world_and_type


@pytest.mark.parametrize(
    ("scene_name", "stripped_name"),
    [("FloorPlan1_physics", "FloorPlan1"), ("FloorPlan1", "FloorPlan1"), ("_physics", "_physics")],
)
def test_strip_physics_suffix_keeps_the_rest_of_the_name(scene_name, stripped_name):
    assert strip_physics_suffix(scene_name) == stripped_name
