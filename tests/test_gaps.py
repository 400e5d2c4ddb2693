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

K = 5
VIEWS = hnp.arrays(np.bool_, (6, K))
GENERATOR = np.random.default_rng(0)
PRIOR = prior_from_counts(jnp.asarray(GENERATOR.integers(0, 50, (K, K))))
SIGNS = CooccurrenceEvidence(
    log_odds=jnp.triu(jnp.asarray(GENERATOR.normal(size=(K, K)), jnp.float32), 1),
    co_visibility=jnp.asarray(GENERATOR.random((K, K)) * (1 - np.eye(K)), jnp.float32),
)


@functools.partial(jax.jit, static_argnums=0)
def walk(setting, views):
    """The gaps after each view [T], the goal being 0."""
    estimator = LayoutEstimator(PRIOR, setting, SIGNS)

    def step(state, view):
        state = estimator.update(state, view, 0)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def course(views, **changes):
    return np.asarray(walk(EstimatorConfig(**changes), jnp.asarray(views)))


def test_learned_by_hand():
    """0, 1 and 2 seen together: ln 3 + ln 2 - ln 1 = ln 6, so p = 6 / 7; with nothing seen p = 1/2."""
    odds = jnp.zeros((4, 4)).at[0, 1].set(np.log(3)).at[0, 2].set(np.log(2)).at[2, 3].set(5.0)
    together = seen_together(jnp.array([[1, 1, 1, 0]], bool))
    np.testing.assert_allclose(learned_gap(together, odds), 6 / 7, rtol=1e-6)
    assert float(learned_gap(jnp.zeros((4, 4), bool), odds)) == 0.5


def test_overdue_by_hand():
    """The goal is 2. Beside 0 it is seen with 1/2, beside 1 with 1/4: missed with 3/8 where both were seen."""
    chance = jnp.zeros((4, 4)).at[0, 2].set(0.5).at[1, 2].set(0.25).at[2, 0].set(0.9).at[3, 2].set(1.0)
    views = jnp.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], bool)
    gaps = [float(overdue_gap(seen_together(views[:n]), chance, 2)) for n in range(4)]
    assert gaps == [0.0, 0.5, 0.625, 0.0]
    assert float(overdue_gap(seen_together(jnp.array([[0, 0, 0, 1]], bool)), chance, 2)) == 1.0


@given(VIEWS)
def test_overdue_rises_until_the_goal_is_seen(views):
    gaps = course(views, gap="overdue")
    expected = np.maximum.accumulate(views[:, 0])
    assert (gaps[expected] == 0).all()
    assert (np.diff(gaps[~expected]) >= 0).all()
    assert ((gaps >= 0) & (gaps <= 1)).all()


@given(VIEWS)
def test_overdue_is_the_share_of_episodes_that_meet_independent_chances(views):
    """Each category seen shows the goal or not, independently: the mean over all 2^K outcomes, in float64."""
    seen = views[:, 1:].any(axis=0)
    chance = np.asarray(SIGNS.co_visibility, np.float64)[1:, 0]
    outcomes = np.array(list(np.ndindex(*[2] * (K - 1))), bool)
    weight = np.where(outcomes, chance, 1 - chance).prod(axis=1)
    expected = weight[(outcomes & seen).any(axis=1)].sum()
    views = views & (np.arange(K) > 0)
    np.testing.assert_allclose(course(views, gap="overdue")[-1], expected, atol=1e-6)


@given(VIEWS)
def test_learned_goes_by_the_pairs_seen_so_far(views):
    odds = np.asarray(SIGNS.log_odds, np.float64)
    for t, gap in enumerate(course(views, gap="learned")):
        pairs = {(i, j) for view in views[: t + 1] for i in range(K) for j in range(i + 1, K) if view[i] and view[j]}
        np.testing.assert_allclose(gap, 1 / (1 + np.exp(-sum(odds[pair] for pair in pairs))), rtol=1e-5)


@pytest.mark.parametrize("gap", ["novelty", "evidence", "learned", "overdue", "clock", "none"])
@given(VIEWS)
def test_hold_is_the_running_maximum(gap, views):
    """Of the gap itself; for eq. 5, which decays, too."""
    np.testing.assert_array_equal(course(views, gap=gap, hold=True), np.maximum.accumulate(course(views, gap=gap)))


@pytest.mark.parametrize("gap", ["learned", "overdue"])
def test_other_gaps_leave_the_belief(gap):
    views = GENERATOR.random((4, K)) < 0.5
    beliefs = []
    for name in (gap, "novelty"):
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=name), SIGNS)
        state = estimator.init()
        for view in views:
            state = estimator.update(state, jnp.asarray(view), 0)
        beliefs.append(state)
    np.testing.assert_array_equal(beliefs[0].alpha, beliefs[1].alpha)
    np.testing.assert_array_equal(beliefs[0].last_visible, beliefs[1].last_visible)
    assert beliefs[1].co_seen is None


def test_what_is_missing_is_named():
    for setting in ("learned", "overdue"):
        estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap=setting))
        with pytest.raises(ValueError, match="needs `cooccurrence`"):
            estimator.update(estimator.init(), jnp.ones(K, bool), 0)
    estimator = LayoutEstimator(PRIOR, EstimatorConfig(gap="overdue"), SIGNS)
    with pytest.raises(ValueError, match="needs the goal"):
        estimator.update(estimator.init(), jnp.ones(K, bool))
