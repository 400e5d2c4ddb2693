"""Layout model of the planner: closed forms, fits to made-up layouts, and robustness to noise."""

import numpy as np
import pytest
from support.scenes import BOOK, CHAIR, SMALL, draw
from support.sites import find_perfect_sites

from jaxnav.baselines.layout_model import (
    PlannerSnapshot,
    detection_counts,
    estimate_detection_rates,
    fit_layout_model,
    uniform_layout_model,
)
from jaxnav.baselines.sites import NUM_DISTANCE_BINS, Sites

GOAL = 0
CLUE = 1
RATES = np.full((2, 1), 0.5, np.float32)


def make_snapshot(goal_site, clue_sites, num_looks=(0, 0), standable=(0, 0)):
    """Snapshot of S sites with the goal at one of them, after detections of the clue at others.

    Args:
      goal_site: index of the goal's site.
      clue_sites: indices of the sites where the clue was detected.
      num_looks: looks at each site so far [S].
      standable: standable share of each site [S].
    """
    num_sites = len(num_looks)
    object_sites = np.zeros((2, num_sites), bool)
    object_sites[GOAL, goal_site] = True
    features = np.zeros((2, 3, num_sites), bool)
    features[CLUE, 0, list(clue_sites)] = True
    surroundings = np.zeros((3, num_sites), np.float32)
    surroundings[0] = standable
    relations = np.zeros((3, num_sites, num_sites), bool)
    sites = Sites(None, np.zeros((0, 2)), object_sites, relations, surroundings)  # pyright: ignore[reportArgumentType]
    return PlannerSnapshot(sites, features, np.array([num_looks], np.uint16), np.zeros(2, bool))


def snapshots_with_goal(is_second_site, clue_sites, num_snapshots=56, **options):
    """Snapshots in which the goal is at the second site wherever a function of their index is true."""
    return [make_snapshot(int(is_second_site(i)), clue_sites, **options) for i in range(num_snapshots)]


def every_fourth(index):
    return index % 4 == 0


def score_difference(model, snapshot):
    """Goal score of the first site minus that of the second."""
    scores = model.scores(GOAL, snapshot.features, snapshot.sites)
    return float(scores[0] - scores[1])


def test_detection_rates_shrink_towards_the_mean_as_worked_out():
    # Three of four looks hit in one way, none of none in the other. The means are 3.5 / 5 and 0.5 / 1; each counts for
    # two looks: (3 + 1.4) / 6 and (0 + 1) / 2.
    look_counts = np.array([[[4, 0]], [[3, 0]]])
    np.testing.assert_allclose(estimate_detection_rates(look_counts), [[4.4 / 6, 0.5]], rtol=1e-6)


def test_detection_counts_of_a_single_cell():
    # The book 1 m ahead is in view at the headings 315, 0 and 45 degrees, at both horizons, and detected.
    sites = find_perfect_sites(draw([".###"] + ["####"] * 7, ("Book", 0.0, 0.8, 1.0, *SMALL)))
    num_looks, num_hits = detection_counts(sites)
    assert num_looks[BOOK].reshape(2, NUM_DISTANCE_BINS).sum(axis=1).tolist() == [3, 3]
    np.testing.assert_array_equal(num_looks, num_hits)
    assert not num_looks[CHAIR].any()


def test_layout_model_fits_the_log_odds_of_a_clue():
    # The goal is where the clue is in three of four scenes: log 3 more for that site.
    snapshots = snapshots_with_goal(every_fourth, [0])
    assert score_difference(fit_layout_model(snapshots, RATES), snapshots[0]) == pytest.approx(np.log(3), abs=0.05)


def test_layout_model_corrects_for_looks_without_a_detection():
    # The searcher has looked at the clue's site twice, at a rate of 1/2: the goal is then there in 3/4 : 1/4 x 4.
    snapshots = snapshots_with_goal(lambda index: index % 7 >= 3, [0], num_looks=(2, 0))
    assert score_difference(fit_layout_model(snapshots, RATES), snapshots[0]) == pytest.approx(np.log(3), abs=0.05)


def test_layout_model_without_relations_uses_surroundings_alone():
    # A clue has no effect.
    snapshots = snapshots_with_goal(every_fourth, [0])
    model = fit_layout_model(snapshots, RATES, use_relations=False)
    assert score_difference(model, snapshots[0]) == 0.0

    # Surroundings have one, equal for all categories.
    floor_snapshots = snapshots_with_goal(every_fourth, [], standable=(0, 1))
    model = fit_layout_model(floor_snapshots, RATES, use_relations=False)
    assert score_difference(model, floor_snapshots[0]) == pytest.approx(np.log(3), abs=0.05)
    np.testing.assert_array_equal(model.surrounding_weights[GOAL], model.surrounding_weights[CLUE])


def test_layout_model_ignores_an_uninformative_clue():
    generator = np.random.default_rng(0)
    snapshots = []
    for _ in range(400):
        goal_site, clue_site = generator.integers(2, size=2)
        snapshots.append(make_snapshot(goal_site, [clue_site]))
    model = fit_layout_model(snapshots, RATES)
    assert abs(score_difference(model, make_snapshot(0, [0]))) < 0.3  # the standard error is 0.1


def test_layout_model_ignores_padding_sites():
    small_scenes = snapshots_with_goal(every_fourth, [0])
    large_scene = make_snapshot(4, [], num_looks=(0,) * 5, standable=(0,) * 5)
    # The large scene has no clue: it adds nothing to the weight of the clue.
    model = fit_layout_model([*small_scenes, large_scene], RATES)
    assert score_difference(model, small_scenes[0]) == pytest.approx(np.log(3), abs=0.05)


def test_uniform_layout_model_scores_all_sites_equally():
    snapshot = make_snapshot(0, [0], standable=(0, 1))
    assert score_difference(uniform_layout_model(2), snapshot) == 0.0
