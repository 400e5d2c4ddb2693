"""The planner: worked searches, that it knows nothing it has not seen, and that a true prior leads it sooner."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.scenes import APARTMENTS, BOOK, CATEGORIES, CHAIR, FRIDGE, ROOMS, SMALL, coarse_scene, draw, maze_scene

from jaxnav.baselines.layout_model import detection_counts, detection_rates, uniform_layout_model
from jaxnav.baselines.planner import PlannerScene, search_for_goal, shortest_paths
from jaxnav.baselines.sites import find_sites
from jaxnav.scenes.lattice import best_lengths, pose_successors
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task

FLAT = uniform_layout_model(len(CATEGORIES))
#: An alley with a chamber at either end; a wall hides most of each from the alley.
ALLEY = ["...##########...", "................", "...##########..."]
WALLS = [(z, x) for z in (0, 2) for x in range(3, 13)]
CLUES = (("Fridge", 0.25, 0.9, 0.5, 0.2, 0.2, 0.2), ("Chair", 3.5, 0.5, 0.5, 0.2, 0.2, 0.2))


def home_of(scene, rules=ROOMS):
    task = Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR)
    table = compile_scene(scene, task)
    return PlannerScene(find_sites(scene, task, table.rows), pose_successors(table.ahead, rules), table.best_length)


def searched(home, pose, goal=BOOK, model=FLAT, limit=200):
    return search_for_goal(home, detection_rates(detection_counts(home.sites)), model, goal, pose, limit)


def test_it_walks_the_shortest_way_to_what_it_sees():
    home = home_of(draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL)))
    search = searched(home, pose=0)
    assert (search.length, search.success) == (home.best_length[0, BOOK], True)
    assert search.snapshots == []  # detected before it had to choose


def test_it_turns_round():
    # One cell, the book 1 m behind: in view from 135 degrees on, after three turns to either side; then Done.
    search = searched(home_of(draw([".###"] + ["####"] * 3, ("Book", 0.0, 0.8, -1.0, *SMALL))), pose=0)
    assert (search.length, search.success) == (4, True)


def test_it_ends_at_the_limit():
    # The book is behind a wall for good.
    scene = draw(["....", "####", "####"], ("Book", 0.25, 0.8, 0.5, *SMALL), walls=[(1, x) for x in range(4)])
    search = searched(home_of(scene), pose=0, limit=30)
    assert (search.length, search.success) == (30, False)
    assert len(search.snapshots) == 5  # after 0, 1, 3, 7 and 15 actions


def test_it_gives_up_where_all_poses_are_taken():
    search = searched(home_of(draw([".###"] + ["####"] * 3, ("Chair", 0.5, 0.8, 0.5, *SMALL))), pose=0)
    assert (search.length, search.success) == (200, False)


def test_a_belief_leads_to_the_clue_it_trusts():
    # From the middle of the alley the fridge is seen to the left, the chair to the right, and the book lies in the
    # fridge's chamber. Who believes books to be near fridges finds it sooner than who believes them near chairs.
    home = home_of(draw(ALLEY, *CLUES, ("Book", 0.0, 0.8, -0.2, 0.1, 0.1, 0.1), walls=WALLS))
    middle = 10  # of the second row, after the six cells of the first one
    trusting = {}
    for clue in (FRIDGE, CHAIR):
        relation = np.zeros_like(FLAT.relation_weights)
        relation[BOOK, clue] = 4.0
        trusting[clue] = [
            searched(home, (middle + 3) * 16 + 2 * heading, model=FLAT._replace(relation_weights=relation)).length
            for heading in range(8)
        ]
    assert np.mean(trusting[FRIDGE]) + 4 < np.mean(trusting[CHAIR])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_it_knows_nothing_that_it_has_not_seen(seed, rules):
    # Neither where the objects stand, nor the way to success before the goal is detected.
    home = home_of(maze_scene(seed), rules)
    sites = home.sites
    rates = detection_rates(detection_counts(sites))
    hidden = np.where(sites.detected_site >= 0, home.best_length, 7)
    blind = home._replace(sites=sites._replace(object_sites=~sites.object_sites), best_length=hidden)
    for goal in range(len(CATEGORIES)):
        a, b = (search_for_goal(one, rates, FLAT, goal, 0, 40) for one in (home, blind))
        assert (a.length, a.success) == (b.length, b.success)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999))
def test_a_glimpse_holds_every_look_once(seed):
    home = home_of(maze_scene(seed))
    search = searched(home, pose=0, goal=FRIDGE, limit=40)
    for before, after in zip(search.snapshots, search.snapshots[1:], strict=False):
        assert (before.look_counts <= after.look_counts).all()
        assert (before.features <= after.features).all()
    if search.snapshots:
        site, look = home.sites.views.from_pose(0)
        assert search.snapshots[0].look_counts.sum() == len(site)
        assert search.snapshots[0].look_counts[look, site].all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_ways_are_as_long_as_the_table_says(seed, rules):
    # An independent reference: L* to a single pose counts Done as well.
    successor = home_of(coarse_scene(seed), rules).successor
    targets = np.random.default_rng(seed).integers(len(successor), size=5)
    lengths = best_lengths(successor, np.arange(len(successor))[:, None] == targets)
    ways, before = shortest_paths(successor, 0)
    np.testing.assert_array_equal(ways[targets] + 1, lengths[0])
    reached = np.flatnonzero(ways > 0)
    assert (successor[before[reached]] == reached[:, None]).any(axis=1).all()
    np.testing.assert_array_equal(ways[before[reached]], ways[reached] - 1)
