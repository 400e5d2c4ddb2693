"""Import of ProcTHOR houses: two rooms worked out by hand."""

import json

import numpy as np
import pytest
from support.importer_inputs.procthor import ASSETS, BOWL, HOUSE, build, door, item, point, wall
from support.mutations import changed
from support.scene_geometry import block, points_of
from support.scene_records import assert_scenes_equal

from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene

# At yaw 90 the table spans x 4.2-4.8 and z 1.0-2.0; x = 4 and 5 are exactly 0.2 m away, z = 0.75 and 2.25 0.25 m.
ROOM_2 = block(0.25, 2.75, 0.25, 2.75)
ROOM_3 = block(3.25, 5.75, 0.25, 2.75) - block(4.25, 4.75, 1.0, 2.0)
DOORWAY = block(3.0, 3.0, 1.25, 1.75)  # 0.25 m from its sides at z = 1 and z = 2
OUTER = block(0, 6, 0, 3) - block(0.25, 5.75, 0.25, 2.75)
INNER = block(3, 3, 0, 3)


def test_read_procthor_imports_two_rooms_worked_out_by_hand(house_scene):
    scene = house_scene(HOUSE)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("house-0", "procthor", "house", "val")

    # One cell around x 0-6 and z 0-3: 27 x 15 cells from -0.25.
    assert scene.origin == (-0.25, -0.25)
    assert scene.reach.shape == (15, 27)
    assert points_of(scene, scene.reach) == ROOM_2 | DOORWAY | ROOM_3  # 121 + 3 + 106 cells
    assert scene.reach.sum() == 230
    assert points_of(scene, scene.walls) == OUTER | INNER - DOORWAY
    np.testing.assert_array_equal(standable_cells(scene.reach), np.argwhere(scene.reach))

    # The bowl stands on the table.
    assert scene.types == ("DiningTable", "Bowl")
    np.testing.assert_allclose(scene.boxes, [[4.5, 0.4, 1.5, 0.6, 0.8, 1.0], [4.5, 0.85, 1.5, 0.2, 0.1, 0.2]])
    assert scene.yaws.tolist() == [90.0, 0.0]
    assert scene.parents.tolist() == [-1, 0]

    # The shared edge belongs to the room beyond it.
    kitchen, living_room = scene.rooms
    assert (kitchen.type, living_room.type) == ("kitchen", "living_room")
    assert points_of(scene, kitchen.cells) == block(0, 2.75, 0, 2.75)
    assert points_of(scene, living_room.cells) == block(3, 5.75, 0, 2.75)


def test_read_procthor_closes_a_shut_door_to_feet_and_eyes(house_scene):
    scene = house_scene(changed(HOUSE, "doors", 0, "openness", 0))
    assert points_of(scene, scene.reach) == ROOM_2 | ROOM_3
    assert len(standable_cells(scene.reach)) == len(ROOM_2)  # 121 cells; the agent's room has 106
    assert points_of(scene, scene.walls) == OUTER | INNER


# The hole is 0.5-1.5 m from the start of wall0: z 0.5-1.5 if it is drawn upwards, else z 1.5-2.5.
LOW = block(3, 3, 0.75, 1.25)
HIGH = block(3, 3, 1.75, 2.25)


@pytest.mark.parametrize(
    ("owner_room", "drawn_upwards", "open_points"), [(2, False, HIGH), (2, True, LOW), (3, True, LOW)]
)
@pytest.mark.parametrize("corner_order", [(0, 1, 2, 3), (2, 3, 0, 1), (0, 1, 3, 2), (0, 2, 1, 3)])
def test_read_procthor_measures_holes_from_the_first_corner_of_the_first_wall(
    house_scene, owner_room, drawn_upwards, corner_order, open_points
):
    house = changed(HOUSE, "doors", [door("3.00|0.00|3.00|3.00", 0.5, 1.5, (owner_room, 5 - owner_room))])

    # Draw the owner's wall in a direction, with its corners in an order.
    shared_id = f"wall|{owner_room}|3.00|0.00|3.00|3.00"
    wall_index = [record["id"] for record in house["walls"]].index(shared_id)
    corner_points = wall(owner_room, *sorted([(3, 0), (3, 3)], reverse=not drawn_upwards))["polygon"]
    house["walls"][wall_index]["polygon"] = [corner_points[i] for i in corner_order]

    # The hole is open to feet and eyes.
    scene = house_scene(house)
    assert points_of(scene, scene.reach) & INNER == open_points
    assert INNER - points_of(scene, scene.walls) == open_points


def test_read_procthor_leaves_out_empty_walls(house_scene):
    house = changed(HOUSE, "doors", [])
    for record in house["walls"]:
        record["empty"] = record["id"].endswith("3.00|0.00|3.00|3.00")
    scene = house_scene(house)
    assert points_of(scene, scene.reach) == ROOM_2 | ROOM_3 | block(3, 3, 0.25, 2.75)
    assert points_of(scene, scene.walls) == OUTER


def test_read_procthor_opens_doorframes_and_shuts_outside_doors(house_scene):
    house = changed(HOUSE, "doors", 0, "openness", None)
    front_door = door("6.00|0.00|6.00|3.00", 1.0, 2.0, (3, 3), openness=1) | {
        "wall1": "wall|exterior|6.00|0.00|6.00|3.00"
    }
    assert_scenes_equal(house_scene(changed(HOUSE, "doors", [front_door, *house["doors"]])), house_scene(HOUSE))


@pytest.mark.parametrize("corner_step", [1, -1])
def test_read_procthor_imports_an_l_shaped_room(house_scene, corner_step):
    corner_points = [(0, 0), (0, 4), (2, 4), (2, 2), (4, 2), (4, 0)][::corner_step]
    bowl = item("Bowl|2|0", "Bowl_1", 1.0, 1.9, 1.0)  # from 1.85 m, above the agent
    scene = house_scene(build(("Bathroom", corner_points), objects=(bowl,), agent=(0.5, 0.5)))
    assert points_of(scene, scene.reach) == block(0.25, 1.75, 0.25, 3.75) | block(2, 3.75, 0.25, 1.75)  # 7 x 15 + 8 x 7
    long_walls = block(0, 0, 0, 4) | block(0, 4, 0, 0)
    short_walls = block(0, 2, 4, 4) | block(2, 2, 2, 4) | block(2, 4, 2, 2) | block(4, 4, 0, 2)
    assert points_of(scene, scene.walls) == long_walls | short_walls


def test_read_procthor_gives_a_wall_between_cells_both_of_them(house_scene):
    corner_points = [(0, 0), (0, 2.125), (2, 2.125), (2, 0)]
    scene = house_scene(build(("Bedroom", corner_points), objects=(BOWL,), agent=(1, 1)))
    assert points_of(scene, scene.walls) & block(0.25, 1.75, 0.25, 4) == block(0.25, 1.75, 2.0, 2.25)
    assert points_of(scene, scene.reach) == block(0.25, 1.75, 0.25, 1.75)


@pytest.mark.parametrize(
    ("agent_place", "remaining_points", "is_moved"),
    [
        ((5.0, 0.5), ROOM_3, False),
        ((2.51, 0.5), ROOM_2, False),
        ((0.01, 0.51), ROOM_2, True),  # in the wall, one cell from the floor
        ((4.0, 3.25), ROOM_3, True),  # two cells from the floor
    ],
)
def test_read_procthor_keeps_the_part_of_the_agent_on_request(tmp_path, agent_place, remaining_points, is_moved):
    house = changed(HOUSE, "doors", [])
    house["metadata"]["agent"]["position"] = point(agent_place[0], 0.95, agent_place[1])
    house_file = tmp_path / "house.json"
    house_file.write_text(json.dumps(house))
    asset_file = tmp_path / "assets.json"
    asset_file.write_text(json.dumps(ASSETS))
    result, *notes = read_procthor(house_file, "val", asset_file, agent_part=True)
    assert isinstance(result, Scene)
    assert points_of(result, result.reach) == remaining_points

    # 121 and 106 cells: the part that is left out is the other one.
    note_counts = {note.text: note.number for note in notes if isinstance(note, ImportNote)}
    assert note_counts.pop("cells are skipped, because they are not connected with the agent") == 227 - len(
        remaining_points
    )
    assert note_counts == ({"agents are moved to the nearest free cell": 1} if is_moved else {})


def test_read_procthor_gives_a_house_of_one_room_its_type(house_scene):
    corner_points = [(0, 0), (0, 2), (2, 2), (2, 0)]
    scene = house_scene(build(("LivingRoom", corner_points), objects=(BOWL,), agent=(1, 1)))
    assert (scene.room_type, [room.type for room in scene.rooms]) == ("living_room", ["living_room"])

    # A second room of one type makes it a house all the same.
    second_corners = [(x + 2, z) for x, z in corner_points]
    scene = house_scene(build(("Bedroom", corner_points), ("Bedroom", second_corners), objects=(BOWL,)))
    assert scene.room_type == "house"
