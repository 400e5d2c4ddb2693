"""The gap that measures how badly what was seen fits the prior: by hand, against SciPy, and telling layouts apart."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.stats import dirichlet, dirichlet_multinomial, mannwhitneyu, multinomial, norm

from jaxnav.gaps import evidence_gap
from jaxnav.layout import ESTIMATORS, EstimatorConfig, LayoutEstimator, prior_from_counts

NUM_CATEGORIES, NUM_EPISODES, NUM_STEPS = 12, 200, 20
VIEWS = hnp.arrays(np.bool_, (5, NUM_CATEGORIES))
SEEDS = st.integers(0, 2**32 - 1)


@jax.jit
@jax.vmap
def jitted_gaps(prior, views):
    """The gaps [T] along one episode, views bool [T, K]."""
    estimator = LayoutEstimator(prior, "evidence")

    def step(state, view):
        state = estimator.update(state, view)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def gaps_of(prior, views) -> np.ndarray:
    """[E, T] of views [E, T, K], all from one prior."""
    return np.asarray(jitted_gaps(jnp.broadcast_to(prior, (len(views), *prior.shape)), jnp.asarray(views)))


def random_prior(seed: int) -> jax.Array:
    """Uneven rows; a third of the pairs was never seen."""
    generator = np.random.default_rng(seed)
    counts = generator.integers(1, 300, (NUM_CATEGORIES, NUM_CATEGORIES)) * (
        generator.random((NUM_CATEGORIES, NUM_CATEGORIES)) < 2 / 3
    )
    return prior_from_counts(jnp.asarray(counts), "evidence")


def zoned_views(generator: np.random.Generator) -> np.ndarray:
    """Views bool [EPISODES, STEPS, K] of three categories, as a rule of one of three zones of four."""
    views = np.zeros((NUM_EPISODES, NUM_STEPS, NUM_CATEGORIES), bool)
    for view in views.reshape(-1, NUM_CATEGORIES):
        zone = generator.integers(3)
        share = np.where(np.arange(NUM_CATEGORIES) // 4 == zone, 1, 0.05)
        view[generator.choice(NUM_CATEGORIES, 3, replace=False, p=share / share.sum())] = True
    return views


def zoned_prior() -> jax.Array:
    """What such views show together, counted in other episodes."""
    views = zoned_views(np.random.default_rng(9)).reshape(-1, NUM_CATEGORIES).astype(int)
    return prior_from_counts(jnp.asarray(views.T @ views), "evidence")


def area_under_curve(low_values: np.ndarray, high_values: np.ndarray) -> float:
    return float(mannwhitneyu(high_values, low_values).statistic / (len(low_values) * len(high_values)))


@pytest.mark.slow
def test_evidence_gap_follows_worked_arithmetic():
    """0 is seen with 2. Row 0: p = (-, 3/4, 1/4), a = 4, so p . p = 0.625; then q = (-, 3/5, 2/5) and p . q = 0.55.

    v = 3/4 * 1/4 * (3/4 - 1/4)^2 = 0.046875, its standard deviation sqrt(v * 1 / (5 * 5)) = 0.0433, and row 2 is its
    mirror image: z = 2 * 0.075 / (2 * 0.0433) = sqrt(3), D = 2 Phi(1.7321) - 1 = 0.9167. Had 0 been seen with 1, then
    q = (-, 4/5, 1/5), p . q = 0.65 > p . p, and in row 1, which is uniform, all agree alike: D = 0.
    """
    prior = jnp.array([[0.0, 3, 1], [2, 0, 2], [1, 3, 0]])
    estimator = LayoutEstimator(prior, "evidence")
    unlikely, likely = (estimator.update(estimator.init(), jnp.array(view)).gap for view in ([1, 0, 1], [1, 1, 0]))
    np.testing.assert_allclose(unlikely, 0.9167, atol=1e-4)
    assert float(likely) == 0


@given(SEEDS, VIEWS)
@pytest.mark.exhaustive
def test_evidence_gap_agrees_with_scipy(seed, views):
    prior = random_prior(seed)
    estimator = LayoutEstimator(prior, "evidence")
    state = estimator.init()
    for view in views:
        state = estimator.update(state, jnp.asarray(view))
    excess = deviation = 0.0
    for row in range(NUM_CATEGORIES):
        prior_row, posterior_row = (
            np.delete(np.asarray(alpha[row], np.float64), row) for alpha in (prior, state.alpha)
        )
        num_seen = np.rint(posterior_row - prior_row)
        prior_shares = prior_row / prior_row.sum()
        excess += prior_shares @ prior_shares - prior_shares @ (prior_row + num_seen) / (prior_row + num_seen).sum()
        if num_seen.sum():
            covariance = dirichlet_multinomial(prior_row, int(num_seen.sum())).cov()  # of the sightings
            deviation += np.sqrt(prior_shares @ covariance @ prior_shares) / (prior_row + num_seen).sum()
    expected = max(2 * norm.cdf(excess / deviation) - 1, 0) if deviation else 0
    np.testing.assert_allclose(state.gap, expected, atol=1e-4)


@pytest.mark.slow
@given(SEEDS, VIEWS, st.permutations(range(NUM_CATEGORIES)))
def test_evidence_gap_is_bounded_starts_at_zero_and_ignores_category_order(seed, views, order):
    """0 before anything is seen, always in [0, 1], and the same whatever the categories are called."""
    prior = random_prior(seed)
    assert float(LayoutEstimator(prior, "evidence").init().gap) == 0
    assert float(evidence_gap(prior, prior)) == 0
    (gaps,) = gaps_of(prior, views[None])
    assert (gaps >= 0).all()
    assert (gaps <= 1).all()
    (renamed,) = gaps_of(prior[jnp.array(order)][:, jnp.array(order)], views[None][..., order])
    np.testing.assert_allclose(renamed, gaps, atol=1e-4)


@pytest.mark.slow
def test_evidence_gap_of_a_uniform_prior_is_zero():
    views = np.random.default_rng(0).random((20, NUM_STEPS, NUM_CATEGORIES)) < 0.3
    assert gaps_of(prior_from_counts(jnp.ones((NUM_CATEGORIES, NUM_CATEGORIES)), "evidence"), views).max() < 0.01
    assert gaps_of(prior_from_counts(jnp.ones((2, 2)), "evidence"), np.ones((1, 3, 2), bool)).max() == 0


def test_misfits_raise_the_evidence_gap_and_fitting_views_lower_it():
    misfits = np.zeros((6, NUM_CATEGORIES), bool)
    misfits[::2, [0, 4]] = True  # of two zones
    misfits[1::2, [1, 5]] = True
    fitting = np.zeros((12, NUM_CATEGORIES), bool)
    fitting[::2, [0, 1]] = True
    fitting[1::2, [4, 5]] = True
    (gaps,) = gaps_of(zoned_prior(), np.concatenate([misfits, fitting])[None])
    assert (np.diff(gaps[1:6]) > 0).all()
    assert gaps[5] > 0.9
    assert (np.diff(gaps[7:]) <= 0).all()
    assert gaps[-1] < gaps[5] / 2


@pytest.mark.slow
def test_closed_gate_keeps_the_evidence_gap():
    """No decay: with nothing new the evidence is what it was. Belief and accepted view are those of `calibrated`."""
    views = np.zeros((4, NUM_CATEGORIES), bool)
    views[:3, [0, 4]] = True  # repeated, then a single category
    views[3, 7] = True
    (gaps,) = gaps_of(zoned_prior(), views[None])
    assert gaps[0] > 0.3
    np.testing.assert_array_equal(gaps, gaps[0])
    estimators = [LayoutEstimator(zoned_prior(), name) for name in ("evidence", "calibrated")]
    evidence_state, calibrated_state = (
        estimator.update(estimator.init(), jnp.asarray(views[0])) for estimator in estimators
    )
    np.testing.assert_array_equal(evidence_state.alpha, calibrated_state.alpha)
    np.testing.assert_array_equal(evidence_state.last_visible, calibrated_state.last_visible)
    assert evidence_state.gap != calibrated_state.gap
    assert ESTIMATORS["evidence"] == EstimatorConfig(gap="evidence")


@pytest.mark.slow
@pytest.mark.parametrize("independent", [False, True])
def test_evidence_gap_exceeds_its_level_in_the_expected_share_of_layouts(independent):
    """Layouts drawn from the prior: D = 2 P - 1 with P uniform where one row is seen, nearer 1/2 where all are.

    So D > 0 in half of the layouts, and D > 0.5 in a quarter, or in far fewer: the rows are taken as fully correlated.
    """
    generator, prior = np.random.default_rng(0), np.asarray(zoned_prior(), np.float64)
    row_indices = range(NUM_CATEGORIES) if independent else range(1)
    alpha = np.tile(prior, (1000, 1, 1))
    for row in row_indices:
        others = np.arange(NUM_CATEGORIES) != row
        layouts = dirichlet.rvs(prior[row, others], size=len(alpha), random_state=generator)
        for episode_alpha, layout in zip(alpha, layouts, strict=True):
            episode_alpha[row, others] += multinomial.rvs(30, layout, random_state=generator)
    gaps = np.asarray(jax.vmap(evidence_gap, (None, 0))(jnp.float32(prior), jnp.float32(alpha)))
    assert abs((gaps > 0).mean() - 0.5) < 0.05
    if independent:
        assert (gaps > 0.5).mean() < 0.1
    else:
        assert abs((gaps > 0.5).mean() - 0.25) < 0.05


@pytest.mark.slow
def test_evidence_gap_tells_layouts_apart():
    """Views drawn from the prior keep it low, the same with categories renamed at random raise it, and by evidence."""
    generator, prior = np.random.default_rng(0), zoned_prior()
    same_views, control_views, other_views = (zoned_views(generator) for _ in range(3))
    other_views = np.stack([episode[:, generator.permutation(NUM_CATEGORIES)] for episode in other_views])
    gaps, control_gaps, shifted_gaps = (gaps_of(prior, views) for views in (same_views, control_views, other_views))
    assert gaps[:, -1].mean() < 0.25
    assert shifted_gaps[:, -1].mean() > 0.75
    area_by_step = [area_under_curve(gaps[:, time_index], shifted_gaps[:, time_index]) for time_index in (0, 4, 19)]
    assert area_by_step[0] < area_by_step[1] < area_by_step[2]
    assert area_by_step[1] > 0.8
    assert area_by_step[2] > 0.95
    assert abs(area_under_curve(gaps[:, -1], control_gaps[:, -1]) - 0.5) < 0.1  # negative control
