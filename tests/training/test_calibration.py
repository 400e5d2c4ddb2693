"""Priors by room type, and the choice of strength and reduction against a plain loop over a few walks."""

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
K, WALKS = len(tiny.CATEGORIES), 8
KEY = jax.random.key(5)
STRENGTHS = (2.0, 6.0, 30.0)
PAIRS = list(itertools.product(("mean_visible", "sum"), STRENGTHS))
SETTING = EstimatorConfig(strength=3.0, form="paper")  # the strength is chosen anew, the form kept


@pytest.fixture(scope="module")
def counts():
    """Some counts of every room type."""
    drawn = np.random.default_rng(0).integers(0, 30, (NUM_PRIORS, K, K))
    return jnp.asarray(drawn + drawn.transpose(0, 2, 1), jnp.float32)


# Priors


def test_a_room_type_without_scenes_gets_what_all_scenes_together_say():
    counts = np.zeros((3, K, K), np.float32)
    counts[0, 0, 1] = counts[0, 1, 0] = 8
    counts[2, 1, 2] = counts[2, 2, 1] = 3
    priors = layout_priors(jnp.asarray(counts), EstimatorConfig(strength=None, uniform=0.0))
    # One sighting of every pair to start with; nothing on the diagonal.
    np.testing.assert_array_equal(priors[0], [[0, 9, 1], [9, 0, 1], [1, 1, 0]])
    np.testing.assert_array_equal(priors[2], [[0, 1, 1], [1, 0, 4], [1, 4, 0]])
    np.testing.assert_array_equal(priors[1], [[0, 9, 1], [9, 0, 4], [1, 4, 0]])


def test_the_prior_has_the_strength_of_the_setting(counts):
    priors = layout_priors(counts, EstimatorConfig(strength=7.0))
    assert priors.shape == (NUM_PRIORS, K, K)
    np.testing.assert_allclose(priors.sum(axis=-1), 7.0, rtol=1e-5)
    kitchen = ROOM_TYPES.index("kitchen")
    np.testing.assert_array_equal(
        priors[kitchen], prior_from_counts(counts[kitchen] + 1, EstimatorConfig(strength=7.0))
    )


# The choice


def walks():
    """The random walks of the module, as poses [WALKS, 21], and the room of each."""
    keys = jax.random.split(jax.random.fold_in(KEY, 0), WALKS)
    state = jax.vmap(ENV.reset, (0, None))(keys, PARAMS)[1]
    poses = [np.asarray(state.pose)]
    for actions in np.asarray(jax.random.randint(jax.random.fold_in(KEY, 1), (LATE_STEP, WALKS), 0, DONE)):
        poses.append(tiny.BANK.successor[poses[-1], actions])
    return np.stack(poses, axis=1), np.asarray(PARAMS.room)[np.asarray(state.scene)]


def gap_run(presence, prior, reduction):
    """Equations 3 to 5 by hand along one walk: gaps [T + 1] and the steps at which something was taken in."""
    alpha, last, gap = np.array(prior, np.float64), np.zeros(K, bool), 0.0
    gaps, weights = [], []
    for step, seen in enumerate(presence):
        if seen.sum() < 2 or (seen == last).all():
            gap *= 0.8
        else:
            added = np.outer(seen, seen) * (1.0 - np.eye(K))
            off = ~np.eye(K, dtype=bool)
            rows = [exact_kl(alpha[i][off[i]], added[i][off[i]]) for i in np.flatnonzero(seen)]
            gap = np.tanh(np.mean(rows) if reduction == "mean_visible" else np.sum(rows))
            alpha, last = alpha + added, seen
            weights.append(step)
        gaps.append(gap)
    return np.array(gaps), weights


@pytest.fixture(scope="module")
def by_hand(counts):
    """Medians (early, late) of every pair (reduction, strength)."""
    poses, rooms = walks()
    presence = np.asarray(ENV.row_format.presence(tiny.BANK.rows))[poses]
    result = {}
    for reduction, strength in PAIRS:
        priors = np.asarray(layout_priors(counts, EstimatorConfig(strength=strength)))
        early, late = [], []
        for seen, room in zip(presence, rooms, strict=True):
            gaps, weights = gap_run(seen, priors[room], reduction)
            late.append(gaps[-1])
            if weights:  # a walk that takes nothing in has no early gap
                early.append(gaps[weights[:NUM_EARLY_VIEWS]].mean())
        result[reduction, strength] = np.median(early), np.median(late)
    return result


def choose(counts, strengths=STRENGTHS, reductions=("mean_visible", "sum"), key=KEY):
    return calibrate(ENV, PARAMS, counts, SETTING, key, strengths, reductions, WALKS)


@pytest.mark.slow
def test_early_and_late_gap_are_those_of_a_plain_loop(counts, by_hand):
    assert len({round(early, 3) for early, _ in by_hand.values()}) == len(PAIRS)
    result = choose(counts, (6.0,), ("sum",))  # a single pair is not left out, however far
    assert result.estimator_config == dataclasses.replace(SETTING, strength=6.0, reduction="sum")
    assert (result.early, result.late) == pytest.approx(by_hand["sum", 6.0], abs=2e-3)


@pytest.mark.slow
def test_the_pair_nearest_to_the_papers_course_is_chosen(counts, by_hand):
    distance = {}
    for pair, (early, late) in by_hand.items():
        distance[pair] = abs(early - EARLY_GAP_TARGET) + abs(late - LATE_GAP_TARGET)
    best, second = sorted(distance, key=lambda pair: distance[pair])[:2]
    assert distance[second] - distance[best] > 5e-3  # no matter of rounding
    result = choose(counts)
    assert (result.estimator_config.reduction, result.estimator_config.strength) == best
    assert (result.early, result.late) == pytest.approx(by_hand[best], abs=2e-3)
    # Without it, the next; the order in which they are given is of no effect.
    strengths = [strength for strength in STRENGTHS if strength != best[1]]
    nearest = min((pair for pair in PAIRS if pair[1] in strengths), key=lambda pair: distance[pair])
    result = choose(counts, strengths[::-1], ("sum", "mean_visible"))
    assert (result.estimator_config.reduction, result.estimator_config.strength) == nearest


def test_where_nothing_is_seen_together_there_is_nothing_to_choose_by(counts):
    blind = PARAMS.replace(tables=PARAMS.tables.replace(rows=jnp.zeros_like(PARAMS.tables.rows)))
    with pytest.raises(InputError, match="no random walk shows two categories together"):
        calibrate(ENV, blind, counts, SETTING, KEY, (6.0,), ("sum",), WALKS)
