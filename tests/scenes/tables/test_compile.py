"""From scenes to tables: rows, ego-centric view, standable cells, best lengths and banks."""

import dataclasses
from collections import deque

import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, FRIDGE, HOUSES, ROOMS, SMALL, draw

from jaxnav.errors import InputError
from jaxnav.scenes.lattice import ahead_of, best_lengths, standable_cells, successors
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_bank, compile_scene
from jaxnav.scenes.tables.detector import PERFECT
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.tables.visibility import rectangles
from jaxnav.scenes.task import Task

LAYOUT = RowFormat(len(CATEGORIES))
BOOK_AHEAD = ("Book", 0, 1.5, 2, *SMALL)


def table_of(scene, rules=ROOMS):
    return compile_scene(scene, Task(CATEGORIES, rules=rules, detector=PERFECT))


# Rows


@pytest.mark.parametrize(("num_categories", "num_bytes"), [(22, 128), (37, 192)])
def test_rows_unpack_to_what_was_packed(num_categories, num_bytes):
    # 22: 88 + 31 = 119 bytes (121 cells of 2 bits are 30.25 bytes); 37: 148 + 31 = 179; whole lines of 32.
    row_format, draws, poses = RowFormat(num_categories), np.random.default_rng(0), 50
    detections = draws.integers(0, 256, (poses, num_categories, 4), np.uint8)
    detections[draws.random((poses, num_categories)) < 0.5] = 0
    view = draws.integers(0, 3, (poses, 11, 11), np.uint8)
    rows = row_format.pack(detections, view)
    assert (rows.shape, rows.dtype) == ((poses, row_format.num_bytes), np.uint8)
    assert row_format.num_bytes == num_bytes
    for array in (rows, jnp.asarray(rows)):
        np.testing.assert_array_equal(row_format.detections(array), detections)
        np.testing.assert_array_equal(row_format.presence(array), detections[..., 0] > 0)
        np.testing.assert_array_equal(row_format.view_cells(array), view.reshape(poses, -1))
        np.testing.assert_array_equal(row_format.view_cells(array[0]), view[0].reshape(-1))


def test_the_bytes_of_a_detection():
    # 2 m ahead with size 0.6 m, so range 5 m: confidence 1 - 0.5 x 0.4 = 0.8, apparent size 0.3.
    row = table_of(draw(["."], BOOK_AHEAD)).rows[0]
    assert LAYOUT.detections(row)[BOOK].tolist() == [204, 102, 128, 38]  # 0.8 x 255, 2 x 51, 128, 0.3 x 127.5 = 38.25
    assert not LAYOUT.detections(row)[CHAIR].any()
    # 0.9 m at a distance of 0.4 m: apparent size 2.25 x 127.5 = 286.9, more than a byte holds.
    row = table_of(draw(["."], ("Chair", 0, 1.5, 0.4, 0.9, 0.9, 0.1))).rows[0]
    assert LAYOUT.detections(row)[CHAIR].tolist() == [245, 20, 128, 255]  # 1 - 0.5 x 0.08 = 0.96: 244.8


# The ego-centric view


def view_of(scene, cell, heading, rules=ROOMS):
    """The view as a picture, the far edge first."""
    place = standable_cells(scene.reach).tolist().index(list(cell))
    pose = place * rules.poses_per_cell + heading * len(rules.horizons)
    cells = LAYOUT.view_cells(table_of(scene, rules).rows[pose]).reshape(11, 11)
    return ["".join("?.#"[value] for value in row) for row in cells[::-1]]


def test_view_of_a_drawn_room():
    room = [list("." * 13) for _ in range(9)]
    room[3][6] = room[2][4] = "#"
    wardrobe, chest = ("Wardrobe", 1.5, 1, 0.75, 0.3, 2, 0.3), ("Chest", 1, 0.45, 0.5, 0.3, 0.9, 0.3)
    # The wardrobe on [3, 6] hides what is right behind it, the chest on [2, 4] is too low. Half the field of view is
    # 1.19 cells a step. The line to a cell one aside stays in the own column for half its way, where it meets the
    # wardrobe 3 steps ahead if it goes on for 6 steps or more. The room ends after 8 steps.
    assert view_of(draw(["".join(row) for row in room], wardrobe, chest), (0, 6), 0) == [
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


def test_a_wall_hides_what_is_behind_it():
    scene = draw(["." * 13] * 2 + ["#" * 13] + ["." * 13], walls=[(2, ix) for ix in range(13)])
    picture = view_of(scene, (0, 6), 0)
    assert picture[:8] == ["?" * 11] * 8
    assert picture[8:] == ["???#####???", "????...????", "?????.?????"]


def test_view_along_a_diagonal():
    # Heading 1 goes to +z +x. Cell [2, 2] is 2.83 cells ahead: 3 steps (2.12, rounded 2). Cell [3, 0] is 45 degrees to
    # the left: 2 steps ahead and 2 aside (z = 0.71 x 4 = 2.83, rounded 3).
    room = ["." * 12, "." * 12, "..#.........", "#..........."] + ["." * 12] * 8
    picture = view_of(draw(room), (0, 0), 1)[::-1]
    assert picture[:4] == ["?????.?????", "????...????", "???#....???", "??...#...??"]


@pytest.mark.parametrize("rules", [ROOMS, APARTMENTS, HOUSES])
def test_a_mirrored_room_has_a_mirrored_view(rules):
    # With 12 headings, many offsets are halves: the cell 1 ahead at 30 degrees lies half a cell to the right.
    draws = np.random.default_rng(0)
    for _ in range(5):
        reach, walls = draws.random((9, 9)) < 0.8, draws.random((9, 9)) < 0.1
        reach &= ~walls
        scene = dataclasses.replace(draw(["." * 9] * 9), reach=reach, walls=walls)
        mirrored = dataclasses.replace(scene, reach=reach[:, ::-1], walls=walls[:, ::-1])
        turned = dataclasses.replace(scene, reach=reach[::-1, ::-1], walls=walls[::-1, ::-1])
        iz, ix = draws.permutation(standable_cells(reach))[0]
        for heading in range(rules.headings):
            picture = view_of(scene, (iz, ix), heading, rules)
            flipped = view_of(mirrored, (iz, 8 - ix), -heading % rules.headings, rules)
            assert flipped == [row[::-1] for row in picture]
            assert view_of(turned, (8 - iz, 8 - ix), (heading + rules.headings // 2) % rules.headings, rules) == picture


# Moves


def test_standable_cells_are_the_largest_part_and_the_first_of_equal_ones():
    def cells(*rows):
        return [tuple(cell) for cell in standable_cells(np.array([[c == "." for c in row] for row in rows])).tolist()]

    assert cells(".#..", "##..", "####") == [(0, 2), (0, 3), (1, 2), (1, 3)]
    assert cells("#.#..", "#.###") == [(0, 1), (1, 1)]
    assert cells("##..", ".###", ".###") == [(0, 2), (0, 3)]  # [0, 2] comes before [1, 0] in row order
    assert cells(".#.", "#.#", ".#.") == [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)]  # diagonals connect
    assert cells("##") == []


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_best_lengths_are_those_of_a_breadth_first_search(rules):
    draws = np.random.default_rng(0)
    successor = successors(ahead_of(standable_cells(draws.random((9, 9)) < 0.55), rules), rules)
    found = draws.random((len(successor), 3)) < [0.002, 0.02, 0.0]
    lengths = best_lengths(successor, found)

    def search(start, goal):
        length, queue = {start: 1}, deque([start])
        while queue:
            pose = queue.popleft()
            if found[pose, goal]:
                return length[pose]
            for after in successor[pose, :5].tolist():
                if after not in length:
                    length[after] = length[pose] + 1
                    queue.append(after)
        return 0

    starts = range(0, len(successor), 7)
    assert [[search(start, goal) for goal in range(3)] for start in starts] == lengths[::7].tolist()
    assert lengths[:, 0].max() > 8
    assert not lengths[:, 2].any()
    np.testing.assert_array_equal(lengths == 1, found)


@pytest.mark.parametrize("density", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_rectangles_cover_a_mask_once(density):
    draws = np.random.default_rng(0)
    for _ in range(20):
        mask = draws.random(draws.integers(1, 9, 2)) < density
        cover = np.zeros(mask.shape, int)
        for z0, x0, z1, x1 in rectangles(mask):
            cover[z0:z1, x0:x1] += 1
        np.testing.assert_array_equal(cover, mask)
    assert rectangles(np.ones((3, 5), bool)).tolist() == [[0, 0, 3, 5]]


# Banks


def named(name: str, scene: Scene) -> Scene:
    return dataclasses.replace(scene, name=name)


def test_scenes_without_a_reachable_goal_are_left_out_by_name():
    good = named("good", draw(["...."], BOOK_AHEAD, ("Chair", 0.5, 1, 0.5, *SMALL)))
    hopeless = [
        named("empty", draw(["...."])),
        named("nowhere", draw(["####"], BOOK_AHEAD)),
        named("too far", draw(["...."], ("Book", 0, 1.5, 1.6, *SMALL))),
        named("not sought", draw(["...."], ("Vase", 0, 1.5, 1, *SMALL))),
    ]
    near = named("near", draw(["..", ".."], ("Book", 0, 1.5, 1, *SMALL)))
    task = Task(CATEGORIES)
    bank = compile_bank([hopeless[0], good, *hopeless[1:], near], task)
    assert (bank.task, bank.names) == (task, ("good", "near"))
    assert bank.skipped == ("empty", "nowhere", "too far", "not sought")
    # In the good room the book is 2 m away, so only the chair is a goal.
    assert [bank.goals[i, :n].tolist() for i, n in enumerate(bank.num_goals)] == [[CHAIR], [BOOK]]
    assert (bank.first_cell.tolist(), bank.num_cells.tolist()) == ([0, 4], [4, 4])
    assert bank.successor[:64].max() < 64 <= bank.successor[64:].min()
    with pytest.raises(InputError, match=r"none of the 4 scenes has a reachable goal.*Book, Chair, Fridge"):
        compile_bank(hopeless, task)


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_only_goals_of_the_task_are_looked_for(rules):
    scene = draw(["."], ("Book", 0, 1.0, 0.5, *SMALL), ("Chair", 0, 1.0, 0.6, *SMALL), ("Fridge", 5, 1, 0, 1, 2, 1))
    task = Task(CATEGORIES, ("Chair", "Fridge"), rules, PERFECT)
    bank = compile_bank([scene], task)
    assert bank.goals[0, : bank.num_goals[0]].tolist() == [CHAIR]
    assert not bank.best_length[:, [BOOK, FRIDGE]].any()
    assert LAYOUT.presence(bank.rows)[0].tolist() == [True, True, False]  # but books are detected
    with pytest.raises(InputError, match=r"categories Fridge near"):
        compile_bank([scene], dataclasses.replace(task, goals=("Fridge",)))
