"""Objects of ProcTHOR houses: types, sizes and parents."""

import numpy as np
import pytest
from support.importer_inputs.procthor import ASSET_LISTS, BOWL, HOUSE, TABLE, item
from support.lattice import block, points_of
from support.mutations import changed
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.generate.sizes import typical_box


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"objectType": "ObjaTrashCan", "id": "Bowl|2|0", "assetId": "Bowl_1"}, "ObjaTrashCan"),
        ({"id": "Mug|surface|2|0", "assetId": "Bowl_1"}, "Bowl"),  # the asset database goes before the id
        ({"id": "Mug|surface|2|0", "assetId": "Mug_3"}, "Mug"),
        ({"id": "RemoteControl|2|0", "assetId": "Remote_1"}, "RemoteControl"),
        ({"id": "small|2|0", "assetId": "Alarm_Clock_12"}, "AlarmClock"),
        ({"id": "2|0|1", "assetId": "Dining_Table_27_2"}, "DiningTable"),
    ],
)
def test_types_come_from_the_first_name_that_tells(scene_of, fields, expected):
    scene = scene_of(changed(HOUSE, "objects", 0, "children", 0, BOWL | fields))
    assert scene.types == ("DiningTable", expected)


def test_sizes_come_from_the_asset_database_turned_or_are_typical(scene_of):
    turned = scene_of(changed(HOUSE, "objects", 0, "rotation", "y", -30.0))
    # 1.0 x 0.6 m turned by 30 degrees: cos 30 + 0.6 sin 30 = 1.16603 by sin 30 + 0.6 cos 30 = 1.01962.
    np.testing.assert_allclose(turned.boxes[0, 3:], [1.16603, 0.8, 1.01962], atol=1e-5)
    typical = scene_of(changed(HOUSE, "objects", 0, "rotation", "y", -30.0), None)
    assert typical.boxes[0].tolist() == [4.5, 0.4, 1.5, *typical_box("DiningTable")[:3]]
    assert_scenes_equal(scene_of(HOUSE, ASSET_LISTS), scene_of(HOUSE))
    assert_scenes_equal(scene_of(HOUSE, {"Bowl_1": {"boundingBox": None}}), scene_of(HOUSE, None))


def test_children_follow_their_parents(scene_of):
    book = item("Book|3|3", "Book_1", 4.5, 0.9, 1.5)
    chair = item("Chair|3|2", "Chair_1", 5.5, 0.5, 2.5, children=[book])
    table = TABLE | {"children": [BOWL | {"children": [book]}, chair]}
    scene = scene_of(changed(HOUSE, "objects", [table, book]))
    assert scene.types == ("DiningTable", "Bowl", "Book", "Chair", "Book", "Book")
    assert scene.parents.tolist() == [-1, 0, 1, 0, 3, -1]
    # A typical chair is 0.56 m wide, so the corner x 5.22-5.78, z 2.22-2.78 is taken although the chair is a child.
    assert points_of(scene, scene.reach) & block(5.25, 5.75, 2.25, 2.75) == set()
