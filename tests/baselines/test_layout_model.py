"""The fitted prior: closed forms, what it must find in made-up layouts, and what it must not."""

import numpy as np
import pytest
from support.scenes import BOOK, CATEGORIES, CHAIR, ROOMS, SMALL, draw

from jaxnav.baselines.layout_model import (
    SearchSnapshot,
    detection_counts,
    detection_rates,
    fit_layout_model,
    uniform_layout_model,
)
from jaxnav.baselines.sites import NUM_DISTANCE_BINS, Sites, find_sites
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task

GOAL, CLUE = 0, 1
RATES = np.full((2, 1), 0.5, np.float32)


def glimpse(goal_at, clue_at, num_looks=(0, 0), standable=(0, 0)):
    """What is known where the clue has been detected at some of the sites, and the goal is at one of them."""
    num_sites = len(num_looks)
    objects, features = np.zeros((2, num_sites), bool), np.zeros((2, 3, num_sites), bool)
    objects[GOAL, goal_at] = True
    features[CLUE, 0, list(clue_at)] = True
    surroundings = np.zeros((3, num_sites), np.float32)
    surroundings[0] = standable
    sites = Sites(None, np.zeros((0, 2)), objects, np.zeros((3, num_sites, num_sites), bool), surroundings)  # pyright: ignore[reportArgumentType]
    return SearchSnapshot(sites, features, np.array([num_looks], np.uint16), np.zeros(2, bool))


def contrast(model, one):
    """How much the score of the first site exceeds that of the second."""
    scores = model.scores(GOAL, one.features, one.sites)
    return float(scores[0] - scores[1])


def test_rates_of_worked_counts():
    # Three of four looks hit in one way, none of none in the other. The means are 3.5 / 5 and 0.5 / 1; each counts for
    # two looks: (3 + 1.4) / 6 and (0 + 1) / 2.
    counts = np.array([[[4, 0]], [[3, 0]]])
    np.testing.assert_allclose(detection_rates(counts), [[4.4 / 6, 0.5]], rtol=1e-6)


def test_counts_of_a_single_cell():
    # The book 1 m ahead is in view at the headings 315, 0 and 45 degrees, at both horizons, and detected.
    scene = draw([".###"] + ["####"] * 7, ("Book", 0.0, 0.8, 1.0, *SMALL))
    task = Task(CATEGORIES, rules=ROOMS, detector=PERFECT_DETECTOR)
    sites = find_sites(scene, task, compile_scene(scene, task).rows)
    num_looks, hits = detection_counts(sites)
    assert num_looks[BOOK].reshape(2, NUM_DISTANCE_BINS).sum(axis=1).tolist() == [3, 3]
    np.testing.assert_array_equal(num_looks, hits)
    assert not num_looks[CHAIR].any()


def test_the_clue_counts_for_its_log_odds():
    # The goal is where the clue is in three of four scenes: log 3 more for that site.
    informed = [glimpse(int(i % 4 == 0), clue_at=[0]) for i in range(56)]
    assert contrast(fit_layout_model(informed, RATES), informed[0]) == pytest.approx(np.log(3), abs=0.05)


def test_looks_in_vain_are_no_part_of_the_prior():
    # The searcher has looked at the clue's site twice, at a rate of 1/2: the goal is then there in 3/4 : 1/4 x 4.
    informed = [glimpse(int(i % 7 >= 3), clue_at=[0], num_looks=(2, 0)) for i in range(56)]
    assert contrast(fit_layout_model(informed, RATES), informed[0]) == pytest.approx(np.log(3), abs=0.05)


def test_without_relations_only_surroundings_count():
    informed = [glimpse(int(i % 4 == 0), clue_at=[0]) for i in range(56)]
    blind = fit_layout_model(informed, RATES, use_relations=False)
    assert contrast(blind, informed[0]) == 0.0
    standing = [glimpse(int(i % 4 == 0), clue_at=[], standable=(0, 1)) for i in range(56)]
    model = fit_layout_model(standing, RATES, use_relations=False)
    assert contrast(model, standing[0]) == pytest.approx(np.log(3), abs=0.05)
    np.testing.assert_array_equal(model.surrounding_weights[GOAL], model.surrounding_weights[CLUE])


def test_a_clue_that_says_nothing_is_not_believed():
    generator = np.random.default_rng(0)
    informed = [glimpse(int(generator.integers(2)), clue_at=[int(generator.integers(2))]) for _ in range(400)]
    assert abs(contrast(fit_layout_model(informed, RATES), glimpse(0, clue_at=[0]))) < 0.3  # the standard error is 0.1


def test_sites_that_fill_up_a_scene_do_not_count():
    small = [glimpse(int(i % 4 == 0), clue_at=[0]) for i in range(56)]
    large = [glimpse(4, clue_at=[4], num_looks=(0,) * 5, standable=(0,) * 5)]
    large[0].features[:] = False
    # The goal of the large scene is anywhere: it adds nothing to what the clue is worth.
    assert contrast(fit_layout_model(small + large, RATES), small[0]) == pytest.approx(np.log(3), abs=0.05)


def test_the_flat_model_scores_all_alike():
    one = glimpse(0, clue_at=[0], standable=(0, 1))
    assert contrast(uniform_layout_model(2), one) == 0.0
