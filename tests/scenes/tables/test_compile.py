"""Tests of compiled scenes: detections, the ego-centric view and banks."""

import dataclasses

import numpy as np
import pytest
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, FRIDGE, HOUSES, ROOMS, SMALL, draw

from jaxnav.errors import InputError
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import bank_checksum, compile_bank, compile_scene, concatenate_banks
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, Rules, Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

ROW_FORMAT = RowFormat(len(CATEGORIES))
BOOK_AHEAD = ("Book", 0, 1.5, 2, *SMALL)


def compile_table(scene, rules=ROOMS):
    """Tables of a scene for a detector without errors: `rows` is uint8 [P, R]."""
    return compile_scene(scene, Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR))


def test_detection_bytes_of_a_drawn_object():
    # 2 m ahead with size 0.6 m, so range 5 m: confidence 1 - 0.5 x 0.4 = 0.8, apparent size 0.3.
    row = compile_table(draw(["."], BOOK_AHEAD)).rows[0]
    # The bytes are 0.8 x 255, 2 x 51, 128 and 0.3 x 127.5 = 38.25.
    assert ROW_FORMAT.detections(row)[BOOK].tolist() == [204, 102, 128, 38]
    assert not ROW_FORMAT.detections(row)[CHAIR].any()

    # 0.9 m at a distance of 0.4 m: apparent size 2.25 x 127.5 = 286.9, more than a byte holds.
    row = compile_table(draw(["."], ("Chair", 0, 1.5, 0.4, 0.9, 0.9, 0.1))).rows[0]
    assert ROW_FORMAT.detections(row)[CHAIR].tolist() == [245, 20, 128, 255]  # 1 - 0.5 x 0.08 = 0.96: 244.8


# The ego-centric view


def view_picture(scene, cell, heading, rules=ROOMS):
    """Ego-centric view as 11 texts of 11 characters (`.` free, `#` blocked, `?` unknown), the far edge first."""
    cell_index = standable_cells(scene.reach).tolist().index(list(cell))
    pose = cell_index * rules.poses_per_cell + heading * len(rules.horizons)
    cells = ROW_FORMAT.view_cells(compile_table(scene, rules).rows[pose]).reshape(11, 11)
    marks = np.array(list("?.#"))[cells]
    return ["".join(row) for row in marks[::-1]]


def test_ego_centric_view_of_a_drawn_room():
    room = [list("." * 13) for _ in range(9)]
    room[3][6] = "#"
    room[2][4] = "#"
    wardrobe = ("Wardrobe", 1.5, 1, 0.75, 0.3, 2, 0.3)
    chest = ("Chest", 1, 0.45, 0.5, 0.3, 0.9, 0.3)

    # The wardrobe on [3, 6] hides the cells right behind it; the chest on [2, 4] is too low to hide any. Half the field
    # of view is 1.19 cells a step. The line to a cell in the next column stays in the agent's column for half its
    # length, so it meets the wardrobe, 3 steps ahead, if the cell is at least 6 steps ahead. The room ends after 8
    # steps.
    assert view_picture(draw(["".join(row) for row in room], wardrobe, chest), (0, 6), 0) == [
        "####???####",
        "####???####",
        "....???....",
        "....???....",
        "....???....",
        ".....?.....",
        "?....?....?",
        "??...#...??",
        "???#....???",
        "????...????",
        "?????.?????",
    ]


def test_ego_centric_view_ends_at_a_wall():
    scene = draw(["." * 13] * 2 + ["#" * 13] + ["." * 13], walls=[(2, ix) for ix in range(13)])
    picture = view_picture(scene, (0, 6), 0)
    assert picture[:8] == ["?" * 11] * 8
    assert picture[8:] == ["???#####???", "????...????", "?????.?????"]


def test_ego_centric_view_along_a_diagonal():
    # Heading 1 points to +z +x. Cell [2, 2] is 2.83 cells ahead: 3 steps (2.12, rounded to 2). Cell [3, 0] is 45
    # degrees to the left: 2 steps ahead and 2 to the side (z = 0.71 x 4 = 2.83, rounded to 3).
    room = ["." * 12, "." * 12, "..#.........", "#..........."] + ["." * 12] * 8
    picture = view_picture(draw(room), (0, 0), 1)[::-1]
    assert picture[:4] == ["?????.?????", "????...????", "???#....???", "??...#...??"]


@pytest.mark.slow
@pytest.mark.parametrize("rules", [ROOMS, APARTMENTS, HOUSES])
def test_ego_centric_view_of_a_mirrored_room_is_mirrored(rules):
    # With 12 headings, many offsets are halves: the cell 1 ahead at 30 degrees lies half a cell to the right.
    rng = np.random.default_rng(0)
    for _ in range(5):
        # A random room, its mirror image and the room turned by 180 degrees.
        reach = rng.random((9, 9)) < 0.8
        walls = rng.random((9, 9)) < 0.1
        reach &= ~walls
        scene = dataclasses.replace(draw(["." * 9] * 9), reach=reach, walls=walls)
        mirrored_scene = dataclasses.replace(scene, reach=reach[:, ::-1], walls=walls[:, ::-1])
        turned_scene = dataclasses.replace(scene, reach=reach[::-1, ::-1], walls=walls[::-1, ::-1])

        # From one cell, compare the views along every heading.
        iz, ix = rng.permutation(standable_cells(reach))[0]
        for heading in range(rules.headings):
            picture = view_picture(scene, (iz, ix), heading, rules)
            mirrored_picture = view_picture(mirrored_scene, (iz, 8 - ix), -heading % rules.headings, rules)
            assert mirrored_picture == [row[::-1] for row in picture]
            opposite_heading = (heading + rules.headings // 2) % rules.headings
            assert view_picture(turned_scene, (8 - iz, 8 - ix), opposite_heading, rules) == picture


@pytest.mark.parametrize("world", WORLDS)
def test_the_cell_in_front_shows_whether_move_ahead_moves(world):
    """With twelve headings, the cell nearest to the heading is another cell, often free while the move is blocked."""
    scene = make_generated_scenes(world, "train", 1)[0]
    task = WORLDS[world].task

    # Poses in which the cell in front of the agent is free exactly if a move ahead leads to another pose.
    is_correct = {}
    for front_cell in ("nearest", "move"):
        rules = dataclasses.replace(task.rules, front_cell=front_cell)
        bank = compile_bank([scene], dataclasses.replace(task, rules=rules))
        moves = bank.successor[:, MOVE_AHEAD] != np.arange(len(bank.rows))
        front_state = task.row_format.view_cells(bank.rows).reshape(-1, 11, 11)[:, 1, 5]
        is_correct[front_cell] = front_state == np.where(moves, VIEW_FREE, VIEW_BLOCKED)

    assert is_correct["move"].all()
    assert is_correct["nearest"].all() == (task.rules.headings == 8)


# Banks


def rename_scene(name: str, scene: Scene) -> Scene:
    return dataclasses.replace(scene, name=name)


def test_compile_bank_skips_scenes_without_a_reachable_goal():
    good_scene = rename_scene("good", draw(["...."], BOOK_AHEAD, ("Chair", 0.5, 1, 0.5, *SMALL)))
    goalless_scenes = [
        rename_scene("empty", draw(["...."])),
        rename_scene("nowhere", draw(["####"], BOOK_AHEAD)),
        rename_scene("too far", draw(["...."], ("Book", 0, 1.5, 1.6, *SMALL))),
        rename_scene("not sought", draw(["...."], ("Vase", 0, 1.5, 1, *SMALL))),
    ]
    near_scene = rename_scene("near", draw(["..", ".."], ("Book", 0, 1.5, 1, *SMALL)))
    task = Task(CATEGORIES)

    # Two of six scenes are compiled; the four skipped scenes are listed.
    bank = compile_bank([goalless_scenes[0], good_scene, *goalless_scenes[1:], near_scene], task)
    assert bank.task == task
    assert bank.names == ("good", "near")
    assert bank.skipped == ("empty", "nowhere", "too far", "not sought")

    # In the good room the book is 2 m away, so only the chair is a goal.
    assert bank.num_goals.tolist() == [1, 1]
    assert bank.goals[:, 0].tolist() == [CHAIR, BOOK]
    assert bank.first_cell.tolist() == [0, 4]
    assert bank.num_cells.tolist() == [4, 4]
    assert bank.successor[:64].max() < 64 <= bank.successor[64:].min()

    # Without any reachable goal there is no bank.
    with pytest.raises(InputError, match=r"4 scenes .*Book, Chair, Fridge"):
        compile_bank(goalless_scenes, task)


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_compile_bank_uses_only_the_goals_of_the_task(rules):
    scene = draw(["."], ("Book", 0, 1.0, 0.5, *SMALL), ("Chair", 0, 1.0, 0.6, *SMALL), ("Fridge", 5, 1, 0, 1, 2, 1))
    task = Task(CATEGORIES, ("Chair", "Fridge"), rules, PERFECT_DETECTOR)
    bank = compile_bank([scene], task)
    assert bank.goals[0, : bank.num_goals[0]].tolist() == [CHAIR]
    assert not bank.best_length[:, [BOOK, FRIDGE]].any()

    # Books are not a goal, but they are detected.
    assert ROW_FORMAT.presence(bank.rows)[0].tolist() == [True, True, False]

    # The fridge is too far from the only cell.
    with pytest.raises(InputError, match="Fridge"):
        compile_bank([scene], dataclasses.replace(task, goals=("Fridge",)))


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_a_possible_goal_can_be_reached_from_every_cell(rules):
    # Only a diagonal move leads to the last cell. The chair is near it and near the row, the book only near the row.
    chair = ("Chair", 2.0, 1.0, 0.0, *SMALL)
    book = ("Book", 0.0, 1.0, 0.0, *SMALL)
    scene = draw(["........#", "########."], chair, book)
    task = Task(CATEGORIES, rules=dataclasses.replace(rules, success_distance=0.5), detector=PERFECT_DETECTOR)
    assert compile_bank([scene], task).num_goals.tolist() == [2]

    # With four headings no move is diagonal, so only the chair can be reached from every cell.
    four_headings = dataclasses.replace(task.rules, headings=4)
    bank = compile_bank([scene], dataclasses.replace(task, rules=four_headings))
    assert bank.goals[0, : bank.num_goals[0]].tolist() == [CHAIR]


@pytest.mark.parametrize(("rules", "checksum"), [(ROOMS, 0xFA3B430A), (Rules(headings=12), 0x6D3553F4)])
def test_banks_keep_the_checksums_of_earlier_versions(rules, checksum):
    """Stored runs and benchmarks recognize their scenes by checksum. These checksums are older than `front_cell`."""
    scene = draw(["...."], BOOK_AHEAD, ("Chair", 0.5, 1, 0.5, *SMALL))
    assert bank_checksum(compile_bank([scene], Task(CATEGORIES, rules=rules))) == checksum


def test_concatenated_banks_equal_the_bank_of_all_scenes():
    near_book = ("Book", 0, 1.5, 1, *SMALL)
    scenes = [draw(["..", ".."], near_book), draw(["..."], ("Chair", 0.25, 1.5, 1, *SMALL)), draw(["."], near_book)]
    task = Task(CATEGORIES, rules=ROOMS)
    expected_bank = compile_bank(scenes, task)
    bank = concatenate_banks([compile_bank(scenes[:1], task), compile_bank(scenes[1:], task)])
    assert expected_bank.first_cell.tolist() == [0, 4, 7]

    # Every field has the expected dtype and values.
    for field_name, expected_field, field in zip(bank._fields, expected_bank, bank, strict=True):
        assert getattr(expected_field, "dtype", None) == getattr(field, "dtype", None)
        np.testing.assert_array_equal(expected_field, field, err_msg=field_name)
