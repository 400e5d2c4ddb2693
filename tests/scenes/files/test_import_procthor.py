"""ProcTHOR houses to scenes: two rooms worked out by hand, other houses, random ones by brute force, bad input."""

import collections
import copy
import dataclasses
import functools
import gzip
import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from test_import_ai2thor import check_outcomes, mutate
from test_scene_io import assert_equal

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers import polygons
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.generate.sizes import typical_box
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene

FOUR, EIGHT = ndimage.generate_binary_structure(2, 1), ndimage.generate_binary_structure(2, 2)  # neighbours


def point(x: float, y: float, z: float) -> dict:
    return {"x": x, "y": y, "z": z}


def wall(owner: object, a: tuple, b: tuple) -> dict:
    """A wall drawn from a to b (x, z); copies for the outside list the ceiling first, and ids the smaller end."""
    low, high = sorted([a, b])
    floor, ceiling = [[point(x, y, z) for x, z in (a, b)] for y in (0, 3)]
    return {
        "id": f"wall|{owner}|{low[0]:.2f}|{low[1]:.2f}|{high[0]:.2f}|{high[1]:.2f}",
        "roomId": "exterior" if owner == "exterior" else f"room|{owner}",
        "polygon": ceiling + floor if owner == "exterior" else floor + ceiling,
    }


def build(*rooms: tuple[str, list], doors: tuple = (), objects: tuple = (), agent: tuple = (5.0, 0.5)) -> dict:
    """A house of rooms (type, corners (x, z)) numbered from 2; edges of one room alone have a copy for the outside."""
    edges = [
        (2 + i, a, b) for i, (_, corners) in enumerate(rooms) for a, b in itertools.pairwise([*corners, corners[0]])
    ]
    count = collections.Counter(frozenset((a, b)) for _, a, b in edges)
    outside = [("exterior", b, a) for _, a, b in edges if count[frozenset((a, b))] == 1]
    return {
        "rooms": [
            {"id": f"room|{2 + i}", "roomType": kind, "floorPolygon": [point(x, 0, z) for x, z in corners]}
            for i, (kind, corners) in enumerate(rooms)
        ],
        "walls": [wall(*edge) for edge in edges + outside],
        "doors": list(doors),
        "windows": [{"id": "window|2|0", "room0": "room|2", "room1": "room|2", "wall0": "anything"}],
        "objects": list(objects),
        "proceduralParameters": {"skyboxId": "SkySFGarden"},
        "metadata": {"agent": {"position": point(agent[0], 0.95, agent[1]), "horizon": 30}, "schema": "1.0.0"},
    }


def door(wall_name: str, low: float, high: float, rooms: tuple = (2, 3), **others: object) -> dict:
    """A door in the walls `wall|<room>|<wall_name>`."""
    return {
        "id": f"door|{rooms[0]}|{rooms[1]}",
        "assetId": "Doorway_4",
        **{f"room{i}": f"room|{room}" for i, room in enumerate(rooms)},
        **{f"wall{i}": f"wall|{room}|{wall_name}" for i, room in enumerate(rooms)},
        "holePolygon": [point(low, 0, 0), point(high, 2.1, 0)],
        **others,
    }


def item(name: str, asset: str, x: float, y: float, z: float, yaw: float = 0.0, **others: object) -> dict:
    return {"id": name, "assetId": asset, "position": point(x, y, z), "rotation": point(0, yaw, 0), **others}


# Room 2 spans x 0-3, room 3 x 3-6, both z 0-3. The corners run clockwise, so room 2 draws the wall x = 3 downwards.
BOWL = item("small|3|1", "Bowl_1", 4.5, 0.85, 1.5)
TABLE = item("3|0", "Dining_Table_27_1", 4.5, 0.4, 1.5, 90.0, children=[BOWL])
HOUSE = build(
    ("Kitchen", [(0, 0), (0, 3), (3, 3), (3, 0)]),
    ("LivingRoom", [(3, 0), (3, 3), (6, 3), (6, 0)]),
    doors=(door("3.00|0.00|3.00|3.00", 1.0, 2.0, openable=True, openness=1),),
    objects=(TABLE,),
)
# Asset id to asset, and the same as lists by type.
ASSETS = {
    "Dining_Table_27_1": {"objectType": "DiningTable", "boundingBox": point(1.0, 0.8, 0.6)},
    "Bowl_1": {"objectType": "Bowl", "boundingBox": point(0.2, 0.1, 0.2)},
}
ASSET_LISTS = {asset["objectType"]: [{"assetId": name, **asset}] for name, asset in ASSETS.items()}


def changed(*keys_and_value: object, house: dict = HOUSE) -> dict:
    """A house with the value at a path of keys replaced."""
    house = copy.deepcopy(house)
    *keys, last, value = keys_and_value
    functools.reduce(lambda node, key: node[key], keys, house)[last] = value
    return house


def without(*keys: object) -> dict:
    house = copy.deepcopy(HOUSE)
    del functools.reduce(lambda node, key: node[key], keys[:-1], house)[keys[-1]]
    return house


@pytest.fixture
def read(tmp_path):
    def read_house(house: object, assets: object = ASSETS) -> Scene | InputError:
        (tmp_path / "house.json").write_text(json.dumps(house))
        (tmp_path / "assets.json").write_text(json.dumps(assets))
        (result,) = read_procthor(tmp_path / "house.json", "val", tmp_path / "assets.json" if assets else None)
        return result

    return read_house


@pytest.fixture
def scene_of(read):
    def read_scene(house: object, assets: object = ASSETS) -> Scene:
        result = read(house, assets)
        assert isinstance(result, Scene), result
        return result

    return read_scene


def without_rooms(scene: Scene) -> Scene:
    return dataclasses.replace(scene, rooms=())


def assert_same(a: Scene, b: Scene) -> None:
    assert_equal(without_rooms(a), without_rooms(b))
    for left, right in zip(a.rooms, b.rooms, strict=True):
        assert left.type == right.type
        np.testing.assert_array_equal(left.cells, right.cells)


def labels(mask: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """The number of the connected part that each cell of a mask is in."""
    parts = np.zeros(mask.shape, int)
    ndimage.label(mask, neighbours, output=parts)
    return parts


def places(scene: Scene, mask: np.ndarray) -> set[tuple[float, float]]:
    """World (x, z) of the cells of a mask."""
    return {(scene.origin[0] + 0.25 * ix, scene.origin[1] + 0.25 * iz) for iz, ix in np.argwhere(mask).tolist()}


def block(x0: float, x1: float, z0: float, z1: float) -> set[tuple[float, float]]:
    """Lattice points of a rectangle, its border included."""
    return {(x, z) for x in np.arange(x0, x1 + 0.1, 0.25).tolist() for z in np.arange(z0, z1 + 0.1, 0.25).tolist()}


# At yaw 90 the table spans x 4.2-4.8 and z 1.0-2.0; x = 4 and 5 are exactly 0.2 m away, z = 0.75 and 2.25 0.25 m.
ROOM_2, ROOM_3 = block(0.25, 2.75, 0.25, 2.75), block(3.25, 5.75, 0.25, 2.75) - block(4.25, 4.75, 1.0, 2.0)
DOORWAY = block(3.0, 3.0, 1.25, 1.75)  # 0.25 m from its sides at z = 1 and z = 2
OUTER = block(0, 6, 0, 3) - block(0.25, 5.75, 0.25, 2.75)
INNER = block(3, 3, 0, 3)


def test_two_rooms_worked_out_by_hand(scene_of):
    scene = scene_of(HOUSE)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("house-0", "procthor", "house", "val")
    # One cell around x 0-6 and z 0-3: 27 x 15 cells from -0.25.
    assert scene.origin == (-0.25, -0.25)
    assert scene.reach.shape == (15, 27)
    assert places(scene, scene.reach) == ROOM_2 | DOORWAY | ROOM_3  # 121 + 3 + 106 cells
    assert scene.reach.sum() == 230
    assert places(scene, scene.walls) == OUTER | INNER - DOORWAY
    assert scene.types == ("DiningTable", "Bowl")
    np.testing.assert_allclose(scene.boxes, [[4.5, 0.4, 1.5, 0.6, 0.8, 1.0], [4.5, 0.85, 1.5, 0.2, 0.1, 0.2]])
    assert scene.yaws.tolist() == [90.0, 0.0]
    assert scene.parents.tolist() == [-1, 0]
    # The shared edge belongs to the room beyond it.
    assert [(room.type, places(scene, room.cells)) for room in scene.rooms] == [
        ("kitchen", block(0, 2.75, 0, 2.75)),
        ("living_room", block(3, 5.75, 0, 2.75)),
    ]


def test_a_shut_door_lets_neither_feet_nor_eyes_through(scene_of):
    scene = scene_of(changed("doors", 0, "openness", 0))
    assert places(scene, scene.reach) == ROOM_3
    assert places(scene, scene.walls) == OUTER | INNER


def test_a_scene_survives_its_file(scene_of, tmp_path):
    scene = scene_of(HOUSE)
    write_scenes(tmp_path / "scenes.jsonl.gz", [scene])
    assert_same(read_scenes(tmp_path / "scenes.jsonl.gz")[0], scene)
    np.testing.assert_array_equal(standable_cells(scene.reach), np.argwhere(scene.reach))


# The hole is 0.5-1.5 m from the start of wall0: z 0.5-1.5 if it is drawn upwards, else z 1.5-2.5.
LOW, HIGH = block(3, 3, 0.75, 1.25), block(3, 3, 1.75, 2.25)


@pytest.mark.parametrize(("owner", "upwards", "expected"), [(2, False, HIGH), (2, True, LOW), (3, True, LOW)])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (0, 1, 3, 2), (0, 2, 1, 3)])
def test_holes_run_along_the_first_wall_from_its_first_corner(scene_of, owner, upwards, order, expected):
    house = changed("doors", [door("3.00|0.00|3.00|3.00", 0.5, 1.5, (owner, 5 - owner))])
    (shared,) = [each for each in house["walls"] if each["id"] == f"wall|{owner}|3.00|0.00|3.00|3.00"]
    corners = wall(owner, *sorted([(3, 0), (3, 3)], reverse=not upwards))["polygon"]
    shared["polygon"] = [corners[i] for i in order]
    scene = scene_of(house)
    assert places(scene, scene.reach) & INNER == expected
    assert INNER - places(scene, scene.walls) == expected


def test_walls_that_are_empty_are_none(scene_of):
    house = changed("doors", [])
    for each in house["walls"]:
        each["empty"] = each["id"].endswith("3.00|0.00|3.00|3.00")
    scene = scene_of(house)
    assert places(scene, scene.reach) == ROOM_2 | ROOM_3 | block(3, 3, 0.25, 2.75)
    assert places(scene, scene.walls) == OUTER


def test_doorframes_are_open_and_doors_to_the_outside_are_shut(scene_of):
    house = changed("doors", 0, "openness", None)
    front = door("6.00|0.00|6.00|3.00", 1.0, 2.0, (3, 3), openness=1) | {"wall1": "wall|exterior|6.00|0.00|6.00|3.00"}
    assert_same(scene_of(changed("doors", [front, *house["doors"]])), scene_of(HOUSE))


@pytest.mark.parametrize("turn", [1, -1])
def test_a_room_with_a_corner_cut_out(scene_of, turn):
    corners = [(0, 0), (0, 4), (2, 4), (2, 2), (4, 2), (4, 0)][::turn]
    bowl = item("Bowl|2|0", "Bowl_1", 1.0, 1.9, 1.0)  # from 1.85 m, above the agent
    scene = scene_of(build(("Bathroom", corners), objects=(bowl,), agent=(0.5, 0.5)))
    assert places(scene, scene.reach) == block(0.25, 1.75, 0.25, 3.75) | block(2, 3.75, 0.25, 1.75)  # 7 x 15 + 8 x 7
    border = {(x, z) for x, z in block(0, 4, 0, 4) if x in (0, 4) or z in (0, 4) or x == 2 <= z or z == 2 <= x}
    assert places(scene, scene.walls) == border - block(2.25, 4, 2.25, 4)


def test_a_wall_on_the_border_of_cells_takes_both(scene_of):
    corners = [(0, 0), (0, 2.125), (2, 2.125), (2, 0)]
    scene = scene_of(build(("Bedroom", corners), objects=(BOWL,), agent=(1, 1)))
    assert places(scene, scene.walls) & block(0.25, 1.75, 0.25, 4) == block(0.25, 1.75, 2.0, 2.25)
    assert places(scene, scene.reach) == block(0.25, 1.75, 0.25, 1.75)


@given(st.data())
def test_random_houses_equal_the_rules_point_by_point(tmp_path_factory, data):
    def draw(low: float, high: float) -> float:
        return round(data.draw(st.floats(low, high)), 2)

    width, depth, at = draw(5.0, 8.0), draw(2.5, 4.0), draw(2.0, 3.5)
    side, shut = draw(0.0, depth - 1.0), data.draw(st.booleans())
    fridge, size, yaw = (draw(0.0, width - 1.5), draw(0.0, depth)), (draw(0.0, 1.0), draw(0.0, 1.0)), draw(0.0, 360.0)
    house = build(
        ("Kitchen", [(0, 0), (at, 0), (at, depth), (0, depth)]),
        ("Bedroom", [(at, 0), (width, 0), (width, depth), (at, depth)]),
        doors=(door(f"{at:.2f}|0.00|{at:.2f}|{depth:.2f}", side, side + 1.0, openness=0.0 if shut else 0.3),),
        objects=(item("Fridge|2|0", "Fridge_1", fridge[0], 0.9, fridge[1], yaw),),
        agent=(width // 0.25 * 0.25 - 0.25, 0.5),  # more than 0.2 m from the fridge and the walls
    )
    path = tmp_path_factory.mktemp("random") / "house.json"
    path.write_text(json.dumps(house))
    path.with_name("assets.json").write_text(json.dumps({"Fridge_1": {"boundingBox": point(size[0], 1.8, size[1])}}))
    (scene,) = read_procthor(path, "train", path.with_name("assets.json"))
    assert isinstance(scene, Scene), scene

    # The box around the four corners of the fridge, turned clockwise: x to -z at 90 degrees.
    turn = np.deg2rad(yaw)
    corners = np.array([(a, b) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]) * size
    turned = fridge + corners @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    boxes = [(*turned.min(axis=0), *turned.max(axis=0))]
    walls = [(0, 0, width, 0), (0, depth, width, depth), (0, 0, 0, depth), (width, 0, width, depth)]
    walls += [(at, 0, at, depth)] if shut else [(at, 0, at, side), (at, side + 1.0, at, depth)]
    x, z = np.meshgrid(
        *(first + 0.25 * np.arange(n) for first, n in zip(scene.origin, scene.reach.T.shape, strict=True))
    )

    def away(box: tuple) -> np.ndarray:
        return np.stack([np.maximum(0, np.maximum(box[i] - v, v - box[2 + i])) for i, v in enumerate((x, z))])

    free = (x > 0) & (x < width) & (z > 0) & (z < depth)
    for box in boxes + walls:
        free &= np.hypot(*away(box)) >= 0.2 - 1e-9
    start = np.isclose(x, house["metadata"]["agent"]["position"]["x"]) & (z == 0.5)
    parts = labels(free, EIGHT)
    np.testing.assert_array_equal(scene.reach, parts == parts[start])
    np.testing.assert_array_equal(scene.walls, np.any([away(box).max(axis=0) <= 0.125 + 1e-9 for box in walls], axis=0))
    assert not (scene.reach & scene.walls).any()
    # Sight does not slip diagonally between wall cells, and passes an open door.
    kitchen = scene.rooms[0].cells & ~scene.walls
    seen = labels(~scene.walls, EIGHT if shut else FOUR)
    assert (seen[kitchen] == seen[start]).all() != shut


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
    scene = scene_of(changed("objects", 0, "children", 0, BOWL | fields))
    assert scene.types == ("DiningTable", expected)


def test_sizes_come_from_the_asset_database_turned_or_are_typical(scene_of):
    turned = scene_of(changed("objects", 0, "rotation", "y", -30.0))
    # 1.0 x 0.6 m turned by 30 degrees: cos 30 + 0.6 sin 30 = 1.16603 by sin 30 + 0.6 cos 30 = 1.01962.
    np.testing.assert_allclose(turned.boxes[0, 3:], [1.16603, 0.8, 1.01962], atol=1e-5)
    typical = scene_of(changed("objects", 0, "rotation", "y", -30.0), assets=None)
    assert typical.boxes[0].tolist() == [4.5, 0.4, 1.5, *typical_box("DiningTable")[:3]]
    assert_same(scene_of(HOUSE, ASSET_LISTS), scene_of(HOUSE))
    assert_same(scene_of(HOUSE, {"Bowl_1": {"boundingBox": None}}), scene_of(HOUSE, None))


def test_children_follow_their_parents(scene_of):
    book = item("Book|3|3", "Book_1", 4.5, 0.9, 1.5)
    chair = item("Chair|3|2", "Chair_1", 5.5, 0.5, 2.5, children=[book])
    table = TABLE | {"children": [BOWL | {"children": [book]}, chair]}
    scene = scene_of(changed("objects", [table, book]))
    assert scene.types == ("DiningTable", "Bowl", "Book", "Chair", "Book", "Book")
    assert scene.parents.tolist() == [-1, 0, 1, 0, 3, -1]
    # A typical chair is 0.56 m wide, so the corner x 5.22-5.78, z 2.22-2.78 is taken although the chair is a child.
    assert places(scene, scene.reach) & block(5.25, 5.75, 2.25, 2.75) == set()


def test_the_agent_tells_which_part_is_reached(scene_of):
    house = changed("doors", [])
    assert places(scene_of(house), scene_of(house).reach) == ROOM_3
    house["metadata"]["agent"]["position"] = point(0.01, 0.95, 0.51)  # in the wall, one cell from the floor
    assert places(scene_of(house), scene_of(house).reach) == ROOM_2


NAN = float("nan")
CROSSED = [point(x, 0, z) for x, z in [(0, 0), (3, 3), (3, 0), (0, 3)]]
BAD = [
    ([], "holds no house"),
    (3, "'house-0' is 3; give an object"),
    (without("rooms"), "rooms is missing"),
    (without("walls"), "walls is missing"),
    (without("doors"), "doors is missing"),
    (without("objects"), "objects is missing"),
    (without("metadata", "agent"), "metadata: agent is missing"),
    (without("doors", 0, "holePolygon"), "doors[0]: holePolygon is missing"),
    (without("rooms", 0, "roomType"), "rooms[0]: roomType is missing"),
    (without("walls", 2, "polygon", 1, "z"), "walls[2]: polygon[1]: z is missing"),
    (without("objects", 0, "children", 0, "position"), "objects[0].children[0]: position is missing"),
    (without("objects", 0, "children", 0, "rotation"), "objects[0].children[0]: rotation is missing"),
    (changed("rooms", []), "rooms is empty"),
    (changed("objects", []), "objects is empty"),
    (changed("rooms", 1, "floorPolygon", CROSSED), "rooms[1]: floorPolygon crosses or touches itself"),
    (changed("rooms", 0, "floorPolygon", CROSSED[:2]), "rooms[0]: floorPolygon has 2 corners"),
    (changed("rooms", 0, "floorPolygon", CROSSED * 300), "rooms[0]: floorPolygon has 1200 corners"),
    (changed("rooms", 0, "floorPolygon", 0, "x", -495.0), "rooms span more than 500 m"),
    (changed("rooms", 0, "floorPolygon", 0, "x", NAN), "floorPolygon[0]: x is nan"),
    (changed("walls", 0, "polygon", 0, "x", 1.0), "walls[0]: polygon has the corners"),
    (changed("walls", 0, "polygon", [point(x, y, x) for y in (0, 3) for x in (0, 3)]), "along x or z"),
    (changed("doors", 0, "wall0", "wall|9"), "doors[0]: wall0 is 'wall|9', which the house does not have"),
    (changed("doors", 0, "wall1", "wall|9"), "doors[0]: wall1 is 'wall|9', which the house does not have"),
    (changed("doors", 0, "room1", "room|9"), "doors[0]: room1 is 'room|9', which the house does not have"),
    (changed("doors", 0, "holePolygon", 1, "x", 3.1), "doors[0]: holePolygon spans x [1.0, 3.1]"),
    (changed("doors", 0, "holePolygon", 0, "x", 2.0), "doors[0]: holePolygon spans x [2.0, 2.0]"),
    (changed("doors", 0, "openness", "wide"), "doors[0]: openness is 'wide'"),
    (changed("objects", 0, "position", "y", NAN), "objects[0]: position: y is nan"),
    (changed("objects", 0, "children", 0, BOWL | {"objectType": 5}), "objectType is 5"),
    (changed("metadata", "agent", "position", "x", 4.9), "position holds [4.9, 0.5]"),
    (changed("metadata", "agent", "position", point(4.5, 0.9, 1.5)), "where the agent cannot stand"),
    (changed("metadata", "agent", "position", point(-500, 0.9, 1.5)), "where the agent cannot stand"),
]


@pytest.mark.parametrize(("house", "problem"), BAD)
def test_bad_houses_are_refused_with_their_place(tmp_path, read, house, problem):
    if house == []:
        with pytest.raises(InputError, match=problem):
            read(house)
        return
    error = read(house)
    assert isinstance(error, InputError)
    assert str(error).startswith(f"{tmp_path / 'house.json'}, line 1: house 'house-0'")
    assert problem in str(error)


def test_the_other_houses_of_a_file_are_imported(tmp_path):
    path = tmp_path / "val.jsonl.gz"
    lines = [json.dumps(HOUSE), "{", "", json.dumps(without("rooms")), json.dumps(HOUSE)]
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    first, cut, bad, last = read_procthor(path, "val")
    assert isinstance(first, Scene)
    assert isinstance(last, Scene)
    assert (first.name, last.name) == ("val-0", "val-3")
    assert str(cut).startswith(f"{path}, line 2: not JSON")
    assert str(bad).startswith(f"{path}, line 4: house 'val-2': rooms is missing")


@pytest.mark.parametrize(
    ("name", "indent"), [("houses.json", None), ("houses.json", 2), ("houses.json.gz", 2), ("houses.jsonl", None)]
)
def test_whole_files_hold_a_house_or_a_list_of_them(tmp_path, name, indent):
    for houses in (HOUSE, [HOUSE, HOUSE]):
        text = json.dumps(houses, indent=indent).encode()
        (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
        names = [scene.name for scene in read_procthor(tmp_path / name, "val") if isinstance(scene, Scene)]
        assert names == ["houses-0", "houses-1"][: 2 if isinstance(houses, list) else 1]


def test_files_that_cannot_be_read_are_refused(tmp_path):
    whole, content = tmp_path / "house.json.gz", gzip.compress(json.dumps(HOUSE).encode())
    for path, text, problem in [
        (tmp_path / "gone.json", None, "cannot be read"),
        (tmp_path / "empty.jsonl", b"\n", "holds no house"),
        (tmp_path / "half.json", json.dumps(HOUSE, indent=1).encode()[:500], "not JSON"),
        *[(whole, content[:size], "cut short") for size in range(20, len(content), 97)],
    ]:
        if text is not None:
            path.write_bytes(text)
        with pytest.raises(InputError, match=problem):
            list(read_procthor(path, "val"))


@pytest.mark.parametrize(
    ("assets", "problem"),
    [
        ([1], "asset database is"),
        ({"Bowl_1": 3}, "Bowl_1 is 3"),
        ({"Bowl": [{"boundingBox": None}]}, "assetId is missing"),
        ({"Bowl_1": {"boundingBox": point(1, 1, NAN)}}, "boundingBox: z is nan"),
        ({"Bowl_1": {"boundingBox": point(1, -1, 1)}}, "boundingBox is"),
    ],
)
def test_bad_asset_databases_are_refused(tmp_path, read, assets, problem):
    with pytest.raises(InputError, match=problem) as caught:
        read(HOUSE, assets)
    assert str(caught.value).startswith(str(tmp_path / "assets.json"))


@pytest.mark.parametrize(
    ("corners", "simple"),
    [
        ([(0, 0), (0, 4), (2, 4), (2, 2), (4, 2), (4, 0)], True),
        ([(0, 0), (1, 2), (3, 1)], True),
        ([(0, 0), (0, 3), (1, 3), (1, 1), (2, 1), (2, 3), (3, 3), (3, 0)], True),  # two edges on one line
        ([(0, 0), (0, 2), (0, 4), (3, 4), (3, 0)], True),  # a corner of 180 degrees
        ([(0, 0), (3, 3), (3, 0), (0, 3)], False),  # edges cross
        ([(0, 0), (0, 2), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2), (2, 0)], False),  # a corner twice
        ([(0, 0), (0, 3), (1, 3), (1, 0), (2, 0), (2, 3), (3, 3), (3, 0)], False),  # an edge along another
        ([(0, 0), (0, 3), (2, 3), (0, 1), (3, 0)], False),  # a corner on an edge
        ([(0, 0), (0, 3), (0, 1), (2, 1)], False),  # an edge that turns back
        ([(0, 0), (1, 1), (2, 2)], False),
        ([(0, 0), (0, 0), (0, 3), (3, 3)], False),
    ],
)
def test_simple_polygons(corners, simple):
    for shift in range(len(corners)):
        turned = np.roll(np.array(corners, float), shift, axis=0)
        assert polygons.is_simple(turned) == polygons.is_simple(turned[::-1]) == simple


@given(st.lists(st.floats(0.5, 3.0), min_size=7, max_size=7))
def test_inside_equals_the_winding_number(radii):
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False) + 0.1
    corners = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert polygons.is_simple(corners)  # radii around a centre
    x, z = np.arange(-12, 13) * 0.25, np.arange(-10, 11) * 0.25
    to = corners - np.stack(np.meshgrid(x, z), axis=-1)[..., None, :]
    after = np.roll(to, -1, axis=-2)
    cross = to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0]
    turns = np.arctan2(cross, (to * after).sum(axis=-1)).sum(axis=-1) / (2 * np.pi)
    clear = np.abs(cross).min(axis=-1) > 1e-9  # not on the line of an edge
    np.testing.assert_array_equal(polygons.inside(corners, x, z)[clear], (np.abs(turns) > 0.5)[clear])


def test_openings_are_taken_out_of_walls_along_them():
    wall_line = np.array([(5.0, 2.0), (1.0, 2.0)])
    openings = [
        np.array([(4.0, 2.0), (3.5, 2.0)]),
        np.array([(3.0, 2.01), (3.8, 2.01)]),  # overlaps the first
        np.array([(3.1, 2.0), (3.2, 2.0)]),  # within the second
        np.array([(0.0, 2.0), (1.5, 2.0)]),  # beyond the end
        np.array([(2.0, 2.5), (2.5, 2.5)]),  # in a parallel wall
        np.array([(2.0, 1.5), (2.0, 2.5)]),  # across
    ]
    pieces = polygons.without_openings(wall_line, openings)
    assert np.array(pieces).tolist() == [[[1.5, 2.0], [3.0, 2.0]], [[4.0, 2.0], [5.0, 2.0]]]


def test_mutated_houses_are_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    path = tmp_path / "houses.jsonl"

    @given(st.data())
    def check(data):
        path.write_text(json.dumps(mutate(data, HOUSE)) + "\n" + json.dumps(HOUSE))
        *results, last = read_procthor(path, "train")
        check_outcomes([without_rooms(r) if isinstance(r, Scene) else r for r in results], outcomes, path)
        assert isinstance(last, Scene)

    check()
    assert min(outcomes[Scene], outcomes[InputError]) >= 10


def test_mutated_text_is_imported_or_refused(tmp_path):
    outcomes = collections.Counter()
    text, path = json.dumps(HOUSE), tmp_path / "house.json"

    @given(st.integers(0, len(text)), st.integers(0, 20), st.text('[]{}",.:-0123456789eN\\u ', max_size=6))
    def check(at, length, inserted):
        path.write_text(text[:at] + inserted + text[at + length :])
        try:
            results = list(read_procthor(path, "train"))
        except InputError as error:
            results = [error]
        check_outcomes([without_rooms(r) if isinstance(r, Scene) else r for r in results], outcomes, path)

    check()
    assert outcomes[InputError] >= 10
