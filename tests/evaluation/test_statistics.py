"""Intervals follow closed forms and the analysis of variance, and have their coverage in simulation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t, trim_mean
from support.intervals import bounds
from support.simulated_results import SIZES, coverage, episode_bootstrap, jackknifed

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import (
    Interval,
    interquartile_mean,
    jackknife_interval,
    leave_one_out,
    mean_interval,
    paired_difference,
    probability_of_improvement,
    run_clusters,
    scene_clusters,
)


def half_width(interval: Interval) -> float:
    assert interval.high - interval.mean == pytest.approx(interval.mean - interval.low)
    return interval.high - interval.mean


def scenes_of(num_scenes: int, episodes_per_scene: int = 1):
    return leave_one_out(np.repeat(np.arange(num_scenes), episodes_per_scene))


# Leave-one-out weights


def test_left_out_clusters_give_their_weight_to_their_stratum():
    # Stratum 0 holds clusters a (2 items) and b (1 item), stratum 1 holds c and d. Without a, b has the weight of 3.
    clusters = leave_one_out(np.array(list("aabcd")), np.array([0, 0, 0, 1, 1]))
    expected = {"a": [0, 0, 3, 1, 1], "b": [1.5, 1.5, 0, 1, 1], "c": [1, 1, 1, 0, 2], "d": [1, 1, 1, 2, 0]}
    np.testing.assert_allclose(clusters.weights, np.array([[1] * 5, *expected.values()]).T)
    np.testing.assert_allclose(clusters.scale, 1 / 2)  # two clusters in each stratum
    assert clusters.degrees_of_freedom == 4 - 2


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), min_size=2, max_size=20))
def test_leave_one_out_keeps_the_weight_of_strata(pairs):
    label, stratum = np.array(pairs).T
    clusters = leave_one_out(10 * stratum + label, stratum)
    for number in np.unique(stratum):
        in_stratum = stratum == number
        if len(set(label[in_stratum])) > 1:
            np.testing.assert_allclose(clusters.weights[in_stratum].sum(axis=0), in_stratum.sum())


def test_room_type_of_one_floor_plan_joins_the_other_strata():
    floor_plans = np.array(list("aabbcc"))
    rooms = np.array([0, 0, 0, 0, 1, 1])
    assert scene_clusters(floor_plans, rooms).degrees_of_freedom == 3 - 1
    assert scene_clusters(floor_plans, np.array([0, 0, 0, 0, 0, 0])).degrees_of_freedom == 3 - 1
    # Negative control: two room types with two floor plans each remain two strata.
    assert scene_clusters(np.array(list("aabbcd")), rooms).degrees_of_freedom == 4 - 2


# Closed forms


def test_scene_means_have_students_interval():
    # Five scenes of one episode: mean 3, variance of the mean 2.5 / 5 = 0.5, 4 degrees of freedom.
    interval = mean_interval(np.array([[1.0, 2, 3, 4, 5]]), scenes_of(5), trained=False)
    assert interval.mean == 3
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 4) * math.sqrt(0.5))


def test_interval_counts_the_episodes_of_a_scene_as_one():
    # Twenty equal episodes in each scene are no more evidence than one. As independent episodes they would give a
    # half-width of 1.98 x sqrt(2.02 / 100) = 0.28 in place of 2.78 x sqrt(0.5) = 1.96.
    values = np.repeat([[1.0, 2, 3, 4, 5]], 20, axis=1)
    clustered_interval = mean_interval(values, scenes_of(5, 20), trained=False)
    assert half_width(clustered_interval) == pytest.approx(t.ppf(0.975, 4) * math.sqrt(0.5))
    independent_interval = mean_interval(values, scenes_of(100), trained=False)
    assert half_width(independent_interval) == pytest.approx(t.ppf(0.975, 99) * math.sqrt(200 / 99 / 100))


def test_strata_remove_the_variance_between_room_types():
    # Room types have scene means 0, 1 and 10, 11. The mean of each type has the variance 0.5 / 2, and the mean of both
    # types has (0.25 + 0.25) / 4 = 0.125.
    values = np.array([[0.0, 1, 10, 11]])
    rooms = np.array([0, 0, 1, 1])
    stratified_interval = mean_interval(values, scene_clusters(np.arange(4), rooms), trained=False)
    assert half_width(stratified_interval) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(0.125))
    plain_interval = mean_interval(values, scenes_of(4), trained=False)
    assert half_width(plain_interval) > 3 * half_width(stratified_interval)


def test_seed_means_have_students_interval():
    # All scenes are equal. Seed means 1, 2 and 6 have mean 3 and variance 7, so the mean has the variance 7 / 3 with 2
    # degrees of freedom.
    values = np.repeat([[1.0], [2.0], [6.0]], 12, axis=1)
    interval = mean_interval(values, scenes_of(12))
    assert (interval.mean, interval.seeds) == (pytest.approx(3), pytest.approx((1, 2, 6)))
    assert interval.std == pytest.approx(math.sqrt(7))
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(7 / 3))


def analyse_variance(values: np.ndarray) -> tuple[float, float]:
    """Return the variance of the mean and its degrees of freedom.

    The mean squares A of runs, B of scenes and AB of the residuals give the variance (A + B - AB) / (S C).

    Args:
      values: [S, C], a result of each run in each scene.
    """
    num_runs, num_scenes = values.shape
    run_means = values.mean(axis=1)
    scene_means = values.mean(axis=0)
    residuals = values - run_means[:, None] - scene_means + values.mean()

    # Mean squares of runs, scenes and residuals, and their degrees of freedom.
    degrees = np.array([num_runs - 1, num_scenes - 1, (num_runs - 1) * (num_scenes - 1)])
    mean_squares = np.array(
        [
            num_scenes * run_means.var(ddof=1),
            num_runs * scene_means.var(ddof=1),
            (residuals**2).sum() / degrees[2],
        ]
    )

    # Variance of the mean, with degrees of freedom by Satterthwaite.
    total = (mean_squares * [1, 1, -1]).sum()
    return total / values.size, total**2 / (mean_squares**2 / degrees).sum()


@pytest.mark.parametrize("seed", range(5))
def test_mean_interval_follows_the_analysis_of_variance(seed):
    generator = np.random.default_rng(seed)
    values = generator.normal(size=(4, 1)) + generator.normal(size=(1, 9)) + 0.5 * generator.normal(size=(4, 9))
    variance, degrees = analyse_variance(values)
    assert half_width(mean_interval(values, scenes_of(9))) == pytest.approx(t.ppf(0.975, degrees) * math.sqrt(variance))


def test_mean_variance_is_at_least_that_of_scenes_or_runs():
    # The scenes are -1 and +1 in seed 0, and +1 and -1 in seed 1. Neither scene means nor seed means differ, and
    # subtracting the mean square of the residuals would give a negative variance.
    interval = mean_interval(np.array([[-1.0, 1, 0], [1, -1, 0]]), scenes_of(3))
    assert (interval.low, interval.high) == pytest.approx((0, 0))


# Differences


def test_paired_difference_of_fixed_policies_averages_their_runs():
    # The runs gain 1 to 5 and 101 to 105 in five scenes, 51 to 55 on average. As in the first closed form above, the
    # variance over scenes is 2.5 / 5. For fixed policies the difference between the two runs does not count.
    gains = np.array([[1.0, 2, 3, 4, 5], [101.0, 102, 103, 104, 105]])
    reference = np.full((2, 5), 7.0)
    interval = paired_difference(reference, reference + gains, scenes_of(5), trained=False)
    assert interval.mean == pytest.approx(53)
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 4) * math.sqrt(0.5))
    assert half_width(paired_difference(reference, reference + gains, scenes_of(5))) > 100


def test_paired_difference_cancels_scene_effects():
    # Scenes differ by up to 10; the second variant gains exactly 1 in each.
    values = np.array([[0.0, 3, 10, 4], [1, 2, 9, 5]])
    gain = paired_difference(values, values + 1, scenes_of(4), same_runs=True)
    assert bounds(gain) == pytest.approx((1, 1, 1))
    assert gain.std == pytest.approx(0)
    assert gain.seeds == pytest.approx((1, 1))


def test_difference_of_separate_runs_adds_their_variances():
    # All scenes are equal. Seed means 0, 2 and 1, 5 have the variances 2 / 2 and 8 / 2, whose sum has 2 degrees of
    # freedom.
    reference = np.repeat([[0.0], [2.0]], 6, axis=1)
    compared = np.repeat([[1.0], [5.0]], 6, axis=1)
    gain = paired_difference(reference, compared, scenes_of(6))
    assert gain.mean == pytest.approx(2)
    assert gain.std == pytest.approx(math.sqrt(2 + 8))
    assert gain.seeds == ()
    assert half_width(gain) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(2 / 2 + 8 / 2))
    # As equal runs, the gains are 1 and 3: variance 2 / 2, with 1 degree of freedom.
    same_run_gain = paired_difference(reference, compared, scenes_of(6), same_runs=True)
    assert half_width(same_run_gain) == pytest.approx(t.ppf(0.975, 1) * math.sqrt(2 / 2))


def test_difference_of_separate_runs_allows_different_numbers_of_runs():
    # All scenes are equal. Run means 0, 2 and 1, 5, 9 have means 1 and 5 and variances 2 / 2 and 16 / 3. The degrees of
    # freedom are those of Welch: (1 + 16/3)^2 / (1^2 / 1 + (16/3)^2 / 2) = (361/9) / (137/9) = 361/137.
    reference = np.repeat([[0.0], [2.0]], 6, axis=1)
    compared = np.repeat([[1.0], [5.0], [9.0]], 6, axis=1)
    gain = paired_difference(reference, compared, scenes_of(6))
    assert gain.mean == pytest.approx(4)
    assert gain.std == pytest.approx(math.sqrt(2 + 16))
    assert half_width(gain) == pytest.approx(t.ppf(0.975, 361 / 137) * math.sqrt(2 / 2 + 16 / 3))

    # A single run on one side shows no variance.
    assert not paired_difference(reference[:1], compared, scenes_of(6)).has_bounds

    # Results that are equal in all runs have no variance at all.
    assert half_width(paired_difference(0 * reference, 0 * compared, scenes_of(6))) == 0

    # Equal runs and fixed policies are paired run by run, so their numbers must be equal.
    for options in ({"same_runs": True}, {"trained": False}):
        with pytest.raises(InputError, match="shape"):
            paired_difference(reference, compared, scenes_of(6), **options)


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=24, max_size=24), st.booleans())
def test_swapping_arms_negates_the_difference(outcomes, same_runs):
    reference = np.reshape(outcomes, (2, 12))
    compared = reference[::-1]
    scenes = leave_one_out(np.arange(12) % 4)
    forward = paired_difference(reference, compared, scenes, same_runs=same_runs)
    backward = paired_difference(compared, reference, scenes, same_runs=same_runs)
    assert bounds(backward) == pytest.approx((-forward.mean, -forward.high, -forward.low))


@settings(max_examples=30)
@given(st.lists(st.integers(-50, 50), min_size=24, max_size=24), st.floats(0.1, 100), st.floats(-10, 10))
def test_mean_interval_scales_and_shifts_with_its_values(cells, scale, shift):
    values = np.reshape(cells, (3, 8)) / 10
    scenes = scenes_of(8)
    interval = mean_interval(values, scenes)
    result = mean_interval(values * scale + shift, scenes)
    expected = [scale * bound + shift for bound in bounds(interval)]
    assert bounds(result) == pytest.approx(expected, abs=1e-9)
    assert result.std == pytest.approx(interval.std * scale, abs=1e-9)


# Intervals without bounds


@pytest.mark.parametrize(
    ("num_runs", "num_scenes", "has_bounds"), [(2, 3, True), (2, 2, False), (1, 20, False), (3, 1, False)]
)
def test_mean_interval_needs_enough_scenes_and_runs(num_runs, num_scenes, has_bounds):
    values = np.random.default_rng(0).random((num_runs, 2 * num_scenes))
    interval = mean_interval(values, scenes_of(num_scenes, 2))
    assert interval.mean == pytest.approx(values.mean())
    assert interval.has_bounds == has_bounds
    assert math.isnan(interval.std) == (num_runs == 1)


def test_jackknife_with_an_undefined_replicate_has_no_bounds():
    replicates = np.array([0.5, math.nan, 0.4, 0.6])
    assert not jackknife_interval(replicates, scenes_of(3)).has_bounds
    assert jackknife_interval(np.array([0.5, 0.5, 0.4, 0.6]), scenes_of(3)).has_bounds


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.array([[0.0, np.nan]]), "NaN"),
        (np.array([[0.0, np.inf]]), "infinite"),
        (np.zeros(2), r"\[runs, episodes\]"),
        (np.zeros((0, 2)), "one"),
        (np.zeros((3, 4)), "4 episodes.*2"),
    ],
)
def test_intervals_refuse_bad_values(values, message):
    with pytest.raises(InputError, match=message):
        mean_interval(values, scenes_of(2))
    with pytest.raises(InputError, match=message):
        paired_difference(values, values, scenes_of(2))


@pytest.mark.parametrize("same_runs", [False, True])
def test_paired_difference_refuses_unequal_episodes(same_runs):
    with pytest.raises(InputError, match="3 episodes"):
        paired_difference(np.zeros((2, 4)), np.zeros((2, 3)), scenes_of(4), same_runs=same_runs)


# Coverage


@pytest.mark.parametrize("size", SIZES)
def test_jackknife_interval_has_its_nominal_coverage(size):
    # 95 % of 300 draws are 285 +- 3.8; 90 % are 270, four standard errors below.
    assert coverage(jackknifed, size, draws=300) >= 0.90


@pytest.mark.slow
def test_episode_bootstrap_has_too_low_coverage():
    assert coverage(episode_bootstrap, (20, 3), draws=60) < 0.85


def test_run_clusters_leave_runs_out_within_their_arm():
    runs = run_clusters(3, 3)
    assert runs.degrees_of_freedom == 4
    np.testing.assert_allclose(runs.weights[:, 1], [0, 1.5, 1.5, 1, 1, 1])


# Statistics of runs and floor plans


def test_interquartile_mean_is_the_mean_of_the_middle_half():
    # Of 0, 1, ..., 7 the middle half is 2, 3, 4 and 5, however large the greatest value is.
    for max_value in (7.0, 1000.0):
        values = np.array([[0.0, 1, 2, 3, 4, 5, 6, max_value]])
        assert interquartile_mean(values, scenes_of(8), trained=False).mean == pytest.approx(3.5)
    # Of five values, the quartiles divide the second and the fourth: (0.75 * 2 + 3 + 0.75 * 9) / 2.5 = 4.5.
    assert interquartile_mean(np.array([[9.0, 1, 2, 3, 50]]), scenes_of(5), trained=False).mean == pytest.approx(4.5)


def test_interquartile_mean_pools_runs_and_floor_plans():
    # Each plan has two episodes. The plan means are 0, 1, 2, 3 in one run and 4, 5, 6, 7 in the other run, so the
    # middle half is 2 to 5.
    plan_means = np.array([[0.0, 1, 2, 3], [4, 5, 6, 7]])
    values = np.repeat(plan_means, 2, axis=1) + np.array([[-0.25, 0.25] * 4] * 2)
    interval = interquartile_mean(values, scenes_of(4, 2))
    assert interval.mean == pytest.approx(3.5)
    assert interval.low < 3.5 < interval.high


@given(st.lists(st.integers(-50, 50), min_size=8, max_size=8))
def test_interquartile_mean_equals_scipys_trimmed_mean(values):
    interval = interquartile_mean(np.array([values], float), scenes_of(8), trained=False)
    assert interval.mean == pytest.approx(trim_mean(values, 0.25))


def test_probability_of_improvement_counts_pairs_of_runs():
    # Three of the four pairs of runs improve, 2 > 1, 4 > 1 and 4 > 3; one does not, 2 < 3.
    reference = np.repeat([[1.0], [3]], 4, axis=1)
    compared = np.repeat([[2.0], [4]], 4, axis=1)
    assert probability_of_improvement(reference, compared, scenes_of(4)).mean == pytest.approx(3 / 4)
    # Equal runs are compared run by run: 2 > 1 and 4 > 3.
    assert probability_of_improvement(reference, compared, scenes_of(4), same_runs=True).mean == pytest.approx(1.0)


def test_probability_of_improvement_weighs_plans_equally_and_ties_by_half():
    # Much better on one plan, slightly worse on two plans, equal on the last plan: (1 + 0 + 0 + 0.5) / 4.
    reference = np.array([[0.0, 1, 1, 1]])
    compared = np.array([[100.0, 0.9, 0.9, 1]])
    interval = probability_of_improvement(reference, compared, scenes_of(4), trained=False)
    assert interval.mean == pytest.approx(1.5 / 4)
    # The mean of the values 1, 0, 0 and 0.5 of four plans has the variance 0.2292 / 4, with 3 degrees of freedom.
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 3) * math.sqrt(np.var([1, 0, 0, 0.5], ddof=1) / 4))


@given(st.integers(0, 2**32 - 1))
def test_probabilities_of_improvement_in_both_directions_add_up_to_one(seed):
    rng = np.random.default_rng(seed)
    reference, compared = rng.integers(0, 3, (2, 3, 12)).astype(float)
    scenes = leave_one_out(np.repeat(np.arange(4), 3))
    forward = probability_of_improvement(reference, compared, scenes)
    backward = probability_of_improvement(compared, reference, scenes)
    assert forward.mean + backward.mean == pytest.approx(1.0)
    assert forward.low == pytest.approx(1.0 - backward.high)


def test_interquartile_mean_and_improvement_of_one_scene_or_run_have_no_bounds():
    values = np.ones((1, 6))
    for scenes in (scenes_of(1, 6), scenes_of(6)):
        assert not interquartile_mean(values, scenes).has_bounds
        assert not probability_of_improvement(values, values, scenes).has_bounds
        assert probability_of_improvement(values, values, scenes).mean == pytest.approx(0.5)
