"""Objects of ProcTHOR houses: types, sizes and parents."""

import gzip
import json

import numpy as np
import pytest
from support.importer_inputs.procthor import ASSET_LISTS, BOWL, HOUSE, TABLE, item
from support.mutations import changed
from support.real_scenes import PROCTHOR, require
from support.scene_geometry import block, points_of
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.files.importers.procthor import AssetInfo, read_assets, read_objects
from jaxnav.scenes.files.scene_file import JsonRecord
from jaxnav.scenes.generate.sizes import typical_box


@pytest.mark.parametrize(
    ("bowl_fields", "expected_type"),
    [
        ({"objectType": "ObjaTrashCan", "id": "Bowl|2|0", "assetId": "Bowl_1"}, "GarbageCan"),
        ({"objectType": "ObjaBucket", "id": "Bowl|2|0", "assetId": "Bowl_1"}, "ObjaBucket"),
        ({"id": "Mug|surface|2|0", "assetId": "Bowl_1"}, "Bowl"),  # the asset database goes before the id
        ({"id": "Mug|surface|2|0", "assetId": "Mug_3"}, "Mug"),
        ({"id": "RemoteControl|2|0", "assetId": "Remote_1"}, "RemoteControl"),
        ({"id": "small|2|0", "assetId": "Alarm_Clock_12"}, "AlarmClock"),
        ({"id": "2|0|1", "assetId": "Dining_Table_27_2"}, "DiningTable"),
    ],
)
def test_read_procthor_takes_types_from_the_first_informative_name(house_scene, bowl_fields, expected_type):
    scene = house_scene(changed(HOUSE, "objects", 0, "children", 0, BOWL | bowl_fields))
    assert scene.types == ("DiningTable", expected_type)


def test_read_procthor_takes_sizes_from_the_asset_database_or_typical_ones(house_scene):
    # Sizes of the database are turned with the object.
    turned_house = changed(HOUSE, "objects", 0, "rotation", "y", -30.0)
    turned_scene = house_scene(turned_house)
    # 1.0 x 0.6 m turned by 30 degrees: cos 30 + 0.6 sin 30 = 1.16603 by sin 30 + 0.6 cos 30 = 1.01962.
    np.testing.assert_allclose(turned_scene.boxes[0, 3:], [1.16603, 0.8, 1.01962], atol=1e-5)

    # Typical sizes are not.
    typical_scene = house_scene(turned_house, None)
    assert typical_scene.boxes[0].tolist() == [4.5, 0.4, 1.5, *typical_box("DiningTable")[:3]]

    # A database may list assets by type, or lack boxes.
    assert_scenes_equal(house_scene(HOUSE, ASSET_LISTS), house_scene(HOUSE))
    assert_scenes_equal(house_scene(HOUSE, {"Bowl_1": {"boundingBox": None}}), house_scene(HOUSE, None))


L = "Countertop_L_10x8"
C = "Countertop_C_8x6"


@pytest.mark.parametrize(
    ("asset_name", "yaw", "strip_boxes"),
    [
        # L at yaw 0, 3.0 x 2.4 m around (10, 20): along low z, 0.61 m deep, and along high x, the other 1.79 m.
        (L, 0.0, [(10.0, 19.105, 3.0, 0.61), (11.195, 20.305, 0.61, 1.79)]),
        # Turned clockwise by 90 degrees, +z comes to +x and +x to -z: along low x, and along low z.
        (L, 90.0, [(9.105, 20.0, 0.61, 3.0), (10.305, 18.805, 1.79, 0.61)]),
        (L, 180.0, [(10.0, 20.895, 3.0, 0.61), (8.805, 19.695, 0.61, 1.79)]),
        # C at yaw 0, 2.4 x 1.8 m: along low z, high x and low x.
        (C, 0.0, [(10.0, 19.405, 2.4, 0.61), (10.895, 20.305, 0.61, 1.19), (9.105, 20.305, 0.61, 1.19)]),
        ("Countertop_I_8x6", 0.0, [(10.0, 20.0, 2.4, 1.8)]),
    ],
)
def test_read_objects_divides_corner_counters_into_strips(asset_name, yaw, strip_boxes):
    # A counter with a pot on it, at a height of 0.9 m.
    counter_size = {"L": [3.0, 0.9, 2.4], "C": [2.4, 0.9, 1.8], "I": [2.4, 0.9, 1.8]}[asset_name[11]]
    pot = item("Pot|2|1", "Pot_1", 10.0, 1.0, 19.3)
    counter = item("CounterTop|2|0", asset_name, 10.0, 0.45, 20.0, yaw, children=[pot])
    asset_database = {asset_name: AssetInfo("CounterTop", counter_size)}
    house_things = read_objects(JsonRecord("house", {"objects": [counter]}), asset_database).objects

    # The boxes are those of the strips.
    boxes = np.array([thing.box for thing in house_things[:-1]])
    np.testing.assert_allclose(boxes[:, [0, 2, 3, 5]], strip_boxes, atol=1e-9)
    np.testing.assert_allclose(boxes[:, [1, 4]], [(0.45, 0.9)] * len(strip_boxes))

    # Further strips rest on the first, as the pot does.
    assert [thing.parent for thing in house_things] == [-1] + [0] * len(strip_boxes)
    assert [thing.type for thing in house_things] == ["CounterTop"] * len(strip_boxes) + ["Pot"]


def test_read_objects_puts_items_of_real_counters_on_their_strips():
    assets = read_assets(require(PROCTHOR / "asset-database.json"))
    num_corner_counters = 0
    num_items = 0
    for house_set in ("100k", "ai2", "objaverse"):
        for line in gzip.decompress((PROCTHOR / f"houses_{house_set}.jsonl.gz").read_bytes()).splitlines():
            house_things = read_objects(JsonRecord("house", json.loads(line)), assets).objects
            boxes = np.array([thing.box for thing in house_things])[:, [0, 2, 3, 5]]
            parents = np.array([thing.parent for thing in house_things])
            is_counter = np.array([thing.type == "CounterTop" for thing in house_things])

            # A counter around a corner is the parent of its further strips.
            for first_strip in set(parents[is_counter & (parents >= 0)].tolist()):
                on_counter = parents == first_strip
                strip_boxes = boxes[[first_strip, *np.flatnonzero(is_counter & on_counter)]]
                item_boxes = boxes[~is_counter & on_counter]
                distance_outside = np.abs(item_boxes[:, None, :2] - strip_boxes[:, :2]) - strip_boxes[:, 2:] / 2
                assert (distance_outside.max(axis=2).min(axis=1) <= 0).all()
                num_corner_counters += 1
                num_items += len(item_boxes)
    assert (num_corner_counters, num_items) == (83, 1093)


def test_read_objects_reads_counter_sizes_in_feet_from_names():
    counter = item("CounterTop|2|0", "Countertop_Island_10x3", 10.0, 0.47, 20.0)
    house_objects = read_objects(JsonRecord("house", {"objects": [counter]}), {})
    # 10 and 3 feet of 0.305 m.
    assert house_objects.objects[0].box == pytest.approx((10.0, 0.47, 20.0, 3.05, 0.94, 0.915))
    assert (house_objects.num_guessed_types, house_objects.num_guessed_sizes) == (0, 0)


def test_read_procthor_lists_children_after_their_parents(house_scene):
    book = item("Book|3|3", "Book_1", 4.5, 0.9, 1.5)
    chair = item("Chair|3|2", "Chair_1", 5.5, 0.5, 2.5, children=[book])
    table = TABLE | {"children": [BOWL | {"children": [book]}, chair]}
    scene = house_scene(changed(HOUSE, "objects", [table, book]))
    assert scene.types == ("DiningTable", "Bowl", "Book", "Chair", "Book", "Book")
    assert scene.parents.tolist() == [-1, 0, 1, 0, 3, -1]

    # A typical chair is 0.56 m wide, so the corner x 5.22-5.78, z 2.22-2.78 is taken although the chair is a child.
    assert points_of(scene, scene.reach) & block(5.25, 5.75, 2.25, 2.75) == set()
