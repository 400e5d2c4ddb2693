"""Scenes to tables: detections, the ego-centric view, and banks."""

import dataclasses

import numpy as np
import pytest
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, FRIDGE, HOUSES, ROOMS, SMALL, draw

from jaxnav.errors import InputError
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_bank, compile_scene, concatenate_banks
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, RowFormat
from jaxnav.scenes.task import Task

ROW_FORMAT = RowFormat(len(CATEGORIES))
BOOK_AHEAD = ("Book", 0, 1.5, 2, *SMALL)


def table_of(scene, rules=ROOMS):
    return compile_scene(scene, Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR))


def test_the_bytes_of_a_detection():
    # 2 m ahead with size 0.6 m, so range 5 m: confidence 1 - 0.5 x 0.4 = 0.8, apparent size 0.3.
    row = table_of(draw(["."], BOOK_AHEAD)).rows[0]
    assert ROW_FORMAT.detections(row)[BOOK].tolist() == [
        204,
        102,
        128,
        38,
    ]  # 0.8 x 255, 2 x 51, 128, 0.3 x 127.5 = 38.25
    assert not ROW_FORMAT.detections(row)[CHAIR].any()
    # 0.9 m at a distance of 0.4 m: apparent size 2.25 x 127.5 = 286.9, more than a byte holds.
    row = table_of(draw(["."], ("Chair", 0, 1.5, 0.4, 0.9, 0.9, 0.1))).rows[0]
    assert ROW_FORMAT.detections(row)[CHAIR].tolist() == [245, 20, 128, 255]  # 1 - 0.5 x 0.08 = 0.96: 244.8


# The ego-centric view


def view_of(scene, cell, heading, rules=ROOMS):
    """Return the view as a picture, the far edge first."""
    place = standable_cells(scene.reach).tolist().index(list(cell))
    pose = place * rules.poses_per_cell + heading * len(rules.horizons)
    cells = ROW_FORMAT.view_cells(table_of(scene, rules).rows[pose]).reshape(11, 11)
    return ["".join("?.#"[value] for value in row) for row in cells[::-1]]


def test_view_of_a_drawn_room():
    room = [list("." * 13) for _ in range(9)]
    room[3][6] = room[2][4] = "#"
    wardrobe, chest = ("Wardrobe", 1.5, 1, 0.75, 0.3, 2, 0.3), ("Chest", 1, 0.45, 0.5, 0.3, 0.9, 0.3)
    # The wardrobe on [3, 6] hides what is right behind it, the chest on [2, 4] is too low. Half the field of view is
    # 1.19 cells a step. The line to a cell one aside stays in the agent's column for half its way, where it meets the
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
    task = Task(CATEGORIES, ("Chair", "Fridge"), rules, PERFECT_DETECTOR)
    bank = compile_bank([scene], task)
    assert bank.goals[0, : bank.num_goals[0]].tolist() == [CHAIR]
    assert not bank.best_length[:, [BOOK, FRIDGE]].any()
    assert ROW_FORMAT.presence(bank.rows)[0].tolist() == [True, True, False]  # but books are detected
    with pytest.raises(InputError, match=r"categories Fridge near"):
        compile_bank([scene], dataclasses.replace(task, goals=("Fridge",)))


# Banks end to end


def test_banks_end_to_end_are_the_bank_of_all_scenes():
    near = ("Book", 0, 1.5, 1, *SMALL)
    scenes = [draw(["..", ".."], near), draw(["..."], ("Chair", 0.25, 1.5, 1, *SMALL)), draw(["."], near)]
    task = Task(CATEGORIES, rules=ROOMS)
    whole = compile_bank(scenes, task)
    parts = concatenate_banks([compile_bank(scenes[:1], task), compile_bank(scenes[1:], task)])
    assert whole.first_cell.tolist() == [0, 4, 7]
    for name, one, other in zip(whole._fields, whole, parts, strict=True):
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)
        np.testing.assert_array_equal(one, other, err_msg=name)
