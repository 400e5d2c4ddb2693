"""Equations 3 to 6: Dirichlet divergences, the belief, its expectation, and the three settings."""

import dataclasses

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.special import digamma, gammaln

from jaxnav.layout import SETTINGS, LayoutEstimator, LayoutState, Setting, presence_kl, prior_from_counts, update_kl

K = 6
PRESENCE = hnp.arrays(np.bool_, (4, K))


def exact_kl(prior, counts) -> np.ndarray:
    """Float64, whole counts: lnGamma(a + n) - lnGamma(a) is the sum of log(a + i), so no large terms cancel."""
    a, c = np.asarray(prior, np.float64), np.asarray(counts, np.int64)
    a_0, n = a.sum(-1), c.sum(-1)

    def g(x, m):
        steps = np.arange(max(m.max(), 1))
        logs = np.log((x + m)[..., None] / (x[..., None] + steps)) * (steps < m[..., None])
        return logs.sum(-1) + m * (digamma(x + m) - np.log(x + m))

    return g(a, c).sum(-1) - g(a_0, n)


def draws(seed: int, k: int, n: int = 4000):
    """Priors 0.01..2e4 of several kinds with counts 0..3, as (name, prior [n, k], counts [n, k])."""
    rng = np.random.default_rng(seed)
    scale = np.exp(rng.uniform(np.log(1e-2), np.log(2e4), (n, 1)))
    sparse = rng.integers(0, 4, (n, k)) * (rng.random((n, k)) < rng.random((n, 1)))
    full = rng.integers(1, 4, (n, k))
    near = np.exp(rng.normal(size=(n, k)) * 10 ** rng.uniform(-6, -1, (n, 1)))
    extremes = np.where(rng.random((n, k)) < 0.5, rng.uniform(0.01, 0.05, (n, k)), np.maximum(scale, 1))
    kinds = {
        "log-uniform": (np.exp(rng.uniform(np.log(1e-2), np.log(2e4), (n, k))), sparse),
        "extremes": (extremes, sparse),
        "near-proportional": (full * near * scale / 3, full),
        "proportional": (scale * np.ones(k), np.ones((n, k), int) * rng.integers(1, 4, (n, 1))),
    }
    for name, (prior, counts) in kinds.items():
        yield name, np.clip(prior, 1e-2, 2e4).astype(np.float32), counts


def worst_error(function, k: int) -> float:
    errors = []
    for name, prior, counts in draws(k, k):
        exact = exact_kl(prior, counts)
        value = np.asarray(jax.jit(function)(prior, counts.astype(np.float32)))
        large = exact > 1e-6
        errors.append(np.abs(value[large] / exact[large] - 1).max())
        print(f"K = {k}, {name}: worst relative error {errors[-1]:.1e}")
    return max(errors)


@pytest.mark.parametrize("k", [2, 3, 22, 40])
def test_update_kl_is_accurate_in_float32(k):
    assert worst_error(update_kl, k) < 1e-3


def test_lgamma_differences_are_not():
    """Negative control: the textbook formula in float32 misses the bound by orders of magnitude."""
    from jax.scipy.special import digamma as psi
    from jax.scipy.special import gammaln as lgamma

    def textbook(a, c):
        b = a + c
        entries = lgamma(a) - lgamma(b) + c * (psi(b) - psi(b.sum(-1, keepdims=True)))
        return lgamma(b.sum(-1)) - lgamma(a.sum(-1)) + entries.sum(-1)

    assert worst_error(textbook, 22) > 1


def test_reference_agrees_with_the_textbook_formula_in_float64():
    rng = np.random.default_rng(0)
    a, c = rng.uniform(0.05, 30, (200, 8)), rng.integers(0, 4, (200, 8))
    b = a + c
    textbook = gammaln(b.sum(-1)) - gammaln(a.sum(-1)) + (gammaln(a) - gammaln(b)).sum(-1)
    textbook += (c * (digamma(b) - digamma(b.sum(-1, keepdims=True)))).sum(-1)
    np.testing.assert_allclose(exact_kl(a, c), textbook, rtol=1e-8, atol=1e-12)


def test_update_kl_against_monte_carlo():
    # KL = E_posterior[log posterior / prior] = const + E[sum_j c_j log theta_j]; 2e5 samples.
    a, c = np.array([0.5, 2.0, 4.0, 1.5]), np.array([1, 0, 2, 0])
    theta = np.random.default_rng(0).dirichlet(a + c, 200_000)
    b = a + c
    log_ratio = gammaln(b.sum()) - gammaln(a.sum()) + (gammaln(a) - gammaln(b)).sum() + np.log(theta) @ c
    standard_error = log_ratio.std() / np.sqrt(len(theta))
    assert standard_error < 0.01
    kl = update_kl(jnp.asarray(a, jnp.float32), jnp.asarray(c))
    assert abs(float(kl) - log_ratio.mean()) < 4 * standard_error


def test_update_kl_is_positive_and_zero_only_without_counts():
    for _, prior, counts in draws(0, 5):
        kl = np.asarray(update_kl(jnp.asarray(prior), jnp.asarray(counts)))
        empty = counts.sum(-1) == 0
        assert (kl[empty] == 0).all()
        assert (kl[~empty] >= 0).all()
        assert (kl[exact_kl(prior, counts) > 1e-6] > 0).all()


def test_update_kl_leaves_out_entries_with_prior_zero():
    padded = update_kl(jnp.array([0.0, 1.0, 2.0, 0.0]), jnp.array([0.0, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(padded, update_kl(jnp.array([1.0, 2.0]), jnp.array([1.0, 0.0])), rtol=1e-6)
    # By hand, a = (1, 2), c = (1, 0): g(1, 1) - g(3, 1) = psi(2) - psi(4) + log 3 = log 3 - 1/2 - 1/3.
    np.testing.assert_allclose(padded, np.log(3) - 5 / 6, rtol=1e-5)


@pytest.mark.parametrize("increment", [1, 2, 5])
def test_presence_kl_is_update_kl_for_equal_counts(increment):
    rng = np.random.default_rng(increment)
    for name, prior, counts in draws(increment, 22):
        counts = increment * (counts > 0) * (rng.random(counts.shape) < 0.5)
        total = sum(
            exact_kl(np.stack([a, np.full_like(a, 1e9)], -1), np.stack([c, 0 * c], -1))
            for a, c in zip(prior.T, counts.T, strict=True)
        )  # g(a, c): the rest of the Dirichlet is too large to matter
        value = jax.jit(presence_kl, static_argnums=2)(prior, counts.astype(np.float32), increment)
        error = np.abs(value - np.maximum(exact_kl(prior, counts), 0)) / np.maximum(total, 1e-30)
        print(f"increment {increment}, {name}: worst error {error.max():.1e} of the sum of g")
        assert error.max() < 2e-5


def belief(alpha, last=(0,) * K, gap=0.0) -> LayoutState:
    return LayoutState(jnp.asarray(alpha, jnp.float32), jnp.array(last, bool), jnp.float32(gap))


def random_counts(seed: int = 0, k: int = K) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).integers(1, 200, (k, k)))


@pytest.mark.parametrize("name", SETTINGS)
def test_prior_rows(name):
    counts, setting = random_counts(), SETTINGS[name]
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
    alpha = np.asarray(prior_from_counts(counts, Setting(strength=10.0, uniform=0.0)))
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
    prior, view = np.asarray(prior_from_counts(random_counts(5), Setting())), views_of({0, 2, 3})[0]
    counts = np.outer(view if rows == "visible" else np.ones(K, bool), view) & ~np.eye(K, dtype=bool)
    kl = np.array([exact_kl(np.delete(prior[i], i), np.delete(counts[i], i).astype(int)) for i in range(K)])
    expected = {"mean_visible": kl[view].mean(), "sum": kl.sum(), "mean": kl.mean()}[reduction]
    (state,) = run(LayoutEstimator(jnp.asarray(prior), Setting(rows=rows, reduction=reduction)), [view])
    np.testing.assert_allclose(state.gap, np.tanh(expected), rtol=1e-4)


def test_shut_gate_leaves_the_belief_and_decays_the_gap():
    alpha = prior_from_counts(random_counts())
    state = belief(alpha, views_of({0, 1})[0], 0.5)
    estimator = LayoutEstimator(alpha)
    for visible in ((), {3}, {0, 1}):
        after = estimator.update(state, jnp.asarray(views_of(visible)[0]))
        np.testing.assert_array_equal(after.alpha, alpha)
        np.testing.assert_array_equal(after.last, state.last)
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


@pytest.mark.parametrize("name", SETTINGS)
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
        "paper": common | paper,
        "released": common | released | {"decay": 0.8, "passes": 2},
        "calibrated": calibrated,
    }
    for name, fields in expected.items():
        assert fields.items() <= dataclasses.asdict(SETTINGS[name]).items()


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
        assert getattr(Setting(**{field: value}), field) == value
    for value in bad:
        with pytest.raises(ValueError, match=f"{field} is {value}: give a "):
            Setting(**{field: value})


def test_one_category_has_no_prior():
    with pytest.raises(ValueError, match="two or more categories"):
        prior_from_counts(jnp.ones((1, 1)))
    np.testing.assert_allclose(prior_from_counts(jnp.ones((2, 2))), [[0, 20], [20, 0]], rtol=1e-6)


def test_unknown_setting_names_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'calibrated'"):
        LayoutEstimator(jnp.ones((K, K)), "calibratd")
