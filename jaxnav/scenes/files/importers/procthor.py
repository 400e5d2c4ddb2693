"""Importer of ProcTHOR houses (schema 1.0.0).

A house has rooms, walls with doors and a tree of objects, but no reachable positions: `read_procthor` finds the free
floor of a house from them, one scene per house. Sizes of objects come from ProcTHOR's asset database (`read_assets`);
types that are missing are guessed from the names of assets (`type_from_asset_name`), and types of Objaverse are mapped
to the categories of the worlds (`normalize_object_type`).
"""

import dataclasses
import functools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import GIBSON_CATEGORIES, ITHOR_CATEGORIES, ROBOTHOR_CATEGORIES, category_ids
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount
from jaxnav.scenes.files.importers.assemble import (
    BOX_FIELDS,
    ImportNote,
    SceneObject,
    build_scene,
    component_containing,
    is_simple_polygon,
    lattice_cells,
    object_boxes,
    points_in_polygon,
    read_bounding_box,
    subtract_openings,
)
from jaxnav.scenes.files.scene_file import SNAP_TOLERANCE, JsonRecord, parse_json, read_bytes, read_json_texts
from jaxnav.scenes.generate.rooms import AGENT_RADIUS, OBSTACLE_HEIGHTS
from jaxnav.scenes.generate.sizes import typical_box, typical_boxes
from jaxnav.scenes.lattice import cells_near_boxes, cells_touching_boxes
from jaxnav.scenes.scene import CELL_SIZE, MAX_SIDE_CELLS, Room, Scene, box_footprints
from jaxnav.scenes.tables.visibility import TOLERANCE

#: Where the types and sizes of ProcTHOR's assets are.
_ASSET_DATABASE = "procthor/databases/asset-database.json of github.com/allenai/procthor"

_MAX_AGENT_DISTANCE = 2  # cells that an agent's place may be from free floor
_MAX_CORNERS = 1000  # of a room; the search for crossings takes the square of it
_DECIMALS = 6  # of metres; after rounding, walls and rooms meet where they are meant to

# Names of kitchen counters: shape, width and depth in feet.
_COUNTER_NAME = re.compile(r"Countertop_([LCI]|Island)_(\d+)x(\d+)")
_FOOT = 0.305  # metres
_COUNTER_HEIGHT = 0.94  # metres
_COUNTER_DEPTH = 0.61  # metres, of a counter along a wall

#: Names, in small letters without spaces, that are not simply the name of a type with a typical size.
_TYPE_ALIASES = {
    # of AI2-THOR's and ProcTHOR's assets
    "bathtubfaucet": "Faucet", "bin": "GarbageCan", "bnydsalt": "SaltShaker", "boot": "Boots", "cart": "Cart",
    "clothesdryer": "ClothesDryer", "decorativebox": "Box", "doorframe": "Doorframe", "officechair": "Chair",
    "papertowel": "PaperTowelRoll", "photo": "Painting", "remote": "RemoteControl", "tabletopdecor": "TableTopDecor",
    "tennisracquet": "TennisRacket", "vacuumcleaner": "VacuumCleaner",
    # of Objaverse's types
    "books": "Book", "cellulartelephone": "CellPhone", "chairs": "Chair", "coffeemaker": "CoffeeMachine",
    "couch": "Sofa", "kitchentable": "DiningTable", "laptopcomputer": "Laptop", "microwaveoven": "Microwave",
    "plant": "HousePlant", "refrigerator": "Fridge", "stepstool": "Footstool", "tablelamp": "DeskLamp",
    "teakettle": "Kettle", "trashcan": "GarbageCan",
}  # fmt: skip
_OBJAVERSE_PREFIX = "Obja"

# Parts of names: letters and digits in a row. A word ends with its number, if it has one, and a hash is no word.
_NAME_PART = re.compile(r"[^\W_]+")
_NUMBERED_WORD = re.compile("([a-z]+)[0-9]*")
_HASH = re.compile("(?=.*[0-9])[0-9a-f]{8,}")
_UUID = re.compile("[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


class AssetInfo(NamedTuple):
    """An entry of the asset database.

    Attributes:
      type: name of the asset's type.
      size: width, height and depth at yaw 0, metres.
    """

    type: str | None = None
    size: list[float] | None = None


class HouseObjects(NamedTuple):
    """The objects of a house, and how many of them are guessed.

    Attributes:
      objects: each before the objects that rest on or in it.
      num_guessed_types: number of objects whose type is guessed from the name of their asset.
      num_guessed_sizes: number of objects whose size is the typical one of their type.
      num_added_boxes: number of boxes of corner counters beyond the first of each.
    """

    objects: list[SceneObject]
    num_guessed_types: int
    num_guessed_sizes: int
    num_added_boxes: int


class FloorPolygon(NamedTuple):
    """The floor of a room.

    Attributes:
      id: id of the room.
      type: type of the room, for example `living_room`.
      corners: float64 [P, 2], (x, z), metres.
    """

    id: str
    type: str
    corners: np.ndarray


def read_procthor(
    path: Path, split: str, assets: Path | None = None, agent_part: bool = False
) -> Iterator[Scene | InputError | ImportNote | ImportCount]:
    """Read ProcTHOR houses.

    The agent can stand on the lattice points of the rooms that are at least 0.2 m from walls and from objects whose
    boxes reach into 0.1-1.7 m above the floor. Walls that are marked empty and inner doors that are not shut let it,
    and its sight, through. A house of one room has the type of that room.

    Args:
      path: one house per line (`*.jsonl`), or a house or a list of houses (`*.json`); both also with gzip.
      split: `train`, `val` or `test`.
      assets: asset database (JSON), by asset id or as lists by type. Objects that are not in it get the type that
        their names say, and typical sizes.
      agent_part: only the cells that are connected with the agent's place in the file (`metadata.agent`); it is moved
        to the nearest free cell, at most 0.5 m away.

    Yields:
      A scene `<file>-<index>` for each house, or the error that says why there is no scene, with the account of its
      objects and notes of what was guessed or moved.

    Raises:
      InputError: a file is missing or damaged, or holds no house.
    """
    asset_database = read_assets(assets) if assets else {}
    hint = "" if assets else f"; give them by --assets, {_ASSET_DATABASE}"
    file_stem = re.sub(r"\.jsonl?(\.gz)?$", "", path.name)

    num_houses = 0
    for location, house_value in _iterate_houses(path):
        name = f"{file_stem}-{num_houses}"
        num_houses += 1
        object_count = ImportCount("objects", num_read=_count_tree(house_value))
        try:
            if isinstance(house_value, InputError):
                raise house_value
            house = JsonRecord(location, {}).check_record(f"house {name!r}", house_value)
            house_objects = read_objects(house, asset_database)
            scene = _build_house(house, name, split, house_objects.objects)
            reach_mask = scene.reach
            agent_moved = False
            if agent_part:
                reach_mask, agent_moved = _cells_of_agent(house, scene)
        except InputError as error:
            object_count.skip_all(IN_REFUSED_SCENE)
            yield error
            yield object_count
            continue

        yield dataclasses.replace(scene, reach=reach_mask)
        object_count.num_added = house_objects.num_added_boxes
        yield object_count
        count_by_note = {
            f"types of objects are guessed from the names of their assets{hint}": house_objects.num_guessed_types,
            f"sizes of objects are the typical ones of their types{hint}": house_objects.num_guessed_sizes,
            "agents are moved to the nearest free cell": int(agent_moved),
            "cells are skipped, because they are not connected with the agent": int((scene.reach & ~reach_mask).sum()),
        }
        for note_text, count in count_by_note.items():
            if count:
                yield ImportNote(note_text, count)

    if num_houses == 0:
        raise InputError(f"{path}: holds no house; write one JSON object per line")


# Houses


def _iterate_houses(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the location of each house and its JSON; for a line that is not JSON its error."""
    for location, house_text in read_json_texts(path):
        try:
            house_value = parse_json(location, house_text)
        except InputError as error:
            # A damaged line leaves the other lines of a file.
            if location == str(path):
                raise
            house_value = error

        # A text holds one house, or a list of houses.
        for house in house_value if isinstance(house_value, list) else [house_value]:
            yield location, house


def _count_tree(house_value: Any) -> int:
    """Return the number of objects of a house with their children, also in a house that cannot be used."""
    num_objects = 0
    item_lists = [house_value.get("objects")] if isinstance(house_value, dict) else []
    while item_lists:
        items = item_lists.pop()
        for item in items if isinstance(items, list) else []:
            num_objects += 1
            if isinstance(item, dict):
                item_lists.append(item.get("children"))
    return num_objects


def _build_house(house: JsonRecord, name: str, split: str, objects: Sequence[SceneObject]) -> Scene:
    """Build the scene of a house from its rooms, walls and objects."""
    room_floors = read_rooms(house)

    # The lattice covers all rooms; one more cell all around holds the outer walls.
    floor_corners = np.concatenate([room_floor.corners for room_floor in room_floors])
    low_index = np.floor(floor_corners.min(axis=0) / CELL_SIZE) - 1
    high_index = np.ceil(floor_corners.max(axis=0) / CELL_SIZE) + 1
    if (high_index - low_index + 1 > MAX_SIDE_CELLS).any():
        raise house.error("rooms", f"span more than {MAX_SIDE_CELLS * CELL_SIZE:g} m; give one house at a time")
    x = CELL_SIZE * np.arange(low_index[0], high_index[0] + 1)
    z = CELL_SIZE * np.arange(low_index[1], high_index[1] + 1)

    # Masks of the rooms, [nz, nx] each, and the boxes of the walls, [M, 2, 2].
    rooms = tuple(Room(room_floor.type, points_in_polygon(room_floor.corners, x, z)) for room_floor in room_floors)
    wall_boxes = read_walls(house, {room_floor.id for room_floor in room_floors})

    # Obstacles are the objects at the height of the agent's body.
    boxes = object_boxes(objects)
    box_bottoms = boxes[:, 1] - boxes[:, 4] / 2
    box_tops = boxes[:, 1] + boxes[:, 4] / 2
    is_obstacle = (box_bottoms < OBSTACLE_HEIGHTS[1]) & (box_tops > OBSTACLE_HEIGHTS[0])
    barriers = np.concatenate([wall_boxes, box_footprints(boxes[is_obstacle])])

    # The agent's body must fit between walls and obstacles.
    indoor_cells = np.any([room.cells for room in rooms], axis=0)
    free_cells = indoor_cells & ~cells_near_boxes(barriers, x, z, AGENT_RADIUS - TOLERANCE)
    if not free_cells.any():
        raise house.error("rooms", f"have no floor {AGENT_RADIUS} m away from walls and objects; leave the house out")
    return build_scene(
        name,
        "procthor",
        rooms[0].type if len(rooms) == 1 else "house",
        split,
        origin=(float(x[0]), float(z[0])),
        reach=free_cells,
        # A wall on the border of two cells takes both. Where walls meet they share a cell, so that no sight slips
        # through; the square of a standable cell, at most 0.18 m from its centre, touches none.
        walls=cells_touching_boxes(wall_boxes, x, z),
        objects=objects,
        rooms=rooms,
    )


def _cells_of_agent(house: JsonRecord, scene: Scene) -> tuple[np.ndarray, bool]:
    """Return the cells connected with the agent's place, bool [nz, nx], and True where it had to be moved."""
    agent = house.get_record("metadata").get_record("agent")
    agent_position = agent.get_record("position").get_numbers("xz")
    first_cell = np.rint(np.divide(scene.origin[::-1], CELL_SIZE)).astype(int)
    agent_cell = lattice_cells(agent, "position", [agent_position])[0] - first_cell

    free_cells = np.argwhere(scene.reach)
    cell_distances = np.linalg.norm(free_cells - agent_cell, axis=1)
    nearest_index = int(cell_distances.argmin())
    if cell_distances[nearest_index] > _MAX_AGENT_DISTANCE:
        raise agent.error("position", f"is {agent_position} (x, z), where the agent cannot stand; put it on free floor")
    return component_containing(scene.reach, free_cells[nearest_index]), cell_distances[nearest_index] > 0


# Rooms, walls and doors


def read_rooms(house: JsonRecord) -> list[FloorPolygon]:
    """Read the floors of the rooms.

    Raises:
      InputError: a room is damaged, or there is none.
    """
    floor_polygons: list[FloorPolygon] = []
    for room in house.iterate_records("rooms", house.get("rooms")):
        polygon_points = room.get_list("floorPolygon")
        if not 3 <= len(polygon_points) <= _MAX_CORNERS:
            raise room.error("floorPolygon", f"has {len(polygon_points)} corners; give 3 to {_MAX_CORNERS}")
        corner_records = room.iterate_records("floorPolygon", polygon_points)
        polygon_corners = np.round([corner.get_numbers("xz") for corner in corner_records], _DECIMALS)
        if not is_simple_polygon(polygon_corners):
            raise room.error("floorPolygon", "crosses or touches itself; give the corners once around the room")
        # LivingRoom becomes living_room.
        room_type = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", room.get_text("roomType")).lower()
        floor_polygons.append(FloorPolygon(room.get_text("id"), room_type, polygon_corners))
    if not floor_polygons:
        raise house.error("rooms", "is empty; give at least one")
    return floor_polygons


def read_walls(house: JsonRecord, room_ids: set[str]) -> np.ndarray:
    """Read the solid pieces of the walls, without passable openings.

    Args:
      house: the house.
      room_ids: ids of its rooms.

    Returns:
      float64 [M, 2, 2], low and high corner (x, z) of each piece, metres.

    Raises:
      InputError: a wall or a door is damaged.
    """
    # Doors may be in walls that are marked empty, too.
    wall_lines: dict[str, np.ndarray] = {}
    solid_lines: list[np.ndarray] = []
    for wall in house.iterate_records("walls", house.get("walls")):
        wall_line = _wall_line(wall)
        wall_lines[wall.get_text("id")] = wall_line
        if wall.fields.get("empty") is not True:
            solid_lines.append(wall_line)

    passable_openings: list[np.ndarray] = []
    for door in house.iterate_records("doors", house.get("doors")):
        opening = _passable_opening(door, room_ids, wall_lines)
        if opening is not None:
            passable_openings.append(opening)

    wall_pieces: list[np.ndarray] = []
    for wall_line in solid_lines:
        wall_pieces.extend(subtract_openings(wall_line, passable_openings))
    return np.array(wall_pieces, np.float64).reshape(-1, 2, 2)


def _wall_line(wall: JsonRecord) -> np.ndarray:
    """Read start and end of a wall, float64 [2, 2], (x, z).

    Copies for the outside list the ceiling first, other walls the floor.
    """
    corner_records = wall.iterate_records("polygon", wall.get_list("polygon", 4))
    wall_corners = np.round([corner.get_numbers("xz") for corner in corner_records], _DECIMALS)
    wall_ends = list(dict.fromkeys(map(tuple, wall_corners.tolist())))
    if len(wall_ends) != 2 or np.ptp(wall_ends, axis=0).min() > SNAP_TOLERANCE:
        raise wall.error("polygon", f"has the corners {wall_ends} (x, z); give an upright rectangle along x or z")
    return np.array(wall_ends)


def _passable_opening(door: JsonRecord, room_ids: set[str], wall_lines: dict[str, np.ndarray]) -> np.ndarray | None:
    """Read both ends of a door, float64 [2, 2], (x, z); None where it is shut or leads outside."""
    # References to rooms and walls.
    room0 = door.get_text("room0")
    room1 = door.get_text("room1")
    wall0 = door.get_text("wall0")
    wall1 = door.get_text("wall1")
    house_references = (
        ("room0", room0, room_ids),
        ("room1", room1, room_ids),
        ("wall0", wall0, wall_lines),
        ("wall1", wall1, wall_lines),
    )
    for field, reference, house_ids in house_references:
        if reference not in house_ids:
            raise door.error(field, f"is {reference!r}, which the house does not have; give the id of one it has")

    # The hole is measured along its wall.
    corner_records = door.iterate_records("holePolygon", door.get_list("holePolygon", 2))
    hole_x = np.array([corner.get_numbers("x") for corner in corner_records])  # [2, 1]
    wall_start, wall_end = wall_lines[wall0]
    wall_length = np.linalg.norm(wall_end - wall_start)
    if not -SNAP_TOLERANCE <= hole_x[0, 0] < hole_x[1, 0] <= wall_length + SNAP_TOLERANCE:
        problem = f"spans x {hole_x.ravel().tolist()}; it must lie in its wall, 0 to {wall_length:g}"
        raise door.error("holePolygon", problem)

    # Doors that lead outside have one room twice; doorways without a door have no openness.
    openness = door.fields.get("openness")
    is_inner_door = room0 != room1
    if is_inner_door and (openness is None or door.check_number("openness", openness) > 0):
        return wall_start + hole_x * (wall_end - wall_start) / wall_length
    return None


# Objects and their assets


def read_assets(path: Path) -> dict[str, AssetInfo]:
    """Read the asset database, by asset id.

    The file is `{asset id: asset}` or `{type: [asset, ...]}`.

    Raises:
      InputError: the file is missing or damaged.
    """
    database = JsonRecord(str(path), {}).check_record("asset database", parse_json(str(path), read_bytes(path)))
    asset_by_id: dict[str, AssetInfo] = {}
    for database_key, value in database.fields.items():
        # A list holds the assets of a type, with their ids inside.
        for asset_value in value if isinstance(value, list) else [value]:
            asset = database.check_record(database_key, asset_value)
            asset_id = asset.get("assetId") if isinstance(value, list) else database_key
            type_name = asset.fields.get("objectType")
            if type_name is not None:
                type_name = asset.check_text("objectType", type_name)
            asset_size = asset.fields.get("boundingBox")
            if asset_size is not None:
                asset_size = _read_asset_size(asset.check_record("boundingBox", asset_size))
            if asset_size and min(asset_size) < 0:
                raise asset.error("boundingBox", f"is {asset_size}; give sizes of at least 0")
            asset_by_id[asset.check_text("assetId", asset_id)] = AssetInfo(type_name, asset_size)
    return asset_by_id


def _read_asset_size(box: JsonRecord) -> list[float]:
    """Read the size of an asset, which is {x, y, z} itself or follows from another form of its box."""
    if "x" in box.fields or not BOX_FIELDS & set(box.fields):
        return box.get_numbers()
    _, asset_size = read_bounding_box(box)
    return asset_size


def read_objects(house: JsonRecord, assets: dict[str, AssetInfo]) -> HouseObjects:
    """Read the objects of a house.

    Positions in the file are in the world, also those of children.

    Raises:
      InputError: an object is damaged, or there is none.
    """
    root_values = house.get_list("objects")
    if not root_values:
        raise house.error("objects", "is empty; give at least one object to look for")

    house_objects: list[SceneObject] = []
    num_guessed_types = 0
    num_guessed_sizes = 0
    num_added_boxes = 0

    # Walk the tree in the order of the file. The stack holds label, JSON and parent index of the objects to come.
    item_stack = _reversed_items("objects", root_values, -1)
    while item_stack:
        item_label, item_value, parent_index = item_stack.pop()
        item = house.check_record(item_label, item_value)
        item_stack += _reversed_items(f"{item_label}.children", item.get_list_or_empty("children"), len(house_objects))

        # Type and size, as the file or the database name them, or else a guess.
        asset_id = str(item.fields.get("assetId"))
        asset = assets.get(asset_id, AssetInfo())
        named_type = _named_type(item, asset)
        asset_size = asset.size or _counter_size(asset_id)
        object_type = named_type or _guess_type(item)
        object_parts = _object_parts(item, object_type, asset_size, parent_index, len(house_objects))
        house_objects += object_parts
        num_added_boxes += len(object_parts) - 1
        num_guessed_types += named_type is None
        num_guessed_sizes += asset_size is None
    return HouseObjects(house_objects, num_guessed_types, num_guessed_sizes, num_added_boxes)


def _reversed_items(field: str, values: Sequence[Any], parent: int) -> list[tuple[str, Any, int]]:
    """Return label, JSON and parent index of the items of a list, the last item first."""
    labelled_items: list[tuple[str, Any, int]] = []
    for index, value in enumerate(values):
        labelled_items.append((f"{field}[{index}]", value, parent))
    return labelled_items[::-1]


def _object_parts(
    item: JsonRecord, object_type: str, size: list[float] | None, parent: int, index: int
) -> list[SceneObject]:
    """Return an object; a counter around a corner as several straight parts.

    Further parts rest on the first, whose index is `index`.
    """
    item_position = item.get_record("position").get_numbers()
    (yaw,) = item.get_record("rotation").get_numbers("y")
    if size is None:
        # Typical sizes are of boxes in the world, at any yaw.
        return [SceneObject(object_type, (*item_position, *typical_box(object_type)[:3]), yaw, parent)]

    # Rotation of (x, z), clockwise from above.
    cos_yaw = np.cos(np.deg2rad(yaw))
    sin_yaw = np.sin(np.deg2rad(yaw))
    rotation = np.array([[cos_yaw, sin_yaw], [-sin_yaw, cos_yaw]])

    counter_parts: list[SceneObject] = []
    for low_corner, high_corner in _footprints(str(item.fields.get("assetId")), size[0], size[2]):
        x, z = item_position[::2] + rotation @ (low_corner + high_corner) / 2
        size_x, size_z = np.abs(rotation) @ (high_corner - low_corner)
        part_box = (x, item_position[1], z, size_x, size[1], size_z)
        counter_parts.append(SceneObject(object_type, part_box, yaw, index if counter_parts else parent))
    return counter_parts


def _counter_size(asset_id: str) -> list[float] | None:
    """Return the size in the name of a counter, metres; None for other assets."""
    name_match = _COUNTER_NAME.match(asset_id)
    return [_FOOT * int(name_match[2]), _COUNTER_HEIGHT, _FOOT * int(name_match[3])] if name_match else None


def _footprints(asset_id: str, width: float, depth: float) -> list[np.ndarray]:
    """Return the rectangles that an asset covers.

    They are float64 [2, 2], low and high corner (x, z) at yaw 0, metres from its centre. `Countertop_L_*` lies along
    its low z and its high x, `Countertop_C_*` also along its low x.
    """
    half_width = width / 2
    half_depth = depth / 2
    name_match = _COUNTER_NAME.match(asset_id)
    counter_shape = name_match[1] if name_match else ""
    if counter_shape not in ("L", "C") or min(width, depth) <= _COUNTER_DEPTH:
        return [np.array([(-half_width, -half_depth), (half_width, half_depth)])]
    low_z_strip = np.array([(-half_width, -half_depth), (half_width, _COUNTER_DEPTH - half_depth)])
    high_x_strip = np.array([(half_width - _COUNTER_DEPTH, _COUNTER_DEPTH - half_depth), (half_width, half_depth)])
    low_x_strip = np.array([(-half_width, _COUNTER_DEPTH - half_depth), (_COUNTER_DEPTH - half_width, half_depth)])
    return [low_z_strip, high_x_strip] if counter_shape == "L" else [low_z_strip, high_x_strip, low_x_strip]


# Types of objects


def type_from_asset_name(name: str) -> str | None:
    """Return the type in the name of an asset, if any.

    The longest run of the name's words that is a known type counts, and of equally long runs the last: `bin_8` is a
    GarbageCan, `RoboTHOR_sofa_kramfors` a Sofa, `Towel_Statue_2` a Statue. Hashes and other ids have no words.
    """
    # Runs of words, the longest first and of equal ones the last first.
    name_words = _split_words(name)
    for num_words in range(len(name_words), 0, -1):
        for first_word in range(len(name_words) - num_words, -1, -1):
            type_name = _types_by_name().get("".join(name_words[first_word : first_word + num_words]))
            if type_name:
                return type_name
    return None


def _split_words(name: str) -> list[str]:
    """Return the words of a name in small letters; a part that is no word stays whole, so that it matches no type."""
    name_words: list[str] = []
    for name_part in _NAME_PART.findall(_UUID.sub("0x", name.lower())):
        if name_part.isdecimal():
            continue
        word_match = None if _HASH.fullmatch(name_part) else _NUMBERED_WORD.fullmatch(name_part)
        name_words.append(word_match[1] if word_match else name_part)
    return name_words


def normalize_object_type(name: str) -> str:
    """Return the type of an object for a type name in the file.

    Of Objaverse's types the last words count, since they say what it is: `ObjaBarStool` is a Stool and `ObjaTrashCan` a
    GarbageCan. Those whose ends name no category of any world stay as they are, like all other types.
    """
    if not name.startswith(_OBJAVERSE_PREFIX):
        return name
    name_words = re.findall("[A-Z][a-z]*", name.removeprefix(_OBJAVERSE_PREFIX))
    for first_word in range(len(name_words)):
        type_name = _types_by_name().get("".join(name_words[first_word:]).lower())
        if type_name:
            return type_name if _is_category(type_name) else name
    return name


def _is_category(type_name: str) -> bool:
    """Return True for a type that is a category of any world."""
    (category,) = category_ids((type_name,), (*ITHOR_CATEGORIES, *ROBOTHOR_CATEGORIES, *GIBSON_CATEGORIES))
    return category >= 0


@functools.cache
def _types_by_name() -> dict[str, str]:
    return {type_name.lower(): type_name for type_name in typical_boxes()} | _TYPE_ALIASES


def _named_type(item: JsonRecord, asset: AssetInfo) -> str | None:
    """Return the type that the file or the database names, if any."""
    if item.fields.get("objectType") is not None:
        return normalize_object_type(item.get_text("objectType"))
    if asset.type:
        return asset.type
    # Ids such as `Bowl|surface|3|1` begin with the type; `small|3|1`, `3|0` and hashes do not.
    id_prefix, id_separator, _ = item.get_text("id").partition("|")
    names_type = id_separator and id_prefix != "small" and _split_words(id_prefix) == [id_prefix.lower()]
    return id_prefix if names_type and id_prefix.isalpha() else None


def _guess_type(item: JsonRecord) -> str:
    """Return the type in the name of the asset or the object, or else the asset's name without its numbers."""
    asset_name = item.get_text("assetId")
    object_name = item.fields.get("object_name")  # of Holodeck's houses, whose assets are named by hashes
    for name in (asset_name, object_name):
        type_name = type_from_asset_name(name) if isinstance(name, str) else None
        if type_name:
            return type_name
    return re.sub(r"(_\d+)+$", "", asset_name).replace("_", "") or asset_name
