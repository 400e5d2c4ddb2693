"""Tests that the twin moves, ends, measures and views as worked out by hand."""

import dataclasses
import math

import pytest
from support.scenes import APARTMENTS, BOOK, CHAIR, HOUSES, SMALL, draw
from twins.environment import (
    DONE,
    LOOK_DOWN,
    LOOK_UP,
    MOVE_AHEAD,
    ROTATE_LEFT,
    ROTATE_RIGHT,
    start_in_one_cell,
    start_twin,
)


@pytest.mark.parametrize(
    ("heading", "cell"),
    [(0, (2, 1)), (1, (2, 2)), (2, (1, 2)), (3, (0, 2)), (4, (0, 1)), (5, (0, 0)), (6, (1, 0)), (7, (2, 0))],
)
def test_twin_moves_ahead_to_the_neighbour_in_its_heading(heading, cell):
    # Clockwise from +z: 45 degrees is +z +x, 90 degrees +x, ...
    episode = start_twin(draw(["...", "...", "..."]), cell=(1, 1), heading=heading)
    assert episode.step(MOVE_AHEAD) == (-0.01, False, False)
    assert episode.pose == (*cell, heading, 0)


@pytest.mark.parametrize(
    ("headings", "cell"),
    [
        ((0,), (2, 1)),
        ((1, 2), (2, 2)),
        ((3,), (1, 2)),
        ((4, 5), (0, 2)),
        ((6,), (0, 1)),
        ((7, 8), (0, 0)),
        ((9,), (1, 0)),
        ((10, 11), (2, 0)),
    ],
)
def test_twin_with_twelve_headings_reaches_each_diagonal_cell_by_two_headings(headings, cell):
    # 30 and 60 degrees are 15 degrees from the diagonal at 45, and 30 degrees from the axes at 0 and 90.
    for heading in headings:
        episode = start_twin(draw(["...", "...", "..."]), cell=(1, 1), heading=heading, rules=APARTMENTS)
        episode.step(MOVE_AHEAD)
        assert episode.pose == (*cell, heading, 0)


def test_twin_moves_diagonally_between_blocked_cells():
    episode = start_twin(draw([".#", "#."]), heading=1)
    episode.step(MOVE_AHEAD)
    assert episode.cell == (1, 1)


@pytest.mark.parametrize("heading", [0, 2, 4, 6, 7])
def test_twin_stays_and_pays_for_a_step_when_blocked(heading):
    # Cells [1, 0] and [0, 1] are not standable, and all further neighbours lie outside the lattice.
    episode = start_twin(draw([".#", "#."]), heading=heading)
    assert episode.step(MOVE_AHEAD) == (-0.01, False, False)
    assert (episode.pose, episode.steps) == ((0, 0, heading, 0), 1)


def test_standable_cells_are_the_largest_component_or_the_first_of_equal_ones():
    assert start_twin(draw([".#..", "##..", "####"]), cell=(0, 2)).standable() == {(0, 2), (0, 3), (1, 2), (1, 3)}
    assert start_twin(draw(["..#..", "..#.."])).standable() == {(0, 0), (0, 1), (1, 0), (1, 1)}
    with pytest.raises(ValueError, match="not standable"):
        start_twin(draw(["..#..", "..#.."]), cell=(0, 3))


def test_twin_wraps_rotations_and_stops_horizons_at_their_limits():
    episode = start_twin(draw(["."]))
    poses = []
    for action in (ROTATE_LEFT, ROTATE_RIGHT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, LOOK_DOWN, LOOK_UP):
        assert episode.step(action) == (-0.01, False, False)
        poses.append((episode.heading, episode.horizon))
    assert poses == [(7, 0), (0, 0), (1, 0), (1, 0), (1, 1), (1, 1), (1, 0)]


def test_twin_of_houses_has_twelve_headings_and_one_horizon():
    episode = start_twin(draw(["."]), rules=HOUSES)
    poses = []
    for action in (ROTATE_LEFT, LOOK_DOWN, LOOK_UP, ROTATE_RIGHT, ROTATE_RIGHT):
        episode.step(action)
        poses.append((episode.heading, episode.horizon))
    assert poses == [(11, 0), (11, 0), (11, 0), (0, 0), (1, 0)]


def test_done_terminates_and_pays_only_for_success():
    book = ("Book", 0, 1.5, 1, *SMALL)
    assert start_in_one_cell(book).step(DONE) == (5.0, True, False)
    assert start_in_one_cell(book, heading=4).step(DONE) == (-0.01, True, False)

    # Another goal fails, and an episode that has ended refuses to go on.
    chair_episode = start_in_one_cell(book, goal=CHAIR)
    assert chair_episode.step(DONE) == (-0.01, True, False)
    with pytest.raises(RuntimeError, match="over"):
        chair_episode.step(DONE)


def test_step_limit_truncates_unless_the_last_action_is_done():
    episode = start_in_one_cell(("Book", 0, 1.5, 1, *SMALL), step_limit=2)
    assert episode.step(LOOK_UP) == (-0.01, False, False)
    assert episode.step(LOOK_UP) == (-0.01, False, True)

    # Done at the limit terminates.
    episode.reset(BOOK, (0, 0), 0, 0, 2)
    episode.step(LOOK_UP)
    assert episode.step(DONE) == (5.0, True, False)


def test_best_length_counts_moves_turns_and_done():
    # The book at z = 2.5 is within 1.5 m from iz = 4 on. Only headings 0 and 4 move along the corridor.
    corridor = draw(["."] * 6, ("Book", 0, 1.5, 2.5, *SMALL))
    assert start_twin(corridor).best_length() == 5  # 4 moves, Done
    assert start_twin(corridor, heading=4).best_length() == 9  # 4 turns, 4 moves, Done
    assert start_twin(corridor, cell=(4, 0)).best_length() == 1

    # A heading 45 degrees off the book (< 50) is enough: 3 turns, Done.
    assert start_twin(corridor, cell=(5, 0), heading=4).best_length() == 4

    # No way leads to a category without an object.
    assert start_twin(corridor, goal=CHAIR).best_length() is None


def test_best_length_counts_looking_down_and_starts_at_the_start_pose():
    # The book lies on the floor at z = 2. From iz = 2 it is 1.5 m away and in view of a level camera: its rise of -1.5
    # is above -1.19 x 1.5 = -1.79. From iz = 3 it is 1.25 m away, and -1.5 is below -1.49: one look down is needed.
    scene = draw(["."] * 4, ("Book", 0, 0, 2, *SMALL))
    assert start_twin(scene, cell=(2, 0)).best_length() == 1
    assert start_twin(scene, cell=(3, 0)).best_length() == 2

    # Two moves, Done: the length does not change on the way.
    episode = start_twin(scene)
    episode.step(MOVE_AHEAD)
    episode.step(MOVE_AHEAD)
    assert episode.best_length() == 3
    assert episode.step(DONE) == (5.0, True, False)


def test_best_length_is_none_where_a_wall_hides_the_goal():
    rows = ["...", "###", "###"]
    book = ("Book", 0.25, 1.5, 0.75, *SMALL)
    walls = [(1, 0), (1, 1), (1, 2)]
    assert start_twin(draw(rows, book), cell=(0, 1)).best_length() == 1
    assert start_twin(draw(rows, book, walls=walls), cell=(0, 1)).best_length() is None


def test_goal_distance_is_to_the_nearest_goal_less_a_metre():
    near_book = ("Book", 3, 0.5, 4, *SMALL)
    far_book = ("Book", 6, 0.5, 8, *SMALL)
    chair = ("Chair", 0, 0.5, 2, *SMALL)
    episode = start_twin(draw([".", ".", "."], near_book, far_book, chair))
    assert episode.goal_distance() == pytest.approx(4.0)  # |(3, 4)| - 1
    episode.step(MOVE_AHEAD)
    assert episode.goal_distance() == pytest.approx(math.hypot(3, 3.75) - 1)

    # Within a metre the distance is 0.
    assert start_in_one_cell(("Book", 0.6, 0.5, 0.8, *SMALL)).goal_distance() == 0.0


# Walking

CHEST = (0.5, 0.5, 0.5)  # its footprint reaches 0.25 m to every side


@pytest.mark.parametrize(("z", "goals"), [(1.25, {BOOK}), (1.25 + 5e-10, {BOOK}), (1.26, set())])
def test_success_in_houses_is_within_1_m_of_the_footprint_visible_or_not(z, goals):
    for heading in range(12):
        assert start_in_one_cell(("Book", 0, 5, z, *CHEST), heading=heading, rules=HOUSES).successes() == goals

    # Inside the footprint the walk has length 0.
    book_around_agent = ("Book", 0, 5, 0.1, *CHEST)
    assert start_in_one_cell(book_around_agent, rules=HOUSES).successes() == {BOOK}


def walk_to_book(rows, *box, walls=(), cell=(0, 0)):
    """Return the metres from a cell to a book with the given centre and sides."""
    episode = start_twin(draw(rows, ("Book", *box), walls=walls), cell=cell, rules=HOUSES)
    return episode.scene.walk(cell, BOOK)


def test_walk_goes_by_cells_and_then_straight_to_the_footprint():
    # The corner (0.5, 1) of the footprint is 1.118 m from [0, 0], more than the 1 m of a straight last part. After a
    # diagonal step to [1, 1], |(0.25, 0.75)| = 0.791 m remain, after an upright step to [1, 0] |(0.5, 0.75)| = 0.901 m:
    # 1.144 and 1.151 m in all.
    rows = ["..", ".."]
    book = (0.75, 1, 1.25, *CHEST)
    assert walk_to_book(rows, *book) == pytest.approx(0.25 * 2**0.5 + 0.625**0.5)
    assert walk_to_book([".#", ".#"], *book) == pytest.approx(0.25 + 0.8125**0.5)
    assert walk_to_book(rows, *book, cell=(1, 1)) == pytest.approx(0.625**0.5)
    assert walk_to_book(["."], *book) == math.inf


def test_walk_goes_round_thin_walls():
    # The footprint begins at z = 0.75 and ends at x = 0.25.
    book = (0, 1, 1, *CHEST)
    assert walk_to_book(["...."] * 4, *book) == pytest.approx(0.75)

    # Round the wall cells [2, 0] to [2, 2] the way is [1, 1], [1, 2], [2, 3], [3, 2]: three diagonal steps, an upright
    # step, and 0.25 m straight to the footprint. The line from [2, 3] to (0.25, 0.75) would pass [2, 2].
    rows = ["....", "....", "###.", "...."]
    walls = [(2, 0), (2, 1), (2, 2)]
    assert walk_to_book(rows, *book, walls=walls) == pytest.approx(3 * 0.25 * 2**0.5 + 0.25 + 0.25)

    # A wall across the whole room leaves no way.
    assert walk_to_book(["....", "....", "####", "...."], *book, walls=[*walls, (2, 3)]) == math.inf


def test_walk_ignores_wall_cells_at_the_start_and_around_the_object():
    # The footprint, z from 0.4 to 0.6, begins 0.4 m away. Wall cell [2, 0], z from 0.375 to 0.625, holds its centre.
    rows = [".", "#", "#"]
    thin_box = (0, 1, 0.5, 0.5, 0.5, 0.2)
    assert walk_to_book(rows, *thin_box, walls=[(2, 0)]) == pytest.approx(0.4)
    assert walk_to_book(rows, *thin_box, walls=[(1, 0), (2, 0)]) == math.inf
    assert walk_to_book(rows, *thin_box, walls=[(0, 0)]) == pytest.approx(0.4)

    # A chest from 0.5 to 1.0 m that only reaches into wall cell [2, 0] stands behind the wall.
    chest = (0, 1, 0.75, *CHEST)
    assert walk_to_book(rows, *chest, walls=[(2, 0)]) == math.inf
    assert walk_to_book([*rows, "#"], *chest, walls=[(3, 0)]) == pytest.approx(0.5)


def test_best_length_and_goal_distance_in_houses_follow_walks():
    # The footprint begins at z = 1.75, so success begins at z = 0.75, three moves away.
    corridor = draw(["."] * 6, ("Book", 0, 0.5, 2, *CHEST))
    assert start_twin(corridor, rules=HOUSES).best_length() == 4
    assert start_twin(corridor, heading=6, rules=HOUSES).best_length() == 10  # 6 rotations before the moves
    assert start_twin(corridor, cell=(3, 0), heading=6, rules=HOUSES).best_length() == 1

    # 1.75 m to the footprint less a metre.
    assert start_twin(corridor, rules=HOUSES).goal_distance() == pytest.approx(0.75)
    assert start_twin(corridor, cell=(4, 0), rules=HOUSES).goal_distance() == 0.0
    assert start_twin(corridor, goal=CHAIR, rules=HOUSES).goal_distance() == math.inf


# The view


def view_rows(episode):
    """Return the 11 rows of the view as text, the far edge first."""
    cells = episode.view()
    rows = []
    for first_cell in range(0, 121, 11):
        rows.append("".join("?.#"[value] for value in cells[first_cell : first_cell + 11]))
    return rows[::-1]


def cells_straight_ahead(episode):
    """Return the middle column of the view, from the agent on."""
    return "".join(row[5] for row in reversed(view_rows(episode)))


def test_view_at_30_degrees_rounds_to_cells():
    # Half of the cone is 0.824 cells wide per step ahead. In heading 1 of 12 the direction is (x, z) = (1/2, 0.866):
    # 3 steps ahead are (1.5, 2.6), the cell [3, 2], because 1.5 is rounded to 2. In front is [1, 1], where MoveAhead
    # leads.
    rows = ["." * 13 for _ in range(13)]
    rows[3] = "..#.........."
    rows[1] = ".#..........."
    episode = start_twin(draw(rows), heading=1, rules=APARTMENTS)
    assert cells_straight_ahead(episode)[:4] == ".#.#"

    # Under the rule `nearest`, the cell in front is the free [1, 0], because 0.5 is rounded to 0.
    nearest_rules = dataclasses.replace(APARTMENTS, front_cell="nearest")
    assert cells_straight_ahead(start_twin(draw(rows), heading=1, rules=nearest_rules))[:4] == "...#"

    # 4 steps ahead are (2, 3.46), [3, 2] again; 3 steps to its left, at (2 - 2.60, 3.46 + 1.5), the lattice has ended.
    expected_rows = ["??#..#...??", "???..#..???", "????...????", "?????#?????", "?????.?????"]
    assert view_rows(episode)[-5:] == expected_rows


def test_view_hides_floor_behind_boxes_as_high_as_the_camera():
    # 5 steps ahead of the camera stands a chest, 0.9 m high: above the camera of houses, below that of apartments.
    chest = ("Chest", 1, 0.45, 1.25, 0.3, 0.9, 0.3)
    long_room = draw(["." * 9] * 12, chest)
    assert cells_straight_ahead(start_twin(long_room, cell=(0, 4), rules=APARTMENTS)) == "..........."
    assert cells_straight_ahead(start_twin(long_room, cell=(0, 4), rules=HOUSES)) == "......?????"

    # A chest beyond the lattice hides nothing.
    short_room = draw(["." * 9] * 5, chest)
    assert cells_straight_ahead(start_twin(short_room, cell=(0, 4), rules=HOUSES)) == ".....######"


def test_view_shows_the_wall_cells_at_both_ends_of_a_line():
    # Neither the cell of the agent nor the viewed cell itself hides the floor.
    walled_room = draw(["." * 9] * 5, walls=[(0, 4), (3, 4)])
    assert cells_straight_ahead(start_twin(walled_room, cell=(0, 4), rules=HOUSES)) == "....???????"
