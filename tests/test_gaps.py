"""Tests of the learned, surprise, overdue, held and clock gaps: worked arithmetic and properties of the estimator."""

import functools
import itertools

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from support.scenes import draw

from jaxnav.gaps import (
    NEAR_DISTANCES,
    NEAR_VIEW_COUNTS,
    NUM_NEAR_FEATURES,
    NUM_SIGHTING_RELATIONS,
    CooccurrenceEvidence,
    PairSightings,
    learned_gap,
    near_features,
    overdue_gap,
    seen_together,
    surprise_gap,
)
from jaxnav.layout import EstimatorConfig, LayoutEstimator, ViewGeometry, prior_from_counts
from jaxnav.policies.agent_loop import Perception
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, detected_positions
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Task

NUM_CATEGORIES = 5
VIEWS = hnp.arrays(np.bool_, (6, NUM_CATEGORIES))
GENERATOR = np.random.default_rng(0)
PRIOR = prior_from_counts(jnp.asarray(GENERATOR.integers(0, 50, (NUM_CATEGORIES, NUM_CATEGORIES))))
LOG_ODDS = GENERATOR.normal(size=(NUM_CATEGORIES, NUM_CATEGORIES))
CO_VISIBILITY = GENERATOR.random((NUM_CATEGORIES, NUM_CATEGORIES)) * (1 - np.eye(NUM_CATEGORIES))
EVIDENCE = CooccurrenceEvidence(
    log_odds=jnp.triu(jnp.asarray(LOG_ODDS, jnp.float32), 1),
    co_visibility=jnp.asarray(CO_VISIBILITY, jnp.float32),
)


@functools.partial(jax.jit, static_argnums=0)
def jitted_gaps(config, views):
    """Gap after each view [T], where the goal is category 0."""
    estimator = LayoutEstimator(PRIOR, config, EVIDENCE)

    def step(state, view):
        state = estimator.update(state, view, 0)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def gaps_along(views, **changes):
    return np.asarray(jitted_gaps(EstimatorConfig(**changes), jnp.asarray(views)))


def test_learned_gap_follows_worked_arithmetic():
    """With 0, 1 and 2 seen together, ln 3 + ln 2 - ln 1 = ln 6, so p = 6 / 7; with nothing seen, p = 1/2."""
    log_odds = jnp.zeros((4, 4)).at[0, 1].set(np.log(3)).at[0, 2].set(np.log(2)).at[2, 3].set(5.0)
    co_seen = seen_together(jnp.array([[1, 1, 1, 0]], bool))
    np.testing.assert_allclose(learned_gap(co_seen, log_odds), 6 / 7, rtol=1e-6)
    assert float(learned_gap(jnp.zeros((4, 4), bool), log_odds)) == 0.5


@pytest.mark.slow
def test_sightings_follow_worked_arithmetic():
    """Two categories are seen one after the other, and then together.

    There is one count per distance, and a last one of the views that show both categories.
    """
    assert (1.0, 2.0, 4.0, float("inf")) == NEAR_DISTANCES
    unused_offset = [0.0, 0.0]
    sightings = PairSightings.init(2)

    # The first view shows 0 at (3, 0) from the agent. Category 1 has no place yet.
    sightings = sightings.update(jnp.array([True, False]), jnp.array([[3.0, 0.0], unused_offset]), jnp.zeros(2))
    assert sightings.counts[:, 0, 1].tolist() == [0, 0, 0, 0, 0]

    # The agent moves by (1, 0), so 0 is now at (2, 0). The second view shows 1 at (2, 1.5), 1.5 m from 0: within 2 and
    # 4 m, not within 1 m.
    offsets = jnp.array([unused_offset, [2.0, 1.5]])
    sightings = sightings.update(jnp.array([False, True]), offsets, jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(sightings.offsets, [[2.0, 0.0], [2.0, 1.5]])
    assert sightings.counts[:, 0, 1].tolist() == [0, 1, 1, 1, 0]

    # The third view shows 1 again, 0.5 m from 0.
    sightings = sightings.update(jnp.array([False, True]), jnp.array([unused_offset, [2.5, 0.0]]), jnp.zeros(2))
    assert sightings.counts[:, 0, 1].tolist() == [1, 2, 2, 2, 0]

    # The fourth view shows both, 3 m from each other.
    sightings = sightings.update(jnp.ones(2, bool), jnp.array([[2.0, 0.0], [2.0, 3.0]]), jnp.zeros(2))
    assert sightings.counts[:, 0, 1].tolist() == [1, 2, 3, 3, 1]

    # A view without either category adds nothing, wherever the agent goes, and the counts are symmetric.
    next_sightings = sightings.update(jnp.zeros(2, bool), jnp.zeros((2, 2)), jnp.array([5.0, 5.0]))
    np.testing.assert_array_equal(next_sightings.counts, sightings.counts)
    np.testing.assert_array_equal(sightings.counts, jnp.swapaxes(sightings.counts, 1, 2))


def test_surprise_gap_follows_worked_arithmetic():
    """One view within 4 m reaches one feature of each of two distances: ln 3 + ln 2 - ln 1 = ln 6, p = 6 / 7."""
    assert NEAR_VIEW_COUNTS[:2] == (1, 3)
    # One view at the distances 2 (4 m) and 3 (any).
    counts = jnp.zeros((NUM_SIGHTING_RELATIONS, 2, 2), jnp.uint8).at[2:4, 0, 1].set(1)

    # Features of one view at these distances have log odds, and so has three views within 4 m, which is not reached.
    num_thresholds = len(NEAR_VIEW_COUNTS)
    log_odds = jnp.zeros((NUM_NEAR_FEATURES, 2, 2))
    log_odds = log_odds.at[2 * num_thresholds, 0, 1].set(np.log(3)).at[3 * num_thresholds, 0, 1].set(np.log(2))
    log_odds = log_odds.at[2 * num_thresholds + 1, 0, 1].set(5.0)
    np.testing.assert_allclose(surprise_gap(counts, log_odds), 6 / 7, rtol=1e-6)
    assert float(surprise_gap(jnp.zeros_like(counts), log_odds)) == 0.5


def test_near_features_grow_with_the_number_of_views():
    # A batch of 25 counts, of one distance and one pair.
    counts = jnp.arange(25, dtype=jnp.uint8)[:, None, None, None]
    features = near_features(counts)[:, :, 0, 0]
    num_reached = [np.sum(count >= np.array(NEAR_VIEW_COUNTS)) for count in range(25)]
    np.testing.assert_array_equal(features.sum(axis=1), num_reached)


@pytest.mark.slow
def test_surprise_needs_geometry_and_evidence():
    estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap="surprise"), EVIDENCE)
    view = jnp.ones(NUM_CATEGORIES, bool)
    with pytest.raises(ValueError, match="geometry"):
        estimator.update(estimator.init(), view)
    geometry = ViewGeometry(jnp.zeros((NUM_CATEGORIES, 2)), jnp.zeros(2))
    with pytest.raises(ValueError, match="near_log_odds"):
        estimator.update(estimator.init(), view, None, geometry)


@pytest.mark.slow
def test_offsets_and_odometry_give_the_places_of_the_detections():
    """Along a walk through a drawn room, agent plus offset is the place in the world by the NumPy formula."""
    # A room with two objects, and a detector without errors.
    scene = draw(["....."] * 5, ("Book", 0.5, 0.9, 1.5, 0.2, 0.2, 0.2), ("Fridge", 1.6, 1.0, 0.4, 0.4, 1.8, 0.4))
    task = Task(detector=PERFECT_DETECTOR)
    bank = compile_bank([scene], task)
    rules = task.rules
    centres = cell_centres(scene, standable_cells(scene.reach))
    perception = Perception(task.row_format, rules=rules)

    # The first three poses and 200 random ones.
    num_detections = 0
    for pose in [0, 1, 2, *GENERATOR.integers(0, len(bank.rows), 200).tolist()]:
        cell, heading, _ = rules.split_pose(pose)
        row = bank.rows[pose]
        geometry = perception.view_geometry(jnp.asarray(row), jnp.int32(heading), jnp.bool_(False))
        np.testing.assert_array_equal(geometry.motion, 0.0)

        # Offsets of the visible categories lead to the places of their detections.
        visible = np.flatnonzero(task.row_format.presence(row))
        detections = task.row_format.detections(row)[visible]
        expected = detected_positions(detections, centres[cell], rules.heading_directions()[heading])
        np.testing.assert_allclose(centres[cell] + np.asarray(geometry.offsets)[visible], expected, atol=1e-4)
        num_detections += len(visible)

        # A step ahead that nothing blocks leads to the neighbouring cell that the motion names.
        if bank.ahead[cell, heading] != cell:
            moved = perception.view_geometry(jnp.asarray(row), jnp.int32(heading), jnp.bool_(True)).motion
            np.testing.assert_allclose(centres[bank.ahead[cell, heading]] - centres[cell], moved, atol=1e-6)
    assert num_detections > 50


def test_overdue_gap_follows_worked_arithmetic():
    """The goal, 2, is visible next to 0 with probability 1/2 and next to 1 with 1/4.

    With both seen, the goal is missing with probability 1/2 * 3/4 = 3/8, so the gap is 5/8.
    """
    co_visibility = jnp.zeros((4, 4)).at[0, 2].set(0.5).at[1, 2].set(0.25).at[2, 0].set(0.9).at[3, 2].set(1.0)
    views = jnp.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], bool)
    gaps = [float(overdue_gap(seen_together(views[:num_views]), co_visibility, 2)) for num_views in range(4)]
    assert gaps == [0.0, 0.5, 0.625, 0.0]
    assert float(overdue_gap(seen_together(jnp.array([[0, 0, 0, 1]], bool)), co_visibility, 2)) == 1.0


@given(VIEWS)
def test_overdue_gap_rises_until_the_goal_is_seen(views):
    gaps = gaps_along(views, gap="overdue")
    goal_seen = np.maximum.accumulate(views[:, 0])
    assert (gaps[goal_seen] == 0).all()
    assert (np.diff(gaps[~goal_seen]) >= 0).all()
    assert ((gaps >= 0) & (gaps <= 1)).all()


@given(VIEWS)
def test_overdue_gap_is_the_probability_of_independent_sightings(views):
    """Each category seen shows the goal or not, independently: the mean over all 2^K outcomes, in float64."""
    # Goal visible next to each category [2^(K - 1), K - 1], and the probability of each outcome.
    seen_categories = views[:, 1:].any(axis=0)
    probabilities = np.asarray(EVIDENCE.co_visibility, np.float64)[1:, 0]
    outcomes = np.array(list(np.ndindex(*[2] * (NUM_CATEGORIES - 1))), bool)
    outcome_weights = np.where(outcomes, probabilities, 1 - probabilities).prod(axis=1)

    # The goal should have been seen in the outcomes where a category seen shows it, and was not.
    expected = outcome_weights[(outcomes & seen_categories).any(axis=1)].sum()
    views = views & (np.arange(NUM_CATEGORIES) > 0)
    np.testing.assert_allclose(gaps_along(views, gap="overdue")[-1], expected, atol=1e-6)


@given(VIEWS)
def test_learned_gap_sums_the_log_odds_of_pairs_seen_so_far(views):
    log_odds = np.asarray(EVIDENCE.log_odds, np.float64)
    seen_pairs = set()
    for view, gap in zip(views, gaps_along(views, gap="learned"), strict=True):
        seen_pairs.update(itertools.combinations(np.flatnonzero(view).tolist(), 2))
        total_log_odds = sum(log_odds[pair] for pair in seen_pairs)
        np.testing.assert_allclose(gap, 1 / (1 + np.exp(-total_log_odds)), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("gap", ["novelty", "evidence", "learned", "overdue", "clock", "none"])
@given(VIEWS)
def test_held_gap_is_the_running_maximum(gap, views):
    """Every gap can be held, including that of eq. 5, which decays by itself."""
    np.testing.assert_array_equal(
        gaps_along(views, gap=gap, hold=True), np.maximum.accumulate(gaps_along(views, gap=gap))
    )


def test_clock_follows_the_gate_of_estimators_without_one():
    # Two categories, these two again, none, another pair: the clock starts anew in the first and the last view.
    views = np.zeros((4, NUM_CATEGORIES), bool)
    views[:2, :2] = True
    views[3, 1:3] = True
    expected = [1.0, 0.8, 0.64, 1.0]
    for gate in (True, False):
        np.testing.assert_allclose(gaps_along(views, gap="clock", gate=gate), expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("gap", ["learned", "overdue"])
def test_learned_and_overdue_gaps_do_not_change_the_belief(gap):
    views = GENERATOR.random((4, NUM_CATEGORIES)) < 0.5

    def run_estimator(name):
        """State after all views of an estimator with a gap of this name."""
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=name), EVIDENCE)
        state = estimator.init()
        for view in views:
            state = estimator.update(state, jnp.asarray(view), 0)
        return state

    state = run_estimator(gap)
    novelty_state = run_estimator("novelty")
    np.testing.assert_array_equal(state.alpha, novelty_state.alpha)
    np.testing.assert_array_equal(state.last_visible, novelty_state.last_visible)
    assert novelty_state.co_seen is None


def test_missing_evidence_and_goal_are_named():
    for gap in ("learned", "overdue"):
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=gap))
        with pytest.raises(ValueError, match="needs `cooccurrence`"):
            estimator.update(estimator.init(), jnp.ones(NUM_CATEGORIES, bool), 0)
    estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap="overdue"), EVIDENCE)
    with pytest.raises(ValueError, match="needs the goal"):
        estimator.update(estimator.init(), jnp.ones(NUM_CATEGORIES, bool))
