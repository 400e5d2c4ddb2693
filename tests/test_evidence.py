"""Tests of the evidence gap, a measure of how badly views fit the prior: worked arithmetic, SciPy, shifted layouts."""

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

NUM_CATEGORIES = 12
NUM_EPISODES = 200
NUM_STEPS = 20
VIEWS = hnp.arrays(np.bool_, (5, NUM_CATEGORIES))
SEEDS = st.integers(0, 2**32 - 1)


@jax.jit
@jax.vmap
def jitted_gaps(prior, views):
    """Gaps [T] along one episode of views bool [T, K]."""
    estimator = LayoutEstimator(prior, "evidence")

    def step(state, view):
        state = estimator.update(state, view)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def gaps_of(prior, views) -> np.ndarray:
    """Gaps [E, T] of views [E, T, K], where all episodes begin with one prior."""
    return np.asarray(jitted_gaps(jnp.broadcast_to(prior, (len(views), *prior.shape)), jnp.asarray(views)))


def random_prior(seed: int) -> jax.Array:
    """Prior with uneven rows, in which a third of the pairs has no count."""
    generator = np.random.default_rng(seed)
    counts = generator.integers(1, 300, (NUM_CATEGORIES, NUM_CATEGORIES))
    has_count = generator.random((NUM_CATEGORIES, NUM_CATEGORIES)) < 2 / 3
    return prior_from_counts(jnp.asarray(counts * has_count), "evidence")


def zoned_views(generator: np.random.Generator) -> np.ndarray:
    """Views bool [E, T, K] of three categories each, mostly of one of three zones of four categories."""
    views = np.zeros((NUM_EPISODES, NUM_STEPS, NUM_CATEGORIES), bool)
    for view in views.reshape(-1, NUM_CATEGORIES):
        zone = generator.integers(3)
        share = np.where(np.arange(NUM_CATEGORIES) // 4 == zone, 1, 0.05)
        view[generator.choice(NUM_CATEGORIES, 3, replace=False, p=share / share.sum())] = True
    return views


def zoned_prior() -> jax.Array:
    """Prior from the pairs of categories in the zoned views of other episodes."""
    views = zoned_views(np.random.default_rng(9)).reshape(-1, NUM_CATEGORIES).astype(int)
    return prior_from_counts(jnp.asarray(views.T @ views), "evidence")


def area_under_curve(low_values: np.ndarray, high_values: np.ndarray) -> float:
    return float(mannwhitneyu(high_values, low_values).statistic / (len(low_values) * len(high_values)))


@pytest.mark.slow
def test_evidence_gap_follows_worked_arithmetic():
    """A view shows 0 with 2. Row 0: p = (-, 3/4, 1/4), a = 4, p . p = 0.625; then q = (-, 3/5, 2/5) and p . q = 0.55.

    With v = 3/4 * 1/4 * (3/4 - 1/4)^2 = 0.046875 the standard deviation is sqrt(v * 1 / (5 * 5)) = 0.0433. Row 2 is the
    mirror image of row 0, so z = 2 * 0.075 / (2 * 0.0433) = sqrt(3) and D = 2 Phi(1.7321) - 1 = 0.9167.

    A view that shows 0 with 1 gives q = (-, 4/5, 1/5) and p . q = 0.65 > p . p; row 1 is uniform, so every count agrees
    with it equally: D = 0.
    """
    prior = jnp.array([[0.0, 3, 1], [2, 0, 2], [1, 3, 0]])
    estimator = LayoutEstimator(prior, "evidence")
    unlikely_state = estimator.update(estimator.init(), jnp.array([1, 0, 1]))
    likely_state = estimator.update(estimator.init(), jnp.array([1, 1, 0]))
    np.testing.assert_allclose(unlikely_state.gap, 0.9167, atol=1e-4)
    assert float(likely_state.gap) == 0


@given(SEEDS, VIEWS)
@pytest.mark.exhaustive
def test_evidence_gap_agrees_with_scipy(seed, views):
    prior = random_prior(seed)
    estimator = LayoutEstimator(prior, "evidence")
    state = estimator.init()
    for view in views:
        state = estimator.update(state, jnp.asarray(view))

    # Per row: by how much the posterior falls short of the expected agreement p . p, and the deviation of this excess
    # under the prior, by the covariance of the sightings. The rows count as fully correlated, so both just add up.
    excess = deviation = 0.0
    for row in range(NUM_CATEGORIES):
        prior_row, posterior_row = (
            np.delete(np.asarray(alpha[row], np.float64), row) for alpha in (prior, state.alpha)
        )
        num_seen = np.rint(posterior_row - prior_row)
        prior_shares = prior_row / prior_row.sum()
        excess += prior_shares @ prior_shares - prior_shares @ (prior_row + num_seen) / (prior_row + num_seen).sum()
        if num_seen.sum():
            covariance = dirichlet_multinomial(prior_row, int(num_seen.sum())).cov()
            deviation += np.sqrt(prior_shares @ covariance @ prior_shares) / (prior_row + num_seen).sum()

    # D = 2 Phi(z) - 1 at z = excess / deviation, and 0 if the views fit better than expected.
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
    # Six views of two categories of different zones, then twelve views of two categories of one zone.
    misfit_views = np.zeros((6, NUM_CATEGORIES), bool)
    misfit_views[::2, [0, 4]] = True
    misfit_views[1::2, [1, 5]] = True
    fitting_views = np.zeros((12, NUM_CATEGORIES), bool)
    fitting_views[::2, [0, 1]] = True
    fitting_views[1::2, [4, 5]] = True

    (gaps,) = gaps_of(zoned_prior(), np.concatenate([misfit_views, fitting_views])[None])
    assert (np.diff(gaps[1:6]) > 0).all()
    assert gaps[5] > 0.9
    assert (np.diff(gaps[7:]) <= 0).all()
    assert gaps[-1] < gaps[5] / 2


@pytest.mark.slow
def test_closed_gate_keeps_the_evidence_gap():
    """The evidence gap does not decay: views without news leave the evidence unchanged.

    Belief and accepted view equal those of `calibrated`.
    """
    # One view three times, then a single category.
    views = np.zeros((4, NUM_CATEGORIES), bool)
    views[:3, [0, 4]] = True
    views[3, 7] = True
    (gaps,) = gaps_of(zoned_prior(), views[None])
    assert gaps[0] > 0.3
    np.testing.assert_array_equal(gaps, gaps[0])

    # The estimators `evidence` and `calibrated` differ only in the gap.
    evidence_estimator = LayoutEstimator(zoned_prior(), "evidence")
    calibrated_estimator = LayoutEstimator(zoned_prior(), "calibrated")
    evidence_state = evidence_estimator.update(evidence_estimator.init(), jnp.asarray(views[0]))
    calibrated_state = calibrated_estimator.update(calibrated_estimator.init(), jnp.asarray(views[0]))
    np.testing.assert_array_equal(evidence_state.alpha, calibrated_state.alpha)
    np.testing.assert_array_equal(evidence_state.last_visible, calibrated_state.last_visible)
    assert evidence_state.gap != calibrated_state.gap
    assert ESTIMATORS["evidence"] == EstimatorConfig(gap="evidence")


@pytest.mark.slow
@pytest.mark.parametrize("independent", [False, True])
def test_evidence_gap_exceeds_its_level_in_the_expected_share_of_layouts(independent):
    """Layouts drawn from the prior give D = 2 P - 1, with P uniform for views of one row and nearer 1/2 for all rows.

    So D > 0 in half of the layouts. D > 0.5 in a quarter of them for one row, and in far fewer for all rows, since the
    gap takes the rows as fully correlated.
    """
    generator = np.random.default_rng(0)
    prior = np.asarray(zoned_prior(), np.float64)

    # In each of 1,000 episodes, 30 sightings per row of a layout that is drawn from the prior.
    row_indices = range(NUM_CATEGORIES) if independent else range(1)
    alpha = np.tile(prior, (1000, 1, 1))
    for row in row_indices:
        is_companion = np.arange(NUM_CATEGORIES) != row
        layouts = dirichlet.rvs(prior[row, is_companion], size=len(alpha), random_state=generator)
        for episode_alpha, layout in zip(alpha, layouts, strict=True):
            episode_alpha[row, is_companion] += multinomial.rvs(30, layout, random_state=generator)

    gaps = np.asarray(jax.vmap(evidence_gap, (None, 0))(jnp.float32(prior), jnp.float32(alpha)))
    assert abs((gaps > 0).mean() - 0.5) < 0.05
    if independent:
        assert (gaps > 0.5).mean() < 0.1
    else:
        assert abs((gaps > 0.5).mean() - 0.25) < 0.05


@pytest.mark.slow
def test_evidence_gap_tells_layouts_apart():
    """Views drawn from the prior keep the gap low, and views of randomly renamed categories raise it step by step."""
    # Two sets of episodes with the layout of the prior, and one whose categories are renamed in every episode.
    generator = np.random.default_rng(0)
    training_views = zoned_views(generator)
    control_views = zoned_views(generator)
    original_views = zoned_views(generator)
    shifted_views = np.stack([episode[:, generator.permutation(NUM_CATEGORIES)] for episode in original_views])

    prior = zoned_prior()
    gaps = gaps_of(prior, training_views)
    control_gaps = gaps_of(prior, control_views)
    shifted_gaps = gaps_of(prior, shifted_views)
    assert gaps[:, -1].mean() < 0.25
    assert shifted_gaps[:, -1].mean() > 0.75

    # The gap separates the layouts better with every step; it does not separate two sets of one layout.
    area_by_step = [area_under_curve(gaps[:, time_index], shifted_gaps[:, time_index]) for time_index in (0, 4, 19)]
    assert area_by_step[0] < area_by_step[1] < area_by_step[2]
    assert area_by_step[1] > 0.8
    assert area_by_step[2] > 0.95
    assert abs(area_under_curve(gaps[:, -1], control_gaps[:, -1]) - 0.5) < 0.1
