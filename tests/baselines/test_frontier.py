"""The searcher without prior: worked walks in drawn rooms, and that it knows nothing but what it perceives."""

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


def compiled(*scenes, rules=ROOMS, detector=PERFECT_DETECTOR):
    return compile_bank(scenes, Task(CATEGORIES, rules=rules, detector=detector))


def searched(bank, pose, goal=BOOK, limit=100):
    """The actions of the searcher."""
    return [action for _, action in frontier_walk(bank, bank.successor, pose, goal, limit)]


def pose(cell, heading, rules=ROOMS):
    return rules.join_pose(cell, heading, 0)


def outcome(bank, count=60, limit=200):
    episodes = draw_episodes(bank, count)
    return run_frontier_search(bank, episodes, np.full(len(bank.names), limit)), episodes


def test_it_walks_straight_to_what_it_sees():
    # A corridor along +z with a book at z = 3 m: detected at once. It looks down, the first action of every search, and
    # so detects it from a second pose; 1.5 m less the slack are left from z = 1.75 m, seven cells on.
    bank = compiled(draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL)))
    assert searched(bank, pose(0, heading=0)) == [LOOK_DOWN] + [MOVE_AHEAD] * 7 + [DONE]


def test_it_turns_until_it_has_seen_the_goal_twice():
    # One cell, the book 1 m behind. Right comes before left; at 135 degrees the book is 45 degrees aside, in the view
    # of 100 degrees, but seen once only; at 180 degrees it is seen again.
    bank = compiled(draw([".###"] + ["####"] * 3, BOOK_BEHIND))
    assert searched(bank, pose(0, heading=0)) == [LOOK_DOWN] + [ROTATE_RIGHT] * 4 + [DONE]


def test_it_explores_the_other_room():
    # The wall hides all of the second room but what is seen through the door, and the book lies at its far end.
    rows = [".....", ".....", ".....", "##.##", ".....", ".....", "....."]
    walls = [(3, 0), (3, 1), (3, 3), (3, 4)]
    bank = compiled(draw(rows, ("Book", 0.0, 0.3, 1.5, 0.1, 0.1, 0.1), walls=walls))
    for start in (pose(0, 0), pose(4, 4), pose(12, 2)):
        actions = searched(bank, start)
        assert actions[-1] == DONE
        assert MOVE_AHEAD in actions
    result, _ = outcome(bank)
    assert np.asarray(result.success).all()


@pytest.mark.parametrize("rules", [ROOMS, APARTMENTS, HOUSES], ids=["rooms", "apartments", "houses"])
def test_every_goal_in_an_open_room_is_found(rules):
    objects = (
        ("Book", -0.25, 0.5, 0.5, *SMALL),
        ("Chair", 1.0, 0.45, 2.25, 0.5, 0.9, 0.5),
        ("Fridge", 2.25, 0.9, 0.0, 0.7, 1.8, 0.7),
    )
    bank = compiled(draw(["........"] * 8, *objects), rules=rules)
    result, episodes = outcome(bank, 90)
    assert set(episodes.goal.tolist()) == {0, 1, 2}
    assert np.asarray(result.success).all()
    assert (np.asarray(result.length) >= episodes.best_length).all()
    assert (np.asarray(result.moves) < np.asarray(result.length)).all()


def test_a_blind_searcher_goes_on_to_the_step_limit():
    bank = compiled(maze_scene(3), coarse_scene(1), detector=BLIND)
    result, episodes = outcome(bank, 20, limit=60)
    assert not np.asarray(result.success).any()
    assert (np.asarray(result.length) == 60).all()
    assert episodes.best_length.max() < 60


def test_a_single_false_alarm_is_not_believed():
    bank = compiled(draw(["....."] * 5, ("Chair", 1.0, 0.45, 1.5, 0.5, 0.9, 0.5)))
    rows, row_format = bank.rows.copy(), RowFormat(len(CATEGORIES))
    start = pose(12, heading=0)
    row_format.detections(rows[start])[BOOK] = (120, 51, 128, 153)  # a book 1 m ahead, in this pose alone
    assert (row_format.detections(rows)[:, BOOK, 0] > 0).sum() == 1
    assert DONE not in searched(bank._replace(rows=rows), start)
    # Where the next pose (the same, looking down) agrees, it is.
    row_format.detections(rows[start + 1])[BOOK] = (120, 51, 128, 153)
    assert searched(bank._replace(rows=rows), start) == [LOOK_DOWN, DONE]


def test_done_at_the_step_limit_counts():
    bank = compiled(draw([".###"] + ["####"] * 3, BOOK_BEHIND))
    episodes = draw_episodes(bank, 1)._replace(pose=np.array([pose(0, 0)], np.int32))
    for limit, success in ((6, True), (5, False)):
        result = run_frontier_search(bank, episodes, np.array([limit]))
        assert (bool(result.success[0]), int(result.length[0])) == (success, limit)


@settings(max_examples=20)
@given(seed=st.integers(0, 7), start=st.integers(0, 10_000), goal=st.sampled_from([BOOK, CHAIR]))
def test_it_knows_only_what_it_perceives(seed, start, goal):
    scene = maze_scene(seed)
    noisy = Detector(miss_near=0.05, miss_far=0.4, false_alarm=0.05)
    alone, among = (compiled(*scenes, detector=noisy) for scenes in ((scene,), (coarse_scene(seed), scene)))
    assert among.names[-1] == scene.name
    start %= len(alone.rows)
    actions = searched(alone, start, goal)
    # Other scenes in the bank, and another place in it.
    assert searched(among, start + len(among.rows) - len(alone.rows), goal) == actions
    # Nothing of the truth: no lengths, no distances, no other categories' detections.
    rows, row_format = alone.rows.copy(), RowFormat(len(CATEGORIES))
    row_format.detections(rows)[:, [k for k in range(len(CATEGORIES)) if k != goal]] = 0
    stripped = alone._replace(
        rows=rows, best_length=0 * alone.best_length, goal_distance=0 * alone.goal_distance, ahead=0 * alone.ahead
    )
    assert [action for _, action in frontier_walk(stripped, alone.successor, start, goal, 100)] == actions


@settings(max_examples=20)
@given(seed=st.integers(0, 20), rules=st.sampled_from([ROOMS, APARTMENTS, HOUSES]))
def test_it_never_walks_in_vain(seed, rules):
    scene = maze_scene(seed)
    bank = compiled(dataclasses.replace(scene, types=("Book",) * len(scene.types)), rules=rules, detector=BLIND)
    steps = list(frontier_walk(bank, bank.successor, 0, CHAIR, 150))
    cells = [pose // rules.poses_per_cell for pose, _ in steps]
    assert all(
        (after != before) == (action == MOVE_AHEAD)
        for before, after, (_, action) in zip(cells[:-1], cells[1:], steps[:-1], strict=True)
    )
