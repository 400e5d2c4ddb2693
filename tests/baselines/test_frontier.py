"""Frontier search: worked walks in drawn rooms, and independence of anything but perception."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, HOUSES, ROOMS, SMALL, coarse_scene, draw, maze_scene

from jaxnav.baselines.frontier import frontier_walk, run_frontier_search
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, Detector, RowFormat
from jaxnav.scenes.task import DONE, LOOK_DOWN, MOVE_AHEAD, ROTATE_RIGHT, Task

BLIND = Detector(miss_near=1.0, miss_far=1.0, false_alarm=0.0)
BOOK_BEHIND = ("Book", 0.0, 0.8, -1.0, *SMALL)


def compile_scenes(*scenes, rules=ROOMS, detector=PERFECT_DETECTOR):
    """Bank of scenes in which all drawn categories are goals."""
    return compile_bank(scenes, Task(CATEGORIES, rules=rules, detector=detector))


def search_actions(bank, pose, goal=BOOK, step_limit=100):
    """Actions of the frontier searcher from a pose until it stops."""
    return [action for _, action in frontier_walk(bank, bank.successor, pose, goal, step_limit)]


def level_pose(cell, heading, rules=ROOMS):
    """Pose at a cell and a heading, with a level camera."""
    return rules.join_pose(cell, heading, 0)


def search_episodes(bank, num_episodes=60, step_limit=200):
    """Outcome of the frontier search [num_episodes] in drawn episodes, and the episodes."""
    episodes = draw_episodes(bank, num_episodes)
    return run_frontier_search(bank, episodes, np.full(len(bank.names), step_limit)), episodes


def test_frontier_walks_straight_to_a_visible_goal():
    # A corridor along +z with a book at z = 3 m: detected at once. It looks down, the first action of every search, and
    # so detects it from a second pose; 1.5 m less the slack are left from z = 1.75 m, seven cells on.
    bank = compile_scenes(draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL)))
    assert search_actions(bank, level_pose(0, heading=0)) == [LOOK_DOWN] + [MOVE_AHEAD] * 7 + [DONE]


def test_frontier_turns_until_it_has_seen_the_goal_twice():
    # One cell, the book 1 m behind. Right comes before left; at 135 degrees the book is 45 degrees aside, in the view
    # of 100 degrees, but seen once only; at 180 degrees it is seen again.
    bank = compile_scenes(draw([".###"] + ["####"] * 3, BOOK_BEHIND))
    assert search_actions(bank, level_pose(0, heading=0)) == [LOOK_DOWN] + [ROTATE_RIGHT] * 4 + [DONE]


def test_frontier_explores_a_second_room():
    # The wall hides all of the second room but what is seen through the door, and the book lies at its far end.
    rows = [".....", ".....", ".....", "##.##", ".....", ".....", "....."]
    wall_cells = [(3, 0), (3, 1), (3, 3), (3, 4)]
    bank = compile_scenes(draw(rows, ("Book", 0.0, 0.3, 1.5, 0.1, 0.1, 0.1), walls=wall_cells))
    for start_pose in (level_pose(0, 0), level_pose(4, 4), level_pose(12, 2)):
        actions = search_actions(bank, start_pose)
        assert actions[-1] == DONE
        assert MOVE_AHEAD in actions
    result, _ = search_episodes(bank)
    assert np.asarray(result.success).all()


@pytest.mark.parametrize("rules", [ROOMS, APARTMENTS, HOUSES], ids=["rooms", "apartments", "houses"])
def test_frontier_reaches_every_goal_of_an_open_room(rules):
    objects = (
        ("Book", -0.25, 0.5, 0.5, *SMALL),
        ("Chair", 1.0, 0.45, 2.25, 0.5, 0.9, 0.5),
        ("Fridge", 2.25, 0.9, 0.0, 0.7, 1.8, 0.7),
    )
    bank = compile_scenes(draw(["........"] * 8, *objects), rules=rules)
    result, episodes = search_episodes(bank, 90)
    assert set(episodes.goal.tolist()) == {0, 1, 2}
    assert np.asarray(result.success).all()
    assert (np.asarray(result.length) >= episodes.best_length).all()
    assert (np.asarray(result.moves) < np.asarray(result.length)).all()


def test_frontier_without_detections_ends_at_the_step_limit():
    bank = compile_scenes(maze_scene(3), coarse_scene(1), detector=BLIND)
    result, episodes = search_episodes(bank, 20, step_limit=60)
    assert not np.asarray(result.success).any()
    assert (np.asarray(result.length) == 60).all()
    assert episodes.best_length.max() < 60


def test_frontier_ignores_a_single_false_alarm():
    bank = compile_scenes(draw(["....."] * 5, ("Chair", 1.0, 0.45, 1.5, 0.5, 0.9, 0.5)))
    start_pose = level_pose(12, heading=0)

    # The false alarm is a book 1 m ahead, in this pose alone.
    false_alarm = (120, 51, 128, 153)
    rows = bank.rows.copy()
    row_format = RowFormat(len(CATEGORIES))
    row_format.detections(rows[start_pose])[BOOK] = false_alarm
    assert (row_format.detections(rows)[:, BOOK, 0] > 0).sum() == 1
    assert DONE not in search_actions(bank._replace(rows=rows), start_pose)

    # A second detection from the next pose, the same place looking down, is believed.
    row_format.detections(rows[start_pose + 1])[BOOK] = false_alarm
    assert search_actions(bank._replace(rows=rows), start_pose) == [LOOK_DOWN, DONE]


def test_frontier_success_counts_at_the_step_limit():
    bank = compile_scenes(draw([".###"] + ["####"] * 3, BOOK_BEHIND))
    episodes = draw_episodes(bank, 1)._replace(pose=np.array([level_pose(0, 0)], np.int32))
    for step_limit, has_success in [(6, True), (5, False)]:
        result = run_frontier_search(bank, episodes, np.array([step_limit]))
        assert (bool(result.success[0]), int(result.length[0])) == (has_success, step_limit)


@pytest.mark.slow
@settings(max_examples=20)
@given(seed=st.integers(0, 7), start_pose=st.integers(0, 10_000), goal=st.sampled_from([BOOK, CHAIR]))
def test_frontier_walk_depends_on_perception_alone(seed, start_pose, goal):
    scene = maze_scene(seed)
    noisy_detector = Detector(miss_near=0.05, miss_far=0.4, false_alarm=0.05)
    bank_alone = compile_scenes(scene, detector=noisy_detector)
    bank_of_two = compile_scenes(coarse_scene(seed), scene, detector=noisy_detector)
    assert bank_of_two.names[-1] == scene.name
    start_pose %= len(bank_alone.rows)
    expected_actions = search_actions(bank_alone, start_pose, goal)

    # The walk does not depend on other scenes in the bank, nor on the scene's place in it.
    assert (
        search_actions(bank_of_two, start_pose + len(bank_of_two.rows) - len(bank_alone.rows), goal) == expected_actions
    )

    # The walk uses nothing of the truth: no lengths, no distances, no detections of other categories.
    rows = bank_alone.rows.copy()
    is_goal = np.arange(len(CATEGORIES)) == goal
    RowFormat(len(CATEGORIES)).detections(rows)[:, ~is_goal] = 0
    bank_without_truth = bank_alone._replace(
        rows=rows,
        best_length=0 * bank_alone.best_length,
        goal_distance=0 * bank_alone.goal_distance,
        ahead=0 * bank_alone.ahead,
    )
    blind_walk = frontier_walk(bank_without_truth, bank_alone.successor, start_pose, goal, 100)
    assert [action for _, action in blind_walk] == expected_actions


@pytest.mark.slow
@settings(max_examples=20)
@given(seed=st.integers(0, 20), rules=st.sampled_from([ROOMS, APARTMENTS, HOUSES]))
def test_frontier_never_moves_into_an_obstacle(seed, rules):
    scene = maze_scene(seed)
    bank = compile_scenes(dataclasses.replace(scene, types=("Book",) * len(scene.types)), rules=rules, detector=BLIND)
    steps = np.array(list(frontier_walk(bank, bank.successor, 0, CHAIR, 150)))
    cells = steps[:, 0] // rules.poses_per_cell
    has_moved = cells[1:] != cells[:-1]
    np.testing.assert_array_equal(has_moved, steps[:-1, 1] == MOVE_AHEAD)
