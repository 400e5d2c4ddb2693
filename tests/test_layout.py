"""Equations 3 to 6: the belief, its expectation, the gap, and the named settings."""

import dataclasses

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.special import digamma
from support.dirichlet import exact_kl

from jaxnav.layout import ESTIMATORS, EstimatorConfig, LayoutEstimator, LayoutState, prior_from_counts

K = 6
PRESENCE = hnp.arrays(np.bool_, (4, K))


def belief(alpha, last=(0,) * K, gap=0.0) -> LayoutState:
    return LayoutState(jnp.asarray(alpha, jnp.float32), jnp.array(last, bool), jnp.float32(gap))


def random_counts(seed: int = 0, k: int = K) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).integers(1, 200, (k, k)))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_prior_rows(name):
    counts, setting = random_counts(), ESTIMATORS[name]
    alpha = np.asarray(prior_from_counts(counts, name))
    off = ~np.eye(K, dtype=bool)
    assert (np.diag(alpha) == 0).all()
    assert (alpha[off] >= 0.01).all()
    raw = np.where(off, counts, 0)
    if setting.strength is None:
        np.testing.assert_array_equal(alpha, raw)
    else:
        # 20 ((1 - 0.05) n_ij / n_i + 0.05 / (K - 1))
        share = raw / raw.sum(-1, keepdims=True)
        np.testing.assert_allclose(alpha[off], (20 * (0.95 * share + 0.05 / (K - 1)))[off], rtol=1e-5)
        np.testing.assert_allclose(alpha.sum(-1), 20, rtol=1e-5)


def test_prior_of_unseen_rows_is_uniform_and_bounded_below():
    counts = jnp.zeros((K, K)).at[0, 1].set(1e6)
    alpha = np.asarray(prior_from_counts(counts, EstimatorConfig(strength=10.0, uniform=0.0)))
    np.testing.assert_allclose(alpha[0], [0, 10, 0.01, 0.01, 0.01, 0.01])
    np.testing.assert_allclose(alpha[1], [2, 0, 2, 2, 2, 2], rtol=1e-6)


def test_calibrated_step_by_hand():
    """S = 20, uniform prior, K = 22, V = 3: every entry is 20 / 21, each visible row gains two counts of one.

    KL = 2 g(20/21, 1) - g(20, 2) with g(a, 1) = psi(a + 1) - log a and g(20, 2) = 2 psi(22) - log 20 - log 21
       = 2 * (0.3913 + 0.0488) - (2 * 3.0681 - 2.9957 - 3.0445) = 0.7842, so D = tanh(0.7842) = 0.6552.
    """
    estimator = LayoutEstimator(prior_from_counts(jnp.ones((22, 22))))
    presence = jnp.zeros(22, bool).at[jnp.array([1, 4, 9])].set(True)
    state = estimator.update(estimator.init(), presence)
    a = 20 / 21
    kl = 2 * (digamma(a + 1) - np.log(a)) - (2 * digamma(22) - np.log(20) - np.log(21))
    assert abs(kl - 0.7842) < 1e-3
    np.testing.assert_allclose(state.gap, np.tanh(kl), rtol=1e-4)
    # Only the visible rows and columns gained, and not on the diagonal.
    gained = np.asarray(state.alpha - estimator.prior)
    p = np.asarray(presence, np.float32)
    np.testing.assert_allclose(gained, np.outer(p, p) - np.diag(p), atol=1e-6)


def run(estimator: LayoutEstimator, views) -> list[LayoutState]:
    step, states = jax.jit(type(estimator).update), [estimator.init()]
    for view in views:
        states.append(step(estimator, states[-1], jnp.asarray(view)))
    return states[1:]


def test_gap_falls_as_evidence_gathers():
    """Views drawn from the prior, S = 20, V = 3: the mean gap is large at first and below 0.5 by step 20."""
    estimator, rng = LayoutEstimator(prior_from_counts(jnp.ones((22, 22)))), np.random.default_rng(0)
    home = rng.permutation(22)[:6]
    views = np.zeros((20, 22), bool)
    for view in views:
        view[rng.choice(home, 3, replace=False)] = True
    gaps = [float(s.gap) for s in run(estimator, views)]
    assert gaps[0] > 0.6
    assert max(gaps[-5:]) < 0.5
    assert gaps[-1] < gaps[0] / 2


def views_of(*sets) -> np.ndarray:
    return np.array([[i in visible for i in range(K)] for visible in sets])


def test_belief_without_a_gap_is_the_same_belief():
    counts = jnp.arange(16.0).reshape(4, 4) + 1.0
    setting = ESTIMATORS["calibrated"]
    plain, without = (
        LayoutEstimator(prior_from_counts(counts, setting), own)
        for own in (setting, dataclasses.replace(setting, gap="none"))
    )
    one, other = plain.init(), without.init()
    for seen in ([1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 1]):
        one, other = (est.update(belief, jnp.array(seen)) for est, belief in ((plain, one), (without, other)))
        np.testing.assert_array_equal(one.alpha, other.alpha)
        np.testing.assert_array_equal(one.last_visible, other.last_visible)
        assert one.gap > 0.0
        assert other.gap == 0.0


def test_released_gap_is_a_clock():
    """Saturated KL: 0.8 when a new view of two or more comes, then 0.64 of the last value while nothing is new."""
    views = views_of({2}, {0, 1}, {0, 1}, {0, 1}, {0, 1, 2}, {3}, {0, 1, 2}, {0, 2})
    estimator = LayoutEstimator(prior_from_counts(jnp.ones((K, K)), "released"), "released")
    gaps = [float(s.gap) for s in run(estimator, views)]
    # {3} is refused for it is one category; the {0, 1, 2} after it equals the last accepted set.
    np.testing.assert_allclose(gaps, [0, 0.8, 0.512, 0.32768, 0.8, 0.512, 0.32768, 0.8], rtol=1e-3)


def test_released_counts_its_own_column_in_every_row():
    prior = np.asarray(prior_from_counts(random_counts(), "released"))
    estimator = LayoutEstimator(jnp.asarray(prior), "released")
    (state,) = run(estimator, views_of({1, 4}))
    p = views_of({1, 4})[0]
    np.testing.assert_allclose(state.alpha, prior + 5 * p[None, :])
    expected = np.tanh(exact_kl(prior + np.eye(K), 5 * np.ones((K, 1), int) * p).sum()) * 0.8
    np.testing.assert_allclose(state.gap, expected, rtol=1e-4)
    share = np.asarray(state.alpha) / np.asarray(state.alpha).sum(-1, keepdims=True)
    np.testing.assert_allclose(estimator.expectation(state), share + np.eye(K), rtol=1e-6)


def test_paper_is_equation_5_to_the_letter():
    """All rows, mean over K, no gate: also a single visible category and a repeated view count."""
    prior = np.asarray(prior_from_counts(random_counts(3), "paper"))
    states = run(LayoutEstimator(jnp.asarray(prior), "paper"), views_of({1}, {1, 4}, {1, 4}, ()))
    alpha = prior
    for view, state in zip(views_of({1}, {1, 4}, {1, 4}, ()), states, strict=True):
        counts = np.where(np.eye(K, dtype=bool), 0, view[None, :].astype(int))  # n_{-i}
        masked = [exact_kl(np.delete(alpha[i], i), np.delete(counts[i], i)) for i in range(K)]
        np.testing.assert_allclose(state.gap, np.tanh(np.mean(masked)), rtol=1e-3, atol=1e-7)
        alpha = alpha + counts
        np.testing.assert_allclose(state.alpha, alpha)


@pytest.mark.parametrize(("rows", "reduction"), [("all", "mean_visible"), ("visible", "sum"), ("visible", "mean")])
def test_other_readings_of_equation_5(rows, reduction):
    prior, view = np.asarray(prior_from_counts(random_counts(5), EstimatorConfig())), views_of({0, 2, 3})[0]
    counts = np.outer(view if rows == "visible" else np.ones(K, bool), view) & ~np.eye(K, dtype=bool)
    kl = np.array([exact_kl(np.delete(prior[i], i), np.delete(counts[i], i).astype(int)) for i in range(K)])
    expected = {"mean_visible": kl[view].mean(), "sum": kl.sum(), "mean": kl.mean()}[reduction]
    (state,) = run(LayoutEstimator(jnp.asarray(prior), EstimatorConfig(rows=rows, reduction=reduction)), [view])
    np.testing.assert_allclose(state.gap, np.tanh(expected), rtol=1e-4)


def test_the_mean_over_a_single_category_is_its_own():
    """It counts itself, so its row learns something alone."""
    setting = EstimatorConfig(reduction="mean_visible", own_column=True, gate=False)
    prior = np.asarray(prior_from_counts(random_counts(6), setting))
    (view,) = views_of({1})
    (state,) = run(LayoutEstimator(jnp.asarray(prior), setting), [view])
    np.testing.assert_allclose(state.gap, np.tanh(exact_kl(prior[1] + np.eye(K)[1], view.astype(int))), rtol=1e-4)


def test_shut_gate_leaves_the_belief_and_decays_the_gap():
    alpha = prior_from_counts(random_counts())
    state = belief(alpha, views_of({0, 1})[0], 0.5)
    estimator = LayoutEstimator(alpha)
    for visible in ((), {3}, {0, 1}):
        after = estimator.update(state, jnp.asarray(views_of(visible)[0]))
        np.testing.assert_array_equal(after.alpha, alpha)
        np.testing.assert_array_equal(after.last_visible, state.last_visible)
        np.testing.assert_allclose(after.gap, 0.4)
    assert float(estimator.update(state, jnp.asarray(views_of({0, 2})[0])).alpha.sum()) > float(alpha.sum()) + 1


@pytest.mark.parametrize("name", ["paper", "calibrated"])
@given(PRESENCE)
def test_expectation_and_order(name, views):
    estimator = LayoutEstimator(prior_from_counts(random_counts(), name), name)
    states = run(estimator, views)
    w = np.asarray(estimator.expectation(states[-1]))
    np.testing.assert_array_equal(np.diag(w), 1)
    np.testing.assert_allclose(w.sum(-1), 2, rtol=1e-5)  # off the diagonal rows sum to 1
    for goal in (0, K - 1):
        np.testing.assert_allclose(estimator.goal_weights(states[-1], goal), w[:, goal], rtol=1e-6)
    assert (np.diag(states[-1].alpha) == 0).all()
    assert all(0 <= float(s.gap) <= 1 for s in states)
    if name == "paper":  # without a gate the posterior does not depend on the order of the views
        np.testing.assert_allclose(run(estimator, views[::-1])[-1].alpha, states[-1].alpha, rtol=1e-6)


def test_goal_weights_are_the_column_not_the_row():
    """Negative control: with an asymmetric prior the row w[goal, :] is another vector."""
    estimator = LayoutEstimator(prior_from_counts(random_counts()))
    w, q = estimator.expectation(estimator.init()), estimator.goal_weights(estimator.init(), 2)
    assert np.abs(q - w[2]).max() > 0.05
    assert float(q[2]) == 1


@pytest.mark.parametrize("name", ESTIMATORS)
def test_vmap_equals_single_and_traces_once(name):
    priors = jnp.stack([prior_from_counts(random_counts(seed), name) for seed in range(3)])
    views = jax.random.bernoulli(jax.random.key(1), 0.5, (3, 5, K))
    traces = []

    @jax.jit
    @jax.vmap
    def step(prior, state, view):
        traces.append(1)
        return LayoutEstimator(prior, name).update(state, view)

    states = jax.vmap(lambda prior: LayoutEstimator(prior, name).init())(priors)
    for t in range(5):
        states = step(priors, states, views[:, t].astype(jnp.float32))  # real presence is accepted too
    assert len(traces) == 1
    for i in range(3):
        single = run(LayoutEstimator(priors[i], name), np.asarray(views[i]))[-1]
        jax.tree.map(lambda x, y, i=i: np.testing.assert_allclose(x[i], y, rtol=1e-5, atol=1e-6), states, single)


def test_settings_are_those_of_the_methods_table():
    common = {"strength": None, "uniform": 0.0, "rows": "all"}
    paper = {"reduction": "mean", "increment": 1, "own_column": False, "gate": False, "form": "paper"}
    released = {"reduction": "sum", "increment": 5, "own_column": True, "gate": True, "form": "residual"}
    calibrated = {"rows": "visible", "reduction": "mean_visible", "increment": 1, "own_column": False, "gate": True}
    calibrated |= {"decay": 0.8, "passes": 1, "strength": 20.0, "uniform": 0.05, "form": "residual"}
    expected = {
        "paper": common | paper | {"gap": "novelty"},
        "released": common | released | {"gap": "novelty", "decay": 0.8, "passes": 2},
        "calibrated": calibrated | {"gap": "novelty"},
        "evidence": calibrated | {"gap": "evidence"},
    }
    assert expected.keys() == ESTIMATORS.keys()
    for name, fields in expected.items():
        assert fields.items() <= dataclasses.asdict(ESTIMATORS[name]).items()


@pytest.mark.parametrize(
    ("field", "good", "bad"),
    [
        ("increment", (1, 50), (0, 51, 1.5)),
        ("decay", (0.0, 1.0), (-0.1, 1.1, float("nan"))),
        ("passes", (1, 3), (0, 1.5)),
        ("strength", (0.1, None), (0.0, -1.0, float("inf"))),
        ("uniform", (0.0, 1.0), (-0.1, 1.1)),
    ],
)
def test_settings_out_of_range_are_refused_by_name(field, good, bad):
    for value in good:
        assert getattr(EstimatorConfig(**{field: value}), field) == value
    for value in bad:
        with pytest.raises(ValueError, match=f"{field} is {value}: give a "):
            EstimatorConfig(**{field: value})


def test_one_category_has_no_prior():
    with pytest.raises(ValueError, match="two or more categories"):
        prior_from_counts(jnp.ones((1, 1)))
    np.testing.assert_allclose(prior_from_counts(jnp.ones((2, 2))), [[0, 20], [20, 0]], rtol=1e-6)


def test_unknown_setting_names_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'calibrated'"):
        LayoutEstimator(jnp.ones((K, K)), "calibratd")
