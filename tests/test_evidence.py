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

K, EPISODES, STEPS = 12, 200, 20
VIEWS = hnp.arrays(np.bool_, (5, K))
SEEDS = st.integers(0, 2**32 - 1)


@jax.jit
@jax.vmap
def course(prior, views):
    """The gaps [T] along one episode, views bool [T, K]."""
    estimator = LayoutEstimator(prior, "evidence")

    def step(state, view):
        state = estimator.update(state, view)
        return state, state.gap

    return jax.lax.scan(step, estimator.init(), views)[1]


def gaps_of(prior, views) -> np.ndarray:
    """[E, T] of views [E, T, K], all from one prior."""
    return np.asarray(course(jnp.broadcast_to(prior, (len(views), *prior.shape)), jnp.asarray(views)))


def random_prior(seed: int) -> jax.Array:
    """Uneven rows; a third of the pairs was never seen."""
    generator = np.random.default_rng(seed)
    counts = generator.integers(1, 300, (K, K)) * (generator.random((K, K)) < 2 / 3)
    return prior_from_counts(jnp.asarray(counts), "evidence")


def zoned_views(generator: np.random.Generator) -> np.ndarray:
    """Views bool [EPISODES, STEPS, K] of three categories, as a rule of one of three zones of four."""
    views = np.zeros((EPISODES, STEPS, K), bool)
    for view in views.reshape(-1, K):
        zone = generator.integers(3)
        share = np.where(np.arange(K) // 4 == zone, 1, 0.05)
        view[generator.choice(K, 3, replace=False, p=share / share.sum())] = True
    return views


def zoned_prior() -> jax.Array:
    """What such views show together, counted in other episodes."""
    views = zoned_views(np.random.default_rng(9)).reshape(-1, K).astype(int)
    return prior_from_counts(jnp.asarray(views.T @ views), "evidence")


def auc(low: np.ndarray, high: np.ndarray) -> float:
    return float(mannwhitneyu(high, low).statistic / (len(low) * len(high)))


def test_two_rows_by_hand():
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
@pytest.mark.slow
def test_against_scipy(seed, views):
    prior = random_prior(seed)
    estimator = LayoutEstimator(prior, "evidence")
    state = estimator.init()
    for view in views:
        state = estimator.update(state, jnp.asarray(view))
    excess = deviation = 0.0
    for i in range(K):
        before, after = (np.delete(np.asarray(alpha[i], np.float64), i) for alpha in (prior, state.alpha))
        seen = np.rint(after - before)
        p = before / before.sum()
        excess += p @ p - p @ (before + seen) / (before + seen).sum()
        if seen.sum():
            covariance = dirichlet_multinomial(before, int(seen.sum())).cov()  # of the sightings
            deviation += np.sqrt(p @ covariance @ p) / (before + seen).sum()
    expected = max(2 * norm.cdf(excess / deviation) - 1, 0) if deviation else 0
    np.testing.assert_allclose(state.gap, expected, atol=1e-4)


@given(SEEDS, VIEWS, st.permutations(range(K)))
def test_range_start_and_names(seed, views, order):
    """0 before anything is seen, always in [0, 1], and the same whatever the categories are called."""
    prior = random_prior(seed)
    assert float(LayoutEstimator(prior, "evidence").init().gap) == 0
    assert float(evidence_gap(prior, prior)) == 0
    (gaps,) = gaps_of(prior, views[None])
    assert (gaps >= 0).all()
    assert (gaps <= 1).all()
    (renamed,) = gaps_of(prior[jnp.array(order)][:, jnp.array(order)], views[None][..., order])
    np.testing.assert_allclose(renamed, gaps, atol=1e-4)


def test_nothing_disagrees_with_a_uniform_prior():
    views = np.random.default_rng(0).random((20, STEPS, K)) < 0.3
    assert gaps_of(prior_from_counts(jnp.ones((K, K)), "evidence"), views).max() < 0.01
    assert gaps_of(prior_from_counts(jnp.ones((2, 2)), "evidence"), np.ones((1, 3, 2), bool)).max() == 0


def test_misfits_raise_it_step_by_step_and_fitting_views_lower_it():
    misfits = np.zeros((6, K), bool)
    misfits[::2, [0, 4]] = True  # of two zones
    misfits[1::2, [1, 5]] = True
    fitting = np.zeros((12, K), bool)
    fitting[::2, [0, 1]] = True
    fitting[1::2, [4, 5]] = True
    (gaps,) = gaps_of(zoned_prior(), np.concatenate([misfits, fitting])[None])
    assert (np.diff(gaps[1:6]) > 0).all()
    assert gaps[5] > 0.9
    assert (np.diff(gaps[7:]) <= 0).all()
    assert gaps[-1] < gaps[5] / 2


def test_a_shut_gate_keeps_what_the_evidence_says():
    """No decay: with nothing new the evidence is what it was. Belief and accepted view are those of `calibrated`."""
    views = np.zeros((4, K), bool)
    views[:3, [0, 4]] = True  # repeated, then a single category
    views[3, 7] = True
    (gaps,) = gaps_of(zoned_prior(), views[None])
    assert gaps[0] > 0.3
    np.testing.assert_array_equal(gaps, gaps[0])
    states = [LayoutEstimator(zoned_prior(), name) for name in ("evidence", "calibrated")]
    ours, theirs = (estimator.update(estimator.init(), jnp.asarray(views[0])) for estimator in states)
    np.testing.assert_array_equal(ours.alpha, theirs.alpha)
    np.testing.assert_array_equal(ours.last_visible, theirs.last_visible)
    assert ours.gap != theirs.gap
    assert ESTIMATORS["evidence"] == EstimatorConfig(gap="evidence")


@pytest.mark.parametrize("independent", [False, True])
def test_its_share_of_layouts_that_agree_better(independent):
    """Layouts drawn from the prior: D = 2 P - 1 with P uniform where one row is seen, nearer 1/2 where all are.

    So D > 0 in half of the layouts, and D > 0.5 in a quarter, or in far fewer: the rows are taken as fully correlated.
    """
    generator, prior = np.random.default_rng(0), np.asarray(zoned_prior(), np.float64)
    rows = range(K) if independent else range(1)
    alpha = np.tile(prior, (1000, 1, 1))
    for i in rows:
        others = np.arange(K) != i
        layouts = dirichlet.rvs(prior[i, others], size=len(alpha), random_state=generator)
        for own, layout in zip(alpha, layouts, strict=True):
            own[i, others] += multinomial.rvs(30, layout, random_state=generator)
    gaps = np.asarray(jax.vmap(evidence_gap, (None, 0))(jnp.float32(prior), jnp.float32(alpha)))
    assert abs((gaps > 0).mean() - 0.5) < 0.05
    if independent:
        assert (gaps > 0.5).mean() < 0.1
    else:
        assert abs((gaps > 0.5).mean() - 0.25) < 0.05


def test_tells_layouts_apart():
    """Views drawn from the prior keep it low, the same with categories renamed at random raise it, and by evidence."""
    generator, prior = np.random.default_rng(0), zoned_prior()
    same, again, other = (zoned_views(generator) for _ in range(3))
    other = np.stack([episode[:, generator.permutation(K)] for episode in other])
    gaps, control, shifted = (gaps_of(prior, views) for views in (same, again, other))
    assert gaps[:, -1].mean() < 0.25
    assert shifted[:, -1].mean() > 0.75
    by_step = [auc(gaps[:, t], shifted[:, t]) for t in (0, 4, 19)]
    assert by_step[0] < by_step[1] < by_step[2]
    assert by_step[1] > 0.8
    assert by_step[2] > 0.95
    assert abs(auc(gaps[:, -1], control[:, -1]) - 0.5) < 0.1  # negative control
