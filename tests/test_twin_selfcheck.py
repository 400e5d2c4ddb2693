"""The plain-Python twin against tiny scenes worked by hand: moves, the course of an episode and its measures."""

import math

import pytest
from drawn import BOOK, CHAIR, SMALL, draw, single, twin
from twin import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT


@pytest.mark.parametrize(
    ("heading", "cell"),
    [(0, (2, 1)), (1, (2, 2)), (2, (1, 2)), (3, (0, 2)), (4, (0, 1)), (5, (0, 0)), (6, (1, 0)), (7, (2, 0))],
)
def test_move_ahead_goes_to_the_neighbour_of_the_heading(heading, cell):
    # Clockwise from +z: 45 degrees is +z +x, 90 degrees +x, ...
    episode = twin(draw(["...", "...", "..."]), cell=(1, 1), heading=heading)
    assert episode.step(MOVE_AHEAD) == (-0.01, False, False)
    assert episode.pose == (*cell, heading, 0)


def test_a_diagonal_move_needs_only_its_own_cell():
    episode = twin(draw([".#", "#."]), heading=1)
    episode.step(MOVE_AHEAD)
    assert episode.cell == (1, 1)


@pytest.mark.parametrize("heading", [0, 2, 4, 6, 7])
def test_a_blocked_move_changes_nothing_and_costs_a_step(heading):
    # [1, 0] and [0, 1] are not standable, the other neighbours lie outside.
    episode = twin(draw([".#", "#."]), heading=heading)
    assert episode.step(MOVE_AHEAD) == (-0.01, False, False)
    assert (episode.pose, episode.steps) == ((0, 0, heading, 0), 1)


def test_standable_is_the_largest_component_and_the_first_of_equal_ones():
    assert twin(draw([".#..", "##..", "####"]), cell=(0, 2)).standable() == {(0, 2), (0, 3), (1, 2), (1, 3)}
    assert twin(draw(["..#..", "..#.."])).standable() == {(0, 0), (0, 1), (1, 0), (1, 1)}
    with pytest.raises(ValueError, match="not standable"):
        twin(draw(["..#..", "..#.."]), cell=(0, 3))


def test_rotations_wrap_and_looks_stop_at_their_limits():
    episode = twin(draw(["."]))
    poses = []
    for action in (ROTATE_LEFT, ROTATE_RIGHT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, LOOK_DOWN, LOOK_UP):
        assert episode.step(action) == (-0.01, False, False)
        poses.append((episode.heading, episode.horizon))
    assert poses == [(7, 0), (0, 0), (1, 0), (1, 0), (1, 1), (1, 1), (1, 0)]


def test_done_ends_the_episode_and_pays_where_the_goal_is_found():
    book = ("Book", 0, 1.5, 1, *SMALL)
    assert single(book).step(DONE) == (5.0, True, False)
    assert single(book, heading=4).step(DONE) == (-0.01, True, False)
    wrong = single(book, goal=CHAIR)
    assert wrong.step(DONE) == (-0.01, True, False)
    with pytest.raises(RuntimeError, match="over"):
        wrong.step(DONE)


def test_truncation_at_the_step_limit_unless_done():
    episode = single(("Book", 0, 1.5, 1, *SMALL), step_limit=2)
    assert episode.step(LOOK_UP) == (-0.01, False, False)
    assert episode.step(LOOK_UP) == (-0.01, False, True)
    episode.reset(BOOK, (0, 0), 0, 0, 2)
    episode.step(LOOK_UP)
    assert episode.step(DONE) == (5.0, True, False)


def test_best_length_in_a_corridor():
    # The book at z = 2.5 is within 1.5 m from iz = 4 on. Along the corridor only headings 0 and 4 move.
    corridor = draw(["."] * 6, ("Book", 0, 1.5, 2.5, *SMALL))
    assert twin(corridor).best_length() == 5  # 4 moves, Done
    assert twin(corridor, heading=4).best_length() == 9  # 4 turns first
    assert twin(corridor, cell=(5, 0), heading=4).best_length() == 4  # 45 degrees off (< 50) will do: 3 turns, Done
    assert twin(corridor, cell=(4, 0)).best_length() == 1
    assert twin(corridor, goal=CHAIR).best_length() is None


def test_best_length_counts_looking_down_and_starts_at_the_start():
    # On the floor at z = 2 and 1.5 m away from iz = 2: level, rise -1.5 >= -1.19 x 1.5 = -1.79, so it is in view.
    # From iz = 3, 1.25 m away, -1.49 > -1.5: one look down.
    scene = draw(["."] * 4, ("Book", 0, 0, 2, *SMALL))
    assert twin(scene, cell=(2, 0)).best_length() == 1
    assert twin(scene, cell=(3, 0)).best_length() == 2
    episode = twin(scene)
    episode.step(MOVE_AHEAD)
    episode.step(MOVE_AHEAD)
    assert (episode.best_length(), episode.step(DONE)) == (3, (5.0, True, False))


def test_best_length_is_none_where_a_wall_hides_the_goal():
    scene = (["...", "###", "###"], ("Book", 0.25, 1.5, 0.75, *SMALL))
    assert twin(draw(*scene), cell=(0, 1)).best_length() == 1
    assert twin(draw(*scene, walls=[(1, 0), (1, 1), (1, 2)]), cell=(0, 1)).best_length() is None


def test_goal_distance_is_to_the_nearest_goal_less_a_metre():
    books = (("Book", 3, 0.5, 4, *SMALL), ("Book", 6, 0.5, 8, *SMALL), ("Chair", 0, 0.5, 2, *SMALL))
    episode = twin(draw([".", ".", "."], *books))
    assert episode.goal_distance() == pytest.approx(4.0)  # |(3, 4)| - 1
    episode.step(MOVE_AHEAD)
    assert episode.goal_distance() == pytest.approx(math.hypot(3, 3.75) - 1)
    assert single(("Book", 0.6, 0.5, 0.8, *SMALL)).goal_distance() == 0.0
