"""ProcTHOR houses to scenes: two rooms worked out by hand."""

import json

import numpy as np
import pytest
from support.importer_inputs.procthor import ASSETS, BOWL, HOUSE, build, door, item, point, wall
from support.mutations import changed
from support.scene_geometry import block, points_of
from support.scene_records import as_scene, assert_scenes_equal

from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.lattice import standable_cells

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
    assert points_of(scene, scene.reach) == ROOM_2 | DOORWAY | ROOM_3  # 121 + 3 + 106 cells
    assert scene.reach.sum() == 230
    assert points_of(scene, scene.walls) == OUTER | INNER - DOORWAY
    assert scene.types == ("DiningTable", "Bowl")
    np.testing.assert_allclose(scene.boxes, [[4.5, 0.4, 1.5, 0.6, 0.8, 1.0], [4.5, 0.85, 1.5, 0.2, 0.1, 0.2]])
    assert scene.yaws.tolist() == [90.0, 0.0]
    assert scene.parents.tolist() == [-1, 0]
    # The shared edge belongs to the room beyond it.
    assert [(room.type, points_of(scene, room.cells)) for room in scene.rooms] == [
        ("kitchen", block(0, 2.75, 0, 2.75)),
        ("living_room", block(3, 5.75, 0, 2.75)),
    ]


def test_a_shut_door_lets_neither_feet_nor_eyes_through(scene_of):
    scene = scene_of(changed(HOUSE, "doors", 0, "openness", 0))
    assert points_of(scene, scene.reach) == ROOM_2 | ROOM_3
    assert len(standable_cells(scene.reach)) == len(ROOM_2)  # 121 cells; the agent's room has 106
    assert points_of(scene, scene.walls) == OUTER | INNER


def test_a_scene_survives_its_file(scene_of, tmp_path):
    scene = scene_of(HOUSE)
    write_scenes(tmp_path / "scenes.jsonl.gz", [scene])
    assert_scenes_equal(read_scenes(tmp_path / "scenes.jsonl.gz")[0], scene)
    np.testing.assert_array_equal(standable_cells(scene.reach), np.argwhere(scene.reach))


# The hole is 0.5-1.5 m from the start of wall0: z 0.5-1.5 if it is drawn upwards, else z 1.5-2.5.
LOW, HIGH = block(3, 3, 0.75, 1.25), block(3, 3, 1.75, 2.25)


@pytest.mark.parametrize(("owner", "upwards", "expected"), [(2, False, HIGH), (2, True, LOW), (3, True, LOW)])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (0, 1, 3, 2), (0, 2, 1, 3)])
def test_holes_run_along_the_first_wall_from_its_first_corner(scene_of, owner, upwards, order, expected):
    house = changed(HOUSE, "doors", [door("3.00|0.00|3.00|3.00", 0.5, 1.5, (owner, 5 - owner))])
    (shared,) = [record for record in house["walls"] if record["id"] == f"wall|{owner}|3.00|0.00|3.00|3.00"]
    corners = wall(owner, *sorted([(3, 0), (3, 3)], reverse=not upwards))["polygon"]
    shared["polygon"] = [corners[i] for i in order]
    scene = scene_of(house)
    assert points_of(scene, scene.reach) & INNER == expected
    assert INNER - points_of(scene, scene.walls) == expected


def test_walls_that_are_empty_are_none(scene_of):
    house = changed(HOUSE, "doors", [])
    for record in house["walls"]:
        record["empty"] = record["id"].endswith("3.00|0.00|3.00|3.00")
    scene = scene_of(house)
    assert points_of(scene, scene.reach) == ROOM_2 | ROOM_3 | block(3, 3, 0.25, 2.75)
    assert points_of(scene, scene.walls) == OUTER


def test_doorframes_are_open_and_doors_to_the_outside_are_shut(scene_of):
    house = changed(HOUSE, "doors", 0, "openness", None)
    front = door("6.00|0.00|6.00|3.00", 1.0, 2.0, (3, 3), openness=1) | {"wall1": "wall|exterior|6.00|0.00|6.00|3.00"}
    assert_scenes_equal(scene_of(changed(HOUSE, "doors", [front, *house["doors"]])), scene_of(HOUSE))


@pytest.mark.parametrize("turn", [1, -1])
def test_an_l_shaped_room(scene_of, turn):
    corners = [(0, 0), (0, 4), (2, 4), (2, 2), (4, 2), (4, 0)][::turn]
    bowl = item("Bowl|2|0", "Bowl_1", 1.0, 1.9, 1.0)  # from 1.85 m, above the agent
    scene = scene_of(build(("Bathroom", corners), objects=(bowl,), agent=(0.5, 0.5)))
    assert points_of(scene, scene.reach) == block(0.25, 1.75, 0.25, 3.75) | block(2, 3.75, 0.25, 1.75)  # 7 x 15 + 8 x 7
    border = {(x, z) for x, z in block(0, 4, 0, 4) if x in (0, 4) or z in (0, 4) or x == 2 <= z or z == 2 <= x}
    assert points_of(scene, scene.walls) == border - block(2.25, 4, 2.25, 4)


def test_a_wall_on_the_border_of_cells_takes_both(scene_of):
    corners = [(0, 0), (0, 2.125), (2, 2.125), (2, 0)]
    scene = scene_of(build(("Bedroom", corners), objects=(BOWL,), agent=(1, 1)))
    assert points_of(scene, scene.walls) & block(0.25, 1.75, 0.25, 4) == block(0.25, 1.75, 2.0, 2.25)
    assert points_of(scene, scene.reach) == block(0.25, 1.75, 0.25, 1.75)


@pytest.mark.parametrize(
    ("place", "part", "moved"),
    [
        ((5.0, 0.5), ROOM_3, 0),
        ((2.51, 0.5), ROOM_2, 0),
        ((0.01, 0.51), ROOM_2, 1),  # in the wall, one cell from the floor
        ((4.0, 3.25), ROOM_3, 1),  # two cells from the floor
    ],
)
def test_the_agents_part_is_kept_if_asked_for(tmp_path, place, part, moved):
    house = changed(HOUSE, "doors", [])
    house["metadata"]["agent"]["position"] = point(place[0], 0.95, place[1])
    (tmp_path / "house.json").write_text(json.dumps(house))
    (tmp_path / "assets.json").write_text(json.dumps(ASSETS))
    result, *notes = read_procthor(tmp_path / "house.json", "val", tmp_path / "assets.json", agent_part=True)
    assert not isinstance(result, ImportNote)
    assert points_of(as_scene(result), as_scene(result).reach) == part
    # 121 and 106 cells: the part that is not kept is the other one.
    expected = {"cells are not connected with the agent and left out": 227 - len(part)}
    expected |= {"agents are moved to the nearest free cell": 1} if moved else {}
    assert {note.text: note.number for note in notes if isinstance(note, ImportNote)} == expected


def test_a_house_of_one_room_has_its_type(scene_of):
    corners = [(0, 0), (0, 2), (2, 2), (2, 0)]
    scene = scene_of(build(("LivingRoom", corners), objects=(BOWL,), agent=(1, 1)))
    assert (scene.room_type, [room.type for room in scene.rooms]) == ("living_room", ["living_room"])
    two = scene_of(build(("Bedroom", corners), ("Bedroom", [(x + 2, z) for x, z in corners]), objects=(BOWL,)))
    assert two.room_type == "house"
