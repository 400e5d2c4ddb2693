"""Planner: worked searches, independence of unseen objects, and the use of its layout model."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, FRIDGE, ROOMS, SMALL, coarse_scene, draw, maze_scene

from jaxnav.baselines.layout_model import detection_counts, estimate_detection_rates, uniform_layout_model
from jaxnav.baselines.planner import PlannerScene, search_for_goal, shortest_paths
from jaxnav.baselines.sites import find_sites
from jaxnav.scenes.lattice import best_lengths, pose_successors
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task

FLAT = uniform_layout_model(len(CATEGORIES))
#: An alley with a chamber at either end; a wall hides most of each from the alley.
ALLEY = ["...##########...", "................", "...##########..."]
WALLS = list(itertools.product((0, 2), range(3, 13)))
CLUES = (("Fridge", 0.25, 0.9, 0.5, 0.2, 0.2, 0.2), ("Chair", 3.5, 0.5, 0.5, 0.2, 0.2, 0.2))


def planner_scene(scene, rules=ROOMS):
    """Tables that the planner needs of a scene, with a detector that makes no errors."""
    task = Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR)
    table = compile_scene(scene, task)
    return PlannerScene(find_sites(scene, task, table.rows), pose_successors(table.ahead, rules), table.best_length)


def plan_search(planned_scene, start_pose, goal=BOOK, model=FLAT, step_limit=200):
    """Search of the planner from a pose, with detection rates counted in the scene itself."""
    return search_for_goal(
        planned_scene,
        estimate_detection_rates(detection_counts(planned_scene.sites)),
        model,
        goal,
        start_pose,
        step_limit,
    )


def test_planner_takes_the_shortest_path_to_a_visible_goal():
    planned_scene = planner_scene(draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL)))
    search = plan_search(planned_scene, start_pose=0)
    assert (search.length, search.success) == (planned_scene.best_length[0, BOOK], True)
    assert search.snapshots == []  # detected before it had to choose


def test_planner_turns_to_a_goal_behind_it():
    # One cell, the book 1 m behind: in view from 135 degrees on, after three turns to either side; then Done.
    search = plan_search(planner_scene(draw([".###"] + ["####"] * 3, ("Book", 0.0, 0.8, -1.0, *SMALL))), start_pose=0)
    assert (search.length, search.success) == (4, True)


def test_planner_ends_at_the_step_limit():
    # The book is behind a wall for good.
    scene = draw(["....", "####", "####"], ("Book", 0.25, 0.8, 0.5, *SMALL), walls=[(1, x) for x in range(4)])
    search = plan_search(planner_scene(scene), start_pose=0, step_limit=30)
    assert (search.length, search.success) == (30, False)
    assert len(search.snapshots) == 5  # after 0, 1, 3, 7 and 15 actions


def test_planner_gives_up_after_visiting_all_poses():
    search = plan_search(planner_scene(draw([".###"] + ["####"] * 3, ("Chair", 0.5, 0.8, 0.5, *SMALL))), start_pose=0)
    assert (search.length, search.success) == (200, False)


def test_planner_searches_near_the_clue_its_model_trusts():
    # From the middle of the alley the fridge is seen to the left, the chair to the right, and the book lies in the
    # fridge's chamber. A model with books near fridges finds it sooner than one with books near chairs.
    planned_scene = planner_scene(draw(ALLEY, *CLUES, ("Book", 0.0, 0.8, -0.2, 0.1, 0.1, 0.1), walls=WALLS))
    first_middle_cell = 10  # of the second row, after the six cells of the first one

    # Mean length over all headings, by the clue that the model trusts.
    mean_length = {}
    for clue in (FRIDGE, CHAIR):
        relation_weights = np.zeros_like(FLAT.relation_weights)
        relation_weights[BOOK, clue] = 4.0
        model = FLAT._replace(relation_weights=relation_weights)
        searches = [
            plan_search(planned_scene, (first_middle_cell + 3) * 16 + 2 * heading, model=model) for heading in range(8)
        ]
        mean_length[clue] = np.mean([search.length for search in searches])
    assert mean_length[FRIDGE] + 4 < mean_length[CHAIR]


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_planner_uses_nothing_it_has_not_detected(seed, rules):
    # Neither the places of objects nor, before a detection, the distance to success changes the search.
    planned_scene = planner_scene(maze_scene(seed), rules)
    sites = planned_scene.sites
    rates = estimate_detection_rates(detection_counts(sites))
    hidden_length = np.where(sites.detected_site >= 0, planned_scene.best_length, 7)
    altered = planned_scene._replace(sites=sites._replace(object_sites=~sites.object_sites), best_length=hidden_length)
    for goal in range(len(CATEGORIES)):
        search = search_for_goal(planned_scene, rates, FLAT, goal, 0, 40)
        altered_search = search_for_goal(altered, rates, FLAT, goal, 0, 40)
        assert (search.length, search.success) == (altered_search.length, altered_search.success)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_planner_is_never_faster_than_the_shortest_path(seed, rules):
    planned_scene = planner_scene(maze_scene(seed), rules)
    num_poses = len(planned_scene.successor)
    for start_pose in range(0, num_poses, -(-num_poses // 5)):
        for goal in range(len(CATEGORIES)):
            search = plan_search(planned_scene, start_pose, goal=goal, step_limit=100)
            if search.success:
                assert search.length >= planned_scene.best_length[start_pose, goal]


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999))
def test_planner_snapshots_count_every_look_once(seed):
    planned_scene = planner_scene(maze_scene(seed))
    search = plan_search(planned_scene, start_pose=0, goal=FRIDGE, step_limit=40)
    for before, after in zip(search.snapshots, search.snapshots[1:], strict=False):
        assert (before.look_counts <= after.look_counts).all()
        assert (before.features <= after.features).all()
    if search.snapshots:
        viewed_sites, look_kinds = planned_scene.sites.views.from_pose(0)
        assert search.snapshots[0].look_counts.sum() == len(viewed_sites)
        assert search.snapshots[0].look_counts[look_kinds, viewed_sites].all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_planner_shortest_paths_equal_the_compiled_lengths(seed, rules):
    # An independent reference: L* to a single pose counts Done as well.
    successor = planner_scene(coarse_scene(seed), rules).successor
    target_poses = np.random.default_rng(seed).integers(len(successor), size=5)
    lengths_to_targets = best_lengths(successor, np.arange(len(successor))[:, None] == target_poses)
    path_lengths, previous_pose = shortest_paths(successor, 0)
    np.testing.assert_array_equal(path_lengths[target_poses] + 1, lengths_to_targets[0])

    # Every pose has a predecessor that is one action nearer to the start.
    reached_poses = np.flatnonzero(path_lengths > 0)
    predecessors = previous_pose[reached_poses]
    assert (successor[predecessors] == reached_poses[:, None]).any(axis=1).all()
    np.testing.assert_array_equal(path_lengths[predecessors], path_lengths[reached_poses] - 1)
