"""Tests of equations 3 to 6: the layout belief, its expectation, the layout gap and the named estimators."""

import dataclasses

import chex
import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import digamma
from support.numerics import exact_kl

from jaxnav.layout import (
    ESTIMATORS,
    MAX_RELATIVE_WEIGHT,
    EstimatorConfig,
    LayoutEstimator,
    LayoutState,
    prior_from_counts,
    scale_weights,
)

NUM_CATEGORIES = 6
PRESENCE = hnp.arrays(np.bool_, (4, NUM_CATEGORIES))


def make_state(alpha, last_visible=(0,) * NUM_CATEGORIES, gap=0.0) -> LayoutState:
    return LayoutState(jnp.asarray(alpha, jnp.float32), jnp.array(last_visible, bool), jnp.float32(gap))


def random_counts(seed: int = 0, size: int = NUM_CATEGORIES) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).integers(1, 200, (size, size)))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_prior_rows_have_their_strength_and_a_lower_bound(name):
    counts = random_counts()
    alpha = np.asarray(prior_from_counts(counts, name))

    # No category is its own companion, and every pair has some weight.
    is_off_diagonal = ~np.eye(NUM_CATEGORIES, dtype=bool)
    assert (np.diag(alpha) == 0).all()
    assert (alpha[is_off_diagonal] >= 0.01).all()

    # Without a strength the prior is the counts, else 20 ((1 - 0.05) n_ij / n_i + 0.05 / (K - 1)).
    pair_counts = np.where(is_off_diagonal, counts, 0)
    if ESTIMATORS[name].strength is None:
        np.testing.assert_array_equal(alpha, pair_counts)
    else:
        row_shares = pair_counts / pair_counts.sum(-1, keepdims=True)
        expected_alpha = 20 * (0.95 * row_shares + 0.05 / (NUM_CATEGORIES - 1))
        np.testing.assert_allclose(alpha[is_off_diagonal], expected_alpha[is_off_diagonal], rtol=1e-5)
        np.testing.assert_allclose(alpha.sum(-1), 20, rtol=1e-5)


def test_prior_rows_of_unseen_categories_are_uniform():
    counts = jnp.zeros((NUM_CATEGORIES, NUM_CATEGORIES)).at[0, 1].set(1e6)
    alpha = np.asarray(prior_from_counts(counts, EstimatorConfig(strength=10.0, uniform=0.0)))
    np.testing.assert_allclose(alpha[0], [0, 10, 0.01, 0.01, 0.01, 0.01])
    np.testing.assert_allclose(alpha[1], [2, 0, 2, 2, 2, 2], rtol=1e-6)


@pytest.mark.slow
def test_calibrated_update_follows_worked_arithmetic():
    """S = 20, uniform prior, K = 22, V = 3: every entry is 20 / 21, and each visible row gains two counts of 1.

    KL = 2 g(20/21, 1) - g(20, 2) with g(a, 1) = psi(a + 1) - log a and g(20, 2) = 2 psi(22) - log 20 - log 21
       = 2 * (0.3913 + 0.0488) - (2 * 3.0681 - 2.9957 - 3.0445) = 0.7842, so D = tanh(0.7842) = 0.6552.
    """
    estimator = LayoutEstimator(prior_from_counts(jnp.ones((22, 22))))
    presence = jnp.zeros(22, bool).at[jnp.array([1, 4, 9])].set(True)
    state = estimator.update(estimator.init(), presence)

    # The gap is the tanh of the divergence, which the docstring works out to four digits.
    alpha = 20 / 21
    divergence = 2 * (digamma(alpha + 1) - np.log(alpha)) - (2 * digamma(22) - np.log(20) - np.log(21))
    assert abs(divergence - 0.7842) < 1e-3
    np.testing.assert_allclose(state.gap, np.tanh(divergence), rtol=1e-4)

    # Only the visible rows and columns gain counts, except on the diagonal.
    alpha_gain = np.asarray(state.alpha - estimator.prior)
    visible = np.asarray(presence, np.float32)
    np.testing.assert_allclose(alpha_gain, np.outer(visible, visible) - np.diag(visible), atol=1e-6)


def run_views(estimator: LayoutEstimator, views) -> list[LayoutState]:
    """State of the estimator after each view."""
    jitted_update = jax.jit(type(estimator).update)
    states = [estimator.init()]
    for view in views:
        states.append(jitted_update(estimator, states[-1], jnp.asarray(view)))
    return states[1:]


def test_gap_falls_as_evidence_gathers():
    """Views drawn from the prior, S = 20, V = 3: the mean gap is large at first and below 0.5 by step 20."""
    estimator = LayoutEstimator(prior_from_counts(jnp.ones((22, 22))))

    # A home has six categories, and each view shows three of them.
    rng = np.random.default_rng(0)
    home_categories = rng.permutation(22)[:6]
    views = np.zeros((20, 22), bool)
    for view in views:
        view[rng.choice(home_categories, 3, replace=False)] = True

    gaps = [float(state.gap) for state in run_views(estimator, views)]
    assert gaps[0] > 0.6
    assert max(gaps[-5:]) < 0.5
    assert gaps[-1] < gaps[0] / 2


def views_of(*category_sets) -> np.ndarray:
    """Views bool [T, K], each of which shows one set of categories."""
    views = np.zeros((len(category_sets), NUM_CATEGORIES), bool)
    for view, visible_categories in zip(views, category_sets, strict=True):
        view[list(visible_categories)] = True
    return views


@pytest.mark.slow
def test_disabling_the_gap_does_not_change_the_belief():
    # Two estimators differ only in their gap.
    counts = jnp.arange(16.0).reshape(4, 4) + 1.0
    config = ESTIMATORS["calibrated"]
    prior = prior_from_counts(counts, config)
    plain_estimator = LayoutEstimator(prior, config)
    gapless_estimator = LayoutEstimator(prior, dataclasses.replace(config, gap="none"))

    # Their beliefs stay bit-identical from view to view.
    plain_state = plain_estimator.init()
    gapless_state = gapless_estimator.init()
    for view in ([1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 1]):
        plain_state = plain_estimator.update(plain_state, jnp.array(view))
        gapless_state = gapless_estimator.update(gapless_state, jnp.array(view))
        np.testing.assert_array_equal(plain_state.alpha, gapless_state.alpha)
        np.testing.assert_array_equal(plain_state.last_visible, gapless_state.last_visible)
        assert plain_state.gap > 0.0
        assert gapless_state.gap == 0.0


def test_released_gap_saturates_and_decays():
    """The divergence saturates: a new view of two or more categories gives 0.8, and each other step 0.64 of the last.

    The view {3} is refused because it shows a single category; the {0, 1, 2} after it equals the last accepted view.
    """
    views = views_of({2}, {0, 1}, {0, 1}, {0, 1}, {0, 1, 2}, {3}, {0, 1, 2}, {0, 2})
    estimator = LayoutEstimator(prior_from_counts(jnp.ones((NUM_CATEGORIES, NUM_CATEGORIES)), "released"), "released")
    gaps = [float(state.gap) for state in run_views(estimator, views)]
    np.testing.assert_allclose(gaps, [0, 0.8, 0.512, 0.32768, 0.8, 0.512, 0.32768, 0.8], rtol=1e-3)


def test_released_counts_its_own_column_in_every_row():
    prior = np.asarray(prior_from_counts(random_counts(), "released"))
    estimator = LayoutEstimator(jnp.asarray(prior), "released")
    (state,) = run_views(estimator, views_of({1, 4}))

    # Every row gains 5 in the visible columns, on the diagonal too.
    view = views_of({1, 4})[0]
    np.testing.assert_allclose(state.alpha, prior + 5 * view[None, :])

    # The gap is the sum of the divergences of all rows, decayed once.
    counts = 5 * np.ones((NUM_CATEGORIES, 1), int) * view
    row_divergences = exact_kl(prior + np.eye(NUM_CATEGORIES), counts)
    np.testing.assert_allclose(state.gap, np.tanh(row_divergences.sum()) * 0.8, rtol=1e-4)

    # The expectation adds 1 on the diagonal, which already has a share of its row.
    row_shares = np.asarray(state.alpha) / np.asarray(state.alpha).sum(-1, keepdims=True)
    np.testing.assert_allclose(estimator.expectation(state), row_shares + np.eye(NUM_CATEGORIES), rtol=1e-6)


def off_diagonal_divergences(alpha, counts) -> np.ndarray:
    """Exact divergence of each row [K] by counts int [K, K], without the entries of the diagonal."""
    row_divergences = []
    for row in range(NUM_CATEGORIES):
        row_divergences.append(exact_kl(np.delete(alpha[row], row), np.delete(counts[row], row)))
    return np.array(row_divergences)


def test_paper_setting_follows_equation_5():
    """All rows, mean over K, no gate: a view of a single category and a repeated view count as well."""
    views = np.array([[0, 1, 0, 0, 0, 0], [0, 3, 0, 0, 1, 0], [0, 3, 0, 0, 1, 0], [0] * 6, [12, 0, 1, 0, 0, 2]])
    prior = np.asarray(prior_from_counts(random_counts(3), "paper"))
    states = run_views(LayoutEstimator(jnp.asarray(prior), "paper"), views)
    alpha = prior
    for view, state in zip(views, states, strict=True):
        # Row i counts the view without category i: n_{-i}.
        counts = np.where(np.eye(NUM_CATEGORIES, dtype=bool), 0, view[None, :])
        row_divergences = off_diagonal_divergences(alpha, counts)
        np.testing.assert_allclose(state.gap, np.tanh(row_divergences.mean()), rtol=1e-3, atol=1e-7)
        alpha = alpha + counts
        np.testing.assert_allclose(state.alpha, alpha)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_only_estimators_of_instances_read_more_than_presence(name):
    estimator = LayoutEstimator(prior_from_counts(random_counts(4), name), name)
    instances = np.array([[2, 1, 0, 0, 5, 0], [0, 0, 3, 1, 0, 0]], np.uint8)
    states = run_views(estimator, instances)
    presence_states = run_views(estimator, instances > 0)
    for state, presence_state in zip(states, presence_states, strict=True):
        is_equal = np.array_equal(state.alpha, presence_state.alpha) and state.gap == presence_state.gap
        assert is_equal == (ESTIMATORS[name].counts == "presence")


@pytest.mark.parametrize("name", ["released", "calibrated"])
def test_instance_counts_of_one_equal_presence(name):
    """Both estimators together use every kind of rows, reduction, increment and own column.

    Instance counts and presence compute the divergences in two different ways.
    """
    prior = prior_from_counts(random_counts(8), name)
    views = np.random.default_rng(2).random((12, NUM_CATEGORIES)) < 0.4
    counting_config = dataclasses.replace(ESTIMATORS[name], counts="instances")
    counting_states = run_views(LayoutEstimator(prior, counting_config), views)
    presence_states = run_views(LayoutEstimator(prior, name), views)
    for state, presence_state in zip(counting_states, presence_states, strict=True):
        np.testing.assert_array_equal(state.alpha, presence_state.alpha)
        np.testing.assert_allclose(state.gap, presence_state.gap, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("rows", "reduction"), [("all", "mean_visible"), ("visible", "sum"), ("visible", "mean")])
def test_rows_and_reduction_select_the_divergences(rows, reduction):
    prior = np.asarray(prior_from_counts(random_counts(5), EstimatorConfig()))
    (view,) = views_of({0, 2, 3})

    # Counts of the rows that learn, and the exact divergence of each row.
    updated_rows = view if rows == "visible" else np.ones(NUM_CATEGORIES, bool)
    counts = np.outer(updated_rows, view) & ~np.eye(NUM_CATEGORIES, dtype=bool)
    row_divergences = off_diagonal_divergences(prior, counts.astype(int))
    expected = {
        "mean_visible": row_divergences[view].mean(),
        "sum": row_divergences.sum(),
        "mean": row_divergences.mean(),
    }[reduction]

    (state,) = run_views(LayoutEstimator(jnp.asarray(prior), EstimatorConfig(rows=rows, reduction=reduction)), [view])
    np.testing.assert_allclose(state.gap, np.tanh(expected), rtol=1e-4)


def test_mean_visible_of_a_single_category_is_its_own_divergence():
    """With its own column, the row of a category learns from a view that shows only this category."""
    config = EstimatorConfig(reduction="mean_visible", own_column=True, gate=False)
    prior = np.asarray(prior_from_counts(random_counts(6), config))
    (view,) = views_of({1})
    (state,) = run_views(LayoutEstimator(jnp.asarray(prior), config), [view])
    divergence = exact_kl(prior[1] + np.eye(NUM_CATEGORIES)[1], view.astype(int))
    np.testing.assert_allclose(state.gap, np.tanh(divergence), rtol=1e-4)


@pytest.mark.slow
def test_closed_gate_keeps_the_belief_and_decays_the_gap():
    alpha = prior_from_counts(random_counts())
    state = make_state(alpha, views_of({0, 1})[0], 0.5)
    estimator = LayoutEstimator(alpha)

    # Nothing, a single category and a repeated view leave the gate closed: the gap decays from 0.5 to 0.4.
    for view in views_of((), {3}, {0, 1}):
        next_state = estimator.update(state, jnp.asarray(view))
        np.testing.assert_array_equal(next_state.alpha, alpha)
        np.testing.assert_array_equal(next_state.last_visible, state.last_visible)
        np.testing.assert_allclose(next_state.gap, 0.4)

    # Negative control: a new view opens the gate.
    (new_view,) = views_of({0, 2})
    next_state = estimator.update(state, jnp.asarray(new_view))
    assert float(next_state.alpha.sum()) > float(alpha.sum()) + 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "calibrated"])
@given(PRESENCE)
def test_expectation_is_normalized_and_paper_belief_ignores_order(name, views):
    estimator = LayoutEstimator(prior_from_counts(random_counts(), name), name)
    states = run_views(estimator, views)
    expectation = np.asarray(estimator.expectation(states[-1]))
    np.testing.assert_array_equal(np.diag(expectation), 1)
    np.testing.assert_allclose(expectation.sum(-1), 2, rtol=1e-5)  # off the diagonal rows sum to 1
    for goal in (0, NUM_CATEGORIES - 1):
        np.testing.assert_allclose(estimator.goal_weights(states[-1], goal), expectation[:, goal], rtol=1e-6)
    assert (np.diag(states[-1].alpha) == 0).all()
    assert all(0 <= float(state.gap) <= 1 for state in states)
    if name == "paper":  # without a gate the posterior does not depend on the order of the views
        np.testing.assert_allclose(run_views(estimator, views[::-1])[-1].alpha, states[-1].alpha, rtol=1e-6)


def test_goal_weights_are_the_column_not_the_row():
    """Negative control: with an asymmetric prior the row w[goal, :] is another vector."""
    estimator = LayoutEstimator(prior_from_counts(random_counts()))
    expectation = estimator.expectation(estimator.init())
    goal_weights = estimator.goal_weights(estimator.init(), 2)
    assert np.abs(goal_weights - expectation[2]).max() > 0.05
    assert float(goal_weights[2]) == 1


def take_episode(states: LayoutState, episode: int) -> LayoutState:
    """State of one episode of a batch."""
    return jax.tree.map(lambda leaf: leaf[episode], states)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_vmapped_update_equals_single_updates_and_traces_once(name):
    priors = jnp.stack([prior_from_counts(random_counts(seed), name) for seed in range(3)])
    views = jax.random.bernoulli(jax.random.key(1), 0.5, (3, 5, NUM_CATEGORIES))
    traces = []

    @jax.jit
    @jax.vmap
    def step(prior, state, view):
        traces.append(1)
        return LayoutEstimator(prior, name).update(state, view)

    # Three episodes of five views at once; presence may also be given as floats.
    states = jax.vmap(lambda prior: LayoutEstimator(prior, name).init())(priors)
    for time_index in range(5):
        states = step(priors, states, views[:, time_index].astype(jnp.float32))
    assert len(traces) == 1

    # Every episode ends in the state of an estimator that runs this episode only.
    for episode in range(3):
        single_state = run_views(LayoutEstimator(priors[episode], name), np.asarray(views[episode]))[-1]
        chex.assert_trees_all_close(take_episode(states, episode), single_state, rtol=1e-5, atol=1e-6)


def test_named_estimators_have_the_documented_settings():
    common_fields = {"strength": None, "uniform": 0.0, "rows": "all"}
    paper_fields = {"reduction": "mean", "increment": 1, "own_column": False, "gate": False, "form": "paper"}
    paper_fields |= {"counts": "instances"}
    released_fields = {"reduction": "sum", "increment": 5, "own_column": True, "gate": True, "form": "residual"}
    calibrated_fields = {"rows": "visible", "reduction": "mean_visible", "increment": 1, "own_column": False}
    calibrated_fields |= {"gate": True, "decay": 0.8, "passes": 1, "strength": 20.0, "uniform": 0.05}
    calibrated_fields |= {"form": "residual", "counts": "presence"}
    expected_fields = {
        "paper": common_fields | paper_fields | {"gap": "novelty"},
        "released": common_fields | released_fields | {"gap": "novelty", "decay": 0.8, "passes": 2},
        "calibrated": calibrated_fields | {"gap": "novelty"},
        "evidence": calibrated_fields | {"gap": "evidence"},
    }
    assert expected_fields.keys() == ESTIMATORS.keys()
    for name, fields in expected_fields.items():
        assert fields.items() <= dataclasses.asdict(ESTIMATORS[name]).items()


@pytest.mark.parametrize(
    ("field", "valid_values", "invalid_values"),
    [
        ("increment", (1, 50), (0, 51, 1.5, 5.0)),
        ("decay", (0.0, 1.0), (-0.1, 1.1, float("nan"))),
        ("passes", (1, 3), (0, 1.5)),
        ("strength", (0.1, None), (0.0, -1.0, float("inf"))),
        ("uniform", (0.0, 1.0), (-0.1, 1.1)),
    ],
)
def test_estimator_config_refuses_values_out_of_range(field, valid_values, invalid_values):
    for value in valid_values:
        assert getattr(EstimatorConfig(**{field: value}), field) == value
    for value in invalid_values:
        with pytest.raises(ValueError, match=rf"{field} .*{value}"):
            EstimatorConfig(**{field: value})


def test_several_passes_need_the_gate():
    # Later passes only let a gap decay behind the shut gate. Without a gate, they would count the view again.
    with pytest.raises(ValueError, match="passes is 2: give 1"):
        EstimatorConfig(passes=2, gate=False)


def test_prior_needs_two_categories():
    with pytest.raises(ValueError, match="categories"):
        prior_from_counts(jnp.ones((1, 1)))
    np.testing.assert_allclose(prior_from_counts(jnp.ones((2, 2))), [[0, 20], [20, 0]], rtol=1e-6)


def test_unknown_estimator_is_refused_with_the_nearest_name():
    with pytest.raises(ValueError, match="calibrated"):
        LayoutEstimator(jnp.ones((NUM_CATEGORIES, NUM_CATEGORIES)), "calibratd")


# Relative weights


def test_relative_weights_follow_worked_arithmetic():
    """Goal 1 of four: the mean off the goal is (.01 + .02 + .06) / 3 = .03, so the weights are 1/3, 2/3 and 2."""
    raw_weights = jnp.array([[0.01, 1.0, 0.02, 0.06], [0.01, 1.0, 0.02, 0.06]])
    relative_weights = scale_weights(raw_weights, jnp.array([1, 1]))
    np.testing.assert_allclose(relative_weights, [[1 / 3, 1.0, 2 / 3, 2.0]] * 2, rtol=1e-6)


def test_relative_weights_are_bounded_off_the_goal_and_keep_the_goal_weight():
    """One companion of eight has all the weight, 7 times the mean, and reaches the bound.

    The weight of the goal stays, even if it is above 1 as in the released code.
    """
    raw_weights = jnp.array([1.3, 0.7, *[0.0] * 6])
    relative_weights = scale_weights(raw_weights, jnp.int32(0))
    np.testing.assert_allclose(relative_weights, [1.3, MAX_RELATIVE_WEIGHT, *[0.0] * 6], rtol=1e-6)


@given(hnp.arrays(np.float32, (NUM_CATEGORIES,), elements=st.floats(0.03125, 0.0625, width=32)), st.floats(0.1, 10))
def test_relative_weights_have_mean_one_and_ignore_a_common_factor(raw_weights, factor):
    """A bound of 4 is out of reach: the largest entry is at most .0625 / .03125 = 2 times the mean."""
    relative_weights = np.asarray(scale_weights(jnp.asarray(raw_weights), jnp.int32(2)))
    off_goal = np.arange(NUM_CATEGORIES) != 2
    np.testing.assert_allclose(relative_weights[off_goal].mean(), 1.0, rtol=1e-5)
    assert relative_weights[2] == raw_weights[2]
    scaled_weights = scale_weights(jnp.asarray(raw_weights * np.float32(factor)), jnp.int32(2))
    np.testing.assert_allclose(np.asarray(scaled_weights)[off_goal], relative_weights[off_goal], rtol=1e-5)


@pytest.mark.slow
def test_relative_weights_of_a_disabled_layout_are_ones_to_the_bit():
    for num_categories in (2, 3, 15, 22):
        ones = jnp.ones(num_categories)
        np.testing.assert_array_equal(scale_weights(ones, jnp.int32(1)), ones)
