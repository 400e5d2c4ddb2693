"""Layout priors by room type; the choice of strength and reduction agrees with a plain loop over a few walks."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.numerics import exact_kl

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.layout import EstimatorConfig, prior_from_counts
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import (
    EARLY_GAP_TARGET,
    LATE_GAP_TARGET,
    LATE_STEP,
    NUM_EARLY_VIEWS,
    calibrate,
    layout_priors,
)

ENV, PARAMS = tiny.world()
NUM_CATEGORIES = len(tiny.CATEGORIES)
NUM_WALKS = 8
KEY = jax.random.key(5)
STRENGTHS = (2.0, 6.0, 30.0)
#: Candidates (reduction, strength) of the calibration.
CANDIDATES = list(itertools.product(("mean_visible", "sum"), STRENGTHS))
#: The calibration replaces the strength and keeps the form.
ESTIMATOR_CONFIG = EstimatorConfig(strength=3.0, form="paper")


@pytest.fixture(scope="module")
def counts():
    """Random symmetric counts of every room type [NUM_PRIORS, K, K]."""
    random_counts = np.random.default_rng(0).integers(0, 30, (NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES))
    return jnp.asarray(random_counts + random_counts.transpose(0, 2, 1), jnp.float32)


# Priors


def test_a_room_type_without_scenes_gets_the_prior_of_all_scenes():
    counts = np.zeros((3, NUM_CATEGORIES, NUM_CATEGORIES), np.float32)
    counts[0, 0, 1] = counts[0, 1, 0] = 8
    counts[2, 1, 2] = counts[2, 2, 1] = 3
    priors = layout_priors(jnp.asarray(counts), EstimatorConfig(strength=None, uniform=0.0))
    # Every pair starts with one sighting, and the diagonal is zero.
    np.testing.assert_array_equal(priors[0], [[0, 9, 1], [9, 0, 1], [1, 1, 0]])
    np.testing.assert_array_equal(priors[2], [[0, 1, 1], [1, 0, 4], [1, 4, 0]])
    # Room type 1 has no scenes, and gets the counts of types 0 and 2.
    np.testing.assert_array_equal(priors[1], [[0, 9, 1], [9, 0, 4], [1, 4, 0]])


def test_the_prior_has_the_configured_strength(counts):
    priors = layout_priors(counts, EstimatorConfig(strength=7.0))
    assert priors.shape == (NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES)
    np.testing.assert_allclose(priors.sum(axis=-1), 7.0, rtol=1e-5)
    kitchen = ROOM_TYPES.index("kitchen")
    expected_prior = prior_from_counts(counts[kitchen] + 1, EstimatorConfig(strength=7.0))
    np.testing.assert_array_equal(priors[kitchen], expected_prior)


# Choice of strength and reduction


def random_walks():
    """The random walks of `calibrate`, as poses [NUM_WALKS, 21], and the room type of each walk."""
    reset_keys = jax.random.split(jax.random.fold_in(KEY, 0), NUM_WALKS)
    state = jax.vmap(ENV.reset, (0, None))(reset_keys, PARAMS)[1]
    poses = [np.asarray(state.pose)]
    for actions in np.asarray(jax.random.randint(jax.random.fold_in(KEY, 1), (LATE_STEP, NUM_WALKS), 0, DONE)):
        poses.append(tiny.BANK.successor[poses[-1], actions])
    return np.stack(poses, axis=1), np.asarray(PARAMS.room)[np.asarray(state.scene)]


def trace_gaps(presence, prior, reduction):
    """Equations 3 to 5 by hand along one walk: gaps [T + 1], and the steps whose view updates the belief."""
    alpha = np.array(prior, np.float64)
    last_visible = np.zeros(NUM_CATEGORIES, bool)
    gap = 0.0
    gaps = []
    update_steps = []
    off_diagonal = ~np.eye(NUM_CATEGORIES, dtype=bool)
    for step, visible in enumerate(presence):
        # The gap decays after a view of fewer than two categories, or of the categories of the last update.
        if visible.sum() < 2 or (visible == last_visible).all():
            gap *= 0.8
        else:
            # The gap reduces the divergences of the rows of visible categories; the view then updates the belief.
            view_counts = np.outer(visible, visible) * (1.0 - np.eye(NUM_CATEGORIES))
            divergences = []
            for i in np.flatnonzero(visible):
                divergences.append(exact_kl(alpha[i][off_diagonal[i]], view_counts[i][off_diagonal[i]]))
            reduce = np.mean if reduction == "mean_visible" else np.sum
            gap = np.tanh(reduce(divergences))
            alpha = alpha + view_counts
            last_visible = visible
            update_steps.append(step)
        gaps.append(gap)
    return np.array(gaps), update_steps


@pytest.fixture(scope="module")
def expected_gaps(counts):
    """Median gaps (early, late) of every candidate (reduction, strength), by the plain loop."""
    poses, rooms = random_walks()
    presence_by_walk = np.asarray(ENV.row_format.presence(tiny.BANK.rows))[poses]
    result = {}
    for reduction, strength in CANDIDATES:
        priors = np.asarray(layout_priors(counts, EstimatorConfig(strength=strength)))
        early_gaps = []
        late_gaps = []
        for presence, room in zip(presence_by_walk, rooms, strict=True):
            gaps, update_steps = trace_gaps(presence, priors[room], reduction)
            late_gaps.append(gaps[-1])
            if update_steps:  # a walk without an update has no early gap
                early_gaps.append(gaps[update_steps[:NUM_EARLY_VIEWS]].mean())
        result[reduction, strength] = np.median(early_gaps), np.median(late_gaps)
    return result


def calibrate_estimator(counts, strengths=STRENGTHS, reductions=("mean_visible", "sum"), key=KEY):
    return calibrate(ENV, PARAMS, counts, ESTIMATOR_CONFIG, key, strengths, reductions, NUM_WALKS)


@pytest.mark.slow
def test_early_and_late_gap_equal_those_of_a_plain_loop(counts, expected_gaps):
    assert len({round(early_gap, 3) for early_gap, _ in expected_gaps.values()}) == len(CANDIDATES)
    # A single candidate is chosen, however far its gaps are from their targets.
    result = calibrate_estimator(counts, (6.0,), ("sum",))
    assert result.estimator_config == dataclasses.replace(ESTIMATOR_CONFIG, strength=6.0, reduction="sum")
    assert (result.early, result.late) == pytest.approx(expected_gaps["sum", 6.0], abs=2e-3)


@pytest.mark.slow
def test_the_candidate_nearest_to_the_papers_gaps_is_chosen(counts, expected_gaps):
    distances = {}
    for candidate, (early_gap, late_gap) in expected_gaps.items():
        distances[candidate] = abs(early_gap - EARLY_GAP_TARGET) + abs(late_gap - LATE_GAP_TARGET)
    best_candidate, second_candidate = sorted(distances, key=lambda candidate: distances[candidate])[:2]
    assert distances[second_candidate] - distances[best_candidate] > 5e-3  # more than rounding

    # The calibration chooses the nearest candidate.
    result = calibrate_estimator(counts)
    assert (result.estimator_config.reduction, result.estimator_config.strength) == best_candidate
    assert (result.early, result.late) == pytest.approx(expected_gaps[best_candidate], abs=2e-3)

    # Without its strength, the nearest of the remaining candidates is chosen, whatever the order of the arguments.
    strengths = [strength for strength in STRENGTHS if strength != best_candidate[1]]
    remaining_candidates = [candidate for candidate in CANDIDATES if candidate[1] in strengths]
    nearest_candidate = min(remaining_candidates, key=lambda candidate: distances[candidate])
    result = calibrate_estimator(counts, strengths[::-1], ("sum", "mean_visible"))
    assert (result.estimator_config.reduction, result.estimator_config.strength) == nearest_candidate


def test_calibration_needs_walks_that_show_two_categories_together(counts):
    blind_params = PARAMS.replace(tables=PARAMS.tables.replace(rows=jnp.zeros_like(PARAMS.tables.rows)))
    with pytest.raises(InputError, match="no random walk shows two categories together"):
        calibrate(ENV, blind_params, counts, ESTIMATOR_CONFIG, KEY, (6.0,), ("sum",), NUM_WALKS)
