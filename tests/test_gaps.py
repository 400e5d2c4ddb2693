"""Gaps that know, gaps that grow, and gaps that hold: by hand, and as properties of the estimator."""

import functools

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from jaxnav.gaps import CooccurrenceEvidence, learned_gap, overdue_gap, seen_together
from jaxnav.layout import EstimatorConfig, LayoutEstimator, prior_from_counts

NUM_CATEGORIES = 5
VIEWS = hnp.arrays(np.bool_, (6, NUM_CATEGORIES))
GENERATOR = np.random.default_rng(0)
PRIOR = prior_from_counts(jnp.asarray(GENERATOR.integers(0, 50, (NUM_CATEGORIES, NUM_CATEGORIES))))
EVIDENCE = CooccurrenceEvidence(
    log_odds=jnp.triu(jnp.asarray(GENERATOR.normal(size=(NUM_CATEGORIES, NUM_CATEGORIES)), jnp.float32), 1),
    co_visibility=jnp.asarray(
        GENERATOR.random((NUM_CATEGORIES, NUM_CATEGORIES)) * (1 - np.eye(NUM_CATEGORIES)), jnp.float32
    ),
)


@functools.partial(jax.jit, static_argnums=0)
def jitted_gaps(setting, views):
    """The gaps after each view [T], the goal being 0."""
    estimator = LayoutEstimator(PRIOR, setting, EVIDENCE)

    def step(state, view):
        state = estimator.update(state, view, 0)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def gaps_along(views, **changes):
    return np.asarray(jitted_gaps(EstimatorConfig(**changes), jnp.asarray(views)))


def test_learned_gap_follows_worked_arithmetic():
    """0, 1 and 2 seen together: ln 3 + ln 2 - ln 1 = ln 6, so p = 6 / 7; with nothing seen p = 1/2."""
    log_odds = jnp.zeros((4, 4)).at[0, 1].set(np.log(3)).at[0, 2].set(np.log(2)).at[2, 3].set(5.0)
    co_seen = seen_together(jnp.array([[1, 1, 1, 0]], bool))
    np.testing.assert_allclose(learned_gap(co_seen, log_odds), 6 / 7, rtol=1e-6)
    assert float(learned_gap(jnp.zeros((4, 4), bool), log_odds)) == 0.5


def test_overdue_gap_follows_worked_arithmetic():
    """The goal is 2. Beside 0 it is seen with 1/2, beside 1 with 1/4: missed with 3/8 where both were seen."""
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
    seen_categories = views[:, 1:].any(axis=0)
    probabilities = np.asarray(EVIDENCE.co_visibility, np.float64)[1:, 0]
    outcomes = np.array(list(np.ndindex(*[2] * (NUM_CATEGORIES - 1))), bool)
    outcome_weights = np.where(outcomes, probabilities, 1 - probabilities).prod(axis=1)
    expected = outcome_weights[(outcomes & seen_categories).any(axis=1)].sum()
    views = views & (np.arange(NUM_CATEGORIES) > 0)
    np.testing.assert_allclose(gaps_along(views, gap="overdue")[-1], expected, atol=1e-6)


@given(VIEWS)
def test_learned_gap_sums_the_log_odds_of_pairs_seen_so_far(views):
    log_odds = np.asarray(EVIDENCE.log_odds, np.float64)
    for time_index, gap in enumerate(gaps_along(views, gap="learned")):
        pairs = {
            (i, j)
            for view in views[: time_index + 1]
            for i in range(NUM_CATEGORIES)
            for j in range(i + 1, NUM_CATEGORIES)
            if view[i] and view[j]
        }
        np.testing.assert_allclose(gap, 1 / (1 + np.exp(-sum(log_odds[pair] for pair in pairs))), rtol=1e-5)


@pytest.mark.parametrize("gap", ["novelty", "evidence", "learned", "overdue", "clock", "none"])
@given(VIEWS)
def test_held_gap_is_the_running_maximum(gap, views):
    """Of the gap itself; for eq. 5, which decays, too."""
    np.testing.assert_array_equal(
        gaps_along(views, gap=gap, hold=True), np.maximum.accumulate(gaps_along(views, gap=gap))
    )


@pytest.mark.parametrize("gap", ["learned", "overdue"])
def test_learned_and_overdue_gaps_do_not_change_the_belief(gap):
    views = GENERATOR.random((4, NUM_CATEGORIES)) < 0.5
    beliefs = []
    for name in (gap, "novelty"):
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=name), EVIDENCE)
        state = estimator.init()
        for view in views:
            state = estimator.update(state, jnp.asarray(view), 0)
        beliefs.append(state)
    np.testing.assert_array_equal(beliefs[0].alpha, beliefs[1].alpha)
    np.testing.assert_array_equal(beliefs[0].last_visible, beliefs[1].last_visible)
    assert beliefs[1].co_seen is None


def test_missing_evidence_and_goal_are_named():
    for setting in ("learned", "overdue"):
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=setting))
        with pytest.raises(ValueError, match="needs `cooccurrence`"):
            estimator.update(estimator.init(), jnp.ones(NUM_CATEGORIES, bool), 0)
    estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap="overdue"), EVIDENCE)
    with pytest.raises(ValueError, match="needs the goal"):
        estimator.update(estimator.init(), jnp.ones(NUM_CATEGORIES, bool))
