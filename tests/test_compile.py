"""From scenes to tables: rows, ego-centric view, detector, best lengths, standable cells and banks."""

import dataclasses
from collections import deque

import jax.numpy as jnp
import numpy as np
import pytest
from drawn import BOOK, CATEGORIES, CHAIR, SMALL, draw
from scipy.stats import binomtest, kstest

from jaxnav.errors import InputError
from jaxnav.scenes.compile import compile_bank, compile_scene
from jaxnav.scenes.detector import PERFECT, Detector, detection_range
from jaxnav.scenes.lattice import best_lengths, standable_cells, successors
from jaxnav.scenes.rooms import generate_rooms
from jaxnav.scenes.rows import RowLayout
from jaxnav.scenes.scene import Scene

LAYOUT = RowLayout(len(CATEGORIES))
BOOK_AHEAD = ("Book", 0, 1.5, 2, *SMALL)


def table_of(scene, detector=PERFECT):
    return compile_scene(scene, CATEGORIES, detector, LAYOUT)


# Rows


@pytest.mark.parametrize(("num_categories", "num_bytes"), [(22, 128), (37, 192)])
def test_rows_unpack_to_what_was_packed(num_categories, num_bytes):
    # 22: 88 + 3 + 31 = 122 bytes (121 cells of 2 bits are 30.25 bytes); 37: 148 + 5 + 31 = 184; whole lines of 32.
    layout, draws, poses = RowLayout(num_categories), np.random.default_rng(0), 50
    detections = draws.integers(0, 256, (poses, num_categories, 4), np.uint8)
    detections[draws.random((poses, num_categories)) < 0.5] = 0
    found = draws.random((poses, num_categories)) < 0.3
    view = draws.integers(0, 3, (poses, 11, 11), np.uint8)
    rows = layout.pack(detections, found, view)
    assert (rows.shape, rows.dtype) == ((poses, layout.num_bytes), np.uint8)
    assert layout.num_bytes == num_bytes
    for array in (rows, jnp.asarray(rows)):
        np.testing.assert_array_equal(layout.detections(array), detections)
        np.testing.assert_array_equal(layout.presence(array), detections[..., 0] > 0)
        np.testing.assert_array_equal(layout.view_cells(array), view.reshape(poses, -1))
        np.testing.assert_array_equal(layout.view_cells(array[0]), view[0].reshape(-1))
    byte, bit = layout.found_at(np.arange(num_categories))
    np.testing.assert_array_equal(rows[:, byte] >> bit.astype(np.uint8) & 1, found)


def test_the_bytes_of_a_detection():
    # 2 m ahead with size 0.6 m, so range 5 m: confidence 1 - 0.5 x 0.4 = 0.8, apparent size 0.3.
    row = table_of(draw(["."], BOOK_AHEAD)).rows[0]
    assert LAYOUT.detections(row)[BOOK].tolist() == [204, 102, 128, 38]  # 0.8 x 255, 2 x 51, 128, 0.3 x 127.5 = 38.25
    assert not LAYOUT.detections(row)[CHAIR].any()
    # 0.9 m at a distance of 0.4 m: apparent size 2.25 x 127.5 = 286.9, more than a byte holds.
    row = table_of(draw(["."], ("Chair", 0, 1.5, 0.4, 0.9, 0.9, 0.1))).rows[0]
    assert LAYOUT.detections(row)[CHAIR].tolist() == [245, 20, 128, 255]  # 1 - 0.5 x 0.08 = 0.96: 244.8


# The ego-centric view


def view_of(scene, cell, heading):
    """The view as a picture, the far edge first."""
    table = table_of(scene)
    place = table.cells.tolist().index(list(cell))
    cells = LAYOUT.view_cells(table.rows[(place * 8 + heading) * 2]).reshape(11, 11)
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


def test_a_mirrored_room_has_a_mirrored_view():
    draws = np.random.default_rng(0)
    for _ in range(5):
        reach, walls = draws.random((9, 9)) < 0.8, draws.random((9, 9)) < 0.1
        reach &= ~walls
        scene = dataclasses.replace(draw(["." * 9] * 9), reach=reach, walls=walls)
        mirrored = dataclasses.replace(scene, reach=reach[:, ::-1], walls=walls[:, ::-1])
        iz, ix = draws.permutation(standable_cells(reach))[0]
        for heading in range(8):
            picture = view_of(scene, (iz, ix), heading)
            assert view_of(mirrored, (iz, 8 - ix), -heading % 8) == [row[::-1] for row in picture]


# The detector


def detect(detector, seen, distance, num_poses=40_000):
    """Detections uint8 [P, 2, 4] of objects of 0.6 m (range 5 m) straight ahead."""
    shape = (num_poses, 2)
    ahead, size = np.full(shape, float(distance)), np.full(shape, 0.6)
    return detector.detect("room", np.full(shape, seen), ahead, np.zeros(shape), ahead, size)


@pytest.mark.parametrize(("distance", "rate"), [(0.0, 0.1), (2.5, 0.2), (5.0, 0.5)])
def test_misses_grow_with_the_square_of_the_distance(distance, rate):
    # 0.1 + 0.4 (2.5 / 5)^2 = 0.2.
    entries = detect(Detector(miss_near=0.1, miss_far=0.5, false_alarm=0.5), True, distance)
    missed = entries[..., 0] == 0
    assert binomtest(int(missed.sum()), missed.size, rate).pvalue > 1e-3
    assert binomtest(int(missed.sum()), missed.size, rate + 0.02).pvalue < 1e-3  # the test can tell
    assert not entries[missed].any()
    # Confidence 1 - 0.5 d / 5 m, plus or minus 0.1; the place is not noisy.
    confidence = entries[~missed][:, 0] / 255
    expected = 1.0 - 0.1 * distance
    assert confidence.min() >= expected - 0.1 - 1 / 255
    assert confidence.max() <= min(expected + 0.1, 1.0) + 1 / 255
    assert (entries[~missed][:, 1:3] == [round(51 * distance), 128]).all()


def test_false_alarms_fill_the_view_cone():
    entries = detect(Detector(false_alarm=0.1), False, 1.0)
    alarms = entries[entries[..., 0] > 0]
    assert binomtest(len(alarms), entries[..., 0].size, 0.1).pvalue > 1e-3
    confidence, ahead, right = alarms[:, 0] / 255, alarms[:, 1] / 51, (alarms[:, 2] - 128.0) / 25.4
    assert kstest(confidence, "uniform", (0.3, 0.3)).pvalue > 1e-6  # quantised, hence not 1e-3
    assert (np.abs(right) <= np.tan(np.deg2rad(50)) * ahead + 0.05).all()  # a quantum is 0.02 m and 0.04 m
    # The range of 0.3 m is 0.3 / 0.12 = 2.5 m, the greatest offset to a side 2.5 sin 50 = 1.92 m.
    distance = np.hypot(ahead, right)
    assert (max(distance), max(np.abs(right))) == pytest.approx((2.5, 1.92), abs=0.05)
    # Uniform in a sector: a quarter of the area lies within half the radius, and half of it to the right.
    assert binomtest(int((distance < 1.25).sum()), len(alarms), 0.25).pvalue > 1e-3
    assert binomtest(int((right > 0).sum()), int((right != 0).sum()), 0.5).pvalue > 1e-3
    # The confidence says nothing of the place: 8,000 independent pairs have correlations of 0.011 or so.
    for offset in (np.arctan2(right, ahead), distance):
        assert abs(np.corrcoef(confidence, offset)[0, 1]) < 0.05
    # An object of that apparent size at that distance could be detected (a quantum of either is worth 0.1 m).
    size = alarms[:, 3] / 127.5 * np.maximum(distance, 0.25)
    assert (distance <= detection_range(size) + 0.12).all()
    assert not entries[entries[..., 0] == 0].any()


def test_errors_are_frozen_and_belong_to_the_scene():
    scenes = generate_rooms(3, 0, 0)
    together, again, alone = compile_bank(scenes), compile_bank(scenes), compile_bank(scenes[1:2])
    np.testing.assert_array_equal(together.rows, again.rows)
    first = together.first_cell[1] * 16
    np.testing.assert_array_equal(together.rows[first : first + len(alone.rows)], alone.rows)
    other_seed, other_name = Detector(seed=1), dataclasses.replace(scenes[1], name="other")
    assert (compile_bank(scenes[1:2], detector=other_seed).rows != alone.rows).any()
    assert (compile_bank([other_name]).rows != alone.rows).any()


def test_success_is_never_noisy():
    scenes, layout = generate_rooms(2, 0, 0), RowLayout(22)
    blind, perfect = (compile_bank(scenes, detector=d) for d in (Detector(miss_near=1.0, miss_far=1.0), PERFECT))
    np.testing.assert_array_equal(blind.best_length, perfect.best_length)
    byte, _ = layout.found_at(np.arange(22))
    np.testing.assert_array_equal(blind.rows[:, byte], perfect.rows[:, byte])
    assert layout.presence(blind.rows).sum() < 0.1 * layout.presence(perfect.rows).sum()


# Moves


def test_standable_cells_are_the_largest_part_and_the_first_of_equal_ones():
    def cells(*rows):
        return [tuple(cell) for cell in standable_cells(np.array([[c == "." for c in row] for row in rows])).tolist()]

    assert cells(".#..", "##..", "####") == [(0, 2), (0, 3), (1, 2), (1, 3)]
    assert cells("#.#..", "#.###") == [(0, 1), (1, 1)]
    assert cells("##..", ".###", ".###") == [(0, 2), (0, 3)]  # [0, 2] comes before [1, 0] in row order
    assert cells(".#.", "#.#", ".#.") == [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)]  # diagonals connect
    assert cells("##") == []


def test_best_lengths_are_those_of_a_breadth_first_search():
    draws = np.random.default_rng(0)
    successor = successors(standable_cells(draws.random((9, 9)) < 0.55))
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
    bank = compile_bank([hopeless[0], good, *hopeless[1:], near], CATEGORIES)
    assert bank.names == ("good", "near")
    assert bank.skipped == ("empty", "nowhere", "too far", "not sought")
    # In the good room the book is 2 m away, so only the chair is a goal.
    assert [bank.goals[i, :n].tolist() for i, n in enumerate(bank.num_goals)] == [[CHAIR], [BOOK]]
    assert (bank.first_cell.tolist(), bank.num_cells.tolist()) == ([0, 4], [4, 4])
    assert bank.successor[:64].max() < 64 <= bank.successor[64:].min()
    with pytest.raises(InputError, match=r"none of the 4 scenes has a reachable goal.*Book, Chair, Fridge"):
        compile_bank(hopeless, CATEGORIES)
