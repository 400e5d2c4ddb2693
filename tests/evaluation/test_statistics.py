"""Intervals: closed forms, the analysis of variance, coverage in simulation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t, trim_mean
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


def scenes_of(count: int, episodes: int = 1):
    return leave_one_out(np.repeat(np.arange(count), episodes))


# What is left out


def test_left_out_clusters_give_their_weight_to_their_stratum():
    # Stratum 0 holds clusters a (2 items) and b (1), stratum 1 holds c and d. Without a, b alone has the weight of 3.
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
        inside = stratum == number
        if len(set(label[inside])) > 1:
            np.testing.assert_allclose(clusters.weights[inside].sum(axis=0), inside.sum())


def test_room_type_of_one_floor_plan_joins_the_other_strata():
    plans, rooms = np.array(list("aabbcc")), np.array([0, 0, 0, 0, 1, 1])
    assert scene_clusters(plans, rooms).degrees_of_freedom == 3 - 1
    assert scene_clusters(plans, np.array([0, 0, 0, 0, 0, 0])).degrees_of_freedom == 3 - 1
    # Negative control: two floor plans of each type stay apart.
    assert scene_clusters(np.array(list("aabbcd")), rooms).degrees_of_freedom == 4 - 2


# Closed forms


def test_scene_means_have_students_interval():
    # Five scenes of one episode: mean 3, variance of the mean 2.5 / 5 = 0.5, 4 degrees of freedom.
    interval = mean_interval(np.array([[1.0, 2, 3, 4, 5]]), scenes_of(5), trained=False)
    assert interval.mean == 3
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 4) * math.sqrt(0.5))


def test_interval_counts_the_episodes_of_a_scene_as_one():
    # Twenty episodes in each scene, all alike, say no more than one. Treated as independent they would give a fifth.
    values = np.repeat([[1.0, 2, 3, 4, 5]], 20, axis=1)
    clustered_interval = mean_interval(values, scenes_of(5, 20), trained=False)
    assert half_width(clustered_interval) == pytest.approx(t.ppf(0.975, 4) * math.sqrt(0.5))
    independent_interval = mean_interval(values, scenes_of(100), trained=False)
    assert half_width(independent_interval) < 0.4 * half_width(clustered_interval)


def test_strata_remove_the_variance_between_room_types():
    # Types with scenes 0, 1 and 10, 11: the variance of each type's mean is 0.5 / 2, of the whole (0.25 + 0.25) / 4.
    values, rooms = np.array([[0.0, 1, 10, 11]]), np.array([0, 0, 1, 1])
    within = mean_interval(values, scene_clusters(np.arange(4), rooms), trained=False)
    assert half_width(within) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(0.125))
    assert half_width(mean_interval(values, scenes_of(4), trained=False)) > 3 * half_width(within)


def test_seed_means_have_students_interval():
    # All scenes alike: seed means 1, 2 and 6 have mean 3 and variance 7, so 7 / 3 with 2 degrees of freedom.
    values = np.repeat([[1.0], [2.0], [6.0]], 12, axis=1)
    interval = mean_interval(values, scenes_of(12))
    assert (interval.mean, interval.seeds) == (pytest.approx(3), pytest.approx((1, 2, 6)))
    assert interval.std == pytest.approx(math.sqrt(7))
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(7 / 3))


def analyse_variance(values: np.ndarray) -> tuple[float, float]:
    """Return variance of the mean and its degrees of freedom.

    One result for each run and scene [S, C]: mean squares of runs, scenes and what is left, (A + B - AB) / (S C).
    """
    runs, scenes = values.shape
    by_run, by_scene = values.mean(axis=1), values.mean(axis=0)
    residuals = values - by_run[:, None] - by_scene + values.mean()
    squares = np.array(
        [
            scenes * by_run.var(ddof=1),
            runs * by_scene.var(ddof=1),
            (residuals**2).sum() / ((runs - 1) * (scenes - 1)),
        ]
    )
    signed = squares * [1, 1, -1]
    degrees = np.array([runs - 1, scenes - 1, (runs - 1) * (scenes - 1)])
    return signed.sum() / values.size, signed.sum() ** 2 / (squares**2 / degrees).sum()


@pytest.mark.parametrize("seed", range(5))
def test_mean_interval_follows_the_analysis_of_variance(seed):
    generator = np.random.default_rng(seed)
    values = generator.normal(size=(4, 1)) + generator.normal(size=(1, 9)) + 0.5 * generator.normal(size=(4, 9))
    variance, degrees = analyse_variance(values)
    assert half_width(mean_interval(values, scenes_of(9))) == pytest.approx(t.ppf(0.975, degrees) * math.sqrt(variance))


def test_mean_variance_is_at_least_that_of_scenes_or_runs():
    # Scenes -1 and +1 in seed 0, +1 and -1 in seed 1: neither scenes nor seeds differ, the rest would be subtracted.
    interval = mean_interval(np.array([[-1.0, 1, 0], [1, -1, 0]]), scenes_of(3))
    assert (interval.low, interval.high) == pytest.approx((0, 0))


# Differences


def test_paired_difference_of_fixed_policies_averages_their_runs():
    # The runs gain 1 to 5 and 101 to 105 in five scenes, 51 to 55 on average. As in the first test above, the variance
    # over scenes is 2.5 / 5; how far the two runs are apart does not matter for these very policies.
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
    assert (gain.mean, gain.low, gain.high) == pytest.approx((1, 1, 1))
    assert gain.std == pytest.approx(0)
    assert gain.seeds == pytest.approx((1, 1))


def test_difference_of_separate_runs_adds_their_variances():
    # Scenes alike; seed means 0, 2 and 1, 5: variances 2 / 2 and 8 / 2 add up, with 2 degrees of freedom.
    first_values, last_values = (np.repeat([[low], [high]], 6, axis=1) for low, high in ((0.0, 2.0), (1.0, 5.0)))
    gain = paired_difference(first_values, last_values, scenes_of(6))
    assert gain.mean == pytest.approx(2)
    assert gain.std == pytest.approx(math.sqrt(2 + 8))
    assert gain.seeds == ()
    assert half_width(gain) == pytest.approx(t.ppf(0.975, 2) * math.sqrt(2 / 2 + 8 / 2))
    # The same networks: gains 1 and 3, variance 2 / 2, 1 degree of freedom.
    same_run_gain = paired_difference(first_values, last_values, scenes_of(6), same_runs=True)
    assert half_width(same_run_gain) == pytest.approx(t.ppf(0.975, 1) * math.sqrt(2 / 2))


def test_difference_of_separate_runs_allows_different_numbers_of_runs():
    # Scenes alike; run means 0, 2 and 1, 5, 9: means 1 and 5, variances 2 / 2 and 16 / 3. Welch's degrees of freedom:
    # (1 + 16/3)^2 / (1^2 / 1 + (16/3)^2 / 2) = (361/9) / (137/9) = 361/137.
    first_values = np.repeat([[0.0], [2.0]], 6, axis=1)
    last_values = np.repeat([[1.0], [5.0], [9.0]], 6, axis=1)
    gain = paired_difference(first_values, last_values, scenes_of(6))
    assert gain.mean == pytest.approx(4)
    assert gain.std == pytest.approx(math.sqrt(2 + 16))
    assert half_width(gain) == pytest.approx(t.ppf(0.975, 361 / 137) * math.sqrt(2 / 2 + 16 / 3))

    # A single run on one side shows no variance.
    assert not paired_difference(first_values[:1], last_values, scenes_of(6)).has_bounds

    # Equal runs on both sides have no variance at all.
    assert half_width(paired_difference(0 * first_values, 0 * last_values, scenes_of(6))) == 0

    # The same networks, or fixed policies, are paired run by run.
    for fixed_settings in ({"same_runs": True}, {"trained": False}):
        with pytest.raises(InputError, match="shape"):
            paired_difference(first_values, last_values, scenes_of(6), **fixed_settings)


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=24, max_size=24), st.booleans())
def test_swapping_arms_negates_the_difference(outcomes, same_runs):
    values = np.reshape(outcomes, (2, 12))
    first_values, last_values, scenes = values, values[::-1], leave_one_out(np.arange(12) % 4)
    forward, backward = (
        paired_difference(*value_pair, scenes, same_runs=same_runs)
        for value_pair in ((first_values, last_values), (last_values, first_values))
    )
    assert (backward.mean, backward.low, backward.high) == pytest.approx((-forward.mean, -forward.high, -forward.low))


@settings(max_examples=30)
@given(st.lists(st.integers(-50, 50), min_size=24, max_size=24), st.floats(0.1, 100), st.floats(-10, 10))
def test_mean_interval_scales_and_shifts_with_its_values(cells, scale, shift):
    values, scenes = np.reshape(cells, (3, 8)) / 10, scenes_of(8)
    before, after = mean_interval(values, scenes), mean_interval(values * scale + shift, scenes)
    expected = [scale * bound + shift for bound in (before.mean, before.low, before.high)]
    assert (after.mean, after.low, after.high) == pytest.approx(expected, abs=1e-9)
    assert after.std == pytest.approx(before.std * scale, abs=1e-9)


# Where there is none


@pytest.mark.parametrize(("runs", "scenes", "bounded"), [(2, 3, True), (2, 2, False), (1, 20, False), (3, 1, False)])
def test_mean_interval_needs_enough_scenes_and_runs(runs, scenes, bounded):
    values = np.random.default_rng(0).random((runs, 2 * scenes))
    interval = mean_interval(values, scenes_of(scenes, 2))
    assert interval.mean == pytest.approx(values.mean())
    assert interval.has_bounds == bounded
    assert math.isnan(interval.std) == (runs == 1)


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
    # 95 % of 300 draws are 285 +- 3.8; 90 % is six standard errors below.
    assert coverage(jackknifed, size, draws=300) >= 0.90


@pytest.mark.slow
def test_episode_bootstrap_has_too_low_coverage():
    assert coverage(episode_bootstrap, (20, 3), draws=60) < 0.85


def test_run_clusters_leave_runs_out_within_their_arm():
    runs = run_clusters(3, 3)
    assert runs.degrees_of_freedom == 4
    np.testing.assert_allclose(runs.weights[:, 1], [0, 1.5, 1.5, 1, 1, 1])


# Statistics of runs and floor plans


def test_interquartile_mean_is_that_of_the_middle_half():
    # Of 0, 1, ..., 7 the middle half is 2, 3, 4 and 5, however far the greatest value is from the rest.
    for greatest in (7.0, 1000.0):
        values = np.array([[0.0, 1, 2, 3, 4, 5, 6, greatest]])
        assert interquartile_mean(values, scenes_of(8), trained=False).mean == pytest.approx(3.5)
    # Of five values, the quartiles cut the second and the fourth: (0.75 * 2 + 3 + 0.75 * 9) / 2.5 = 4.5.
    assert interquartile_mean(np.array([[9.0, 1, 2, 3, 50]]), scenes_of(5), trained=False).mean == pytest.approx(4.5)


def test_interquartile_mean_takes_runs_and_floor_plans_together():
    # Each plan has two episodes. Plan means of the runs: 0, 1, 2, 3 and 4, 5, 6, 7; the middle half is 2 to 5.
    plan_means = np.array([[0.0, 1, 2, 3], [4, 5, 6, 7]])
    values = np.repeat(plan_means, 2, axis=1) + np.array([[-0.25, 0.25] * 4] * 2)
    interval = interquartile_mean(values, scenes_of(4, 2))
    assert interval.mean == pytest.approx(3.5)
    assert interval.low < 3.5 < interval.high


@given(st.lists(st.integers(-50, 50), min_size=8, max_size=8))
def test_interquartile_mean_is_scipys_trimmed_mean(numbers):
    interval = interquartile_mean(np.array([numbers], float), scenes_of(8), trained=False)
    assert interval.mean == pytest.approx(trim_mean(numbers, 0.25))


def test_probability_of_improvement_counts_pairs_of_runs():
    # Of the four pairs of runs, 2 > 1, 4 > 1 and 4 > 3; 2 < 3.
    reference = np.repeat([[1.0], [3]], 4, axis=1)
    compared = np.repeat([[2.0], [4]], 4, axis=1)
    assert probability_of_improvement(reference, compared, scenes_of(4)).mean == pytest.approx(3 / 4)
    # The same networks are compared with themselves alone: 2 > 1 and 4 > 3.
    assert probability_of_improvement(reference, compared, scenes_of(4), same_runs=True).mean == pytest.approx(1.0)


def test_probability_of_improvement_counts_plans_alike_and_ties_half():
    # Better on one plan by a lot, worse on two by little, equal on the last: (1 + 0 + 0 + 0.5) / 4.
    reference = np.array([[0.0, 1, 1, 1]])
    compared = np.array([[100.0, 0.9, 0.9, 1]])
    interval = probability_of_improvement(reference, compared, scenes_of(4), trained=False)
    assert interval.mean == pytest.approx(1.5 / 4)
    # Values 1, 0, 0 and 0.5 of four plans: the variance of their mean is 0.2292 / 4, with 3 degrees of freedom.
    assert half_width(interval) == pytest.approx(t.ppf(0.975, 3) * math.sqrt(np.var([1, 0, 0, 0.5], ddof=1) / 4))


@given(st.integers(0, 2**32 - 1))
def test_improvements_of_both_sides_add_up_to_one(seed):
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 3, (2, 3, 12)).astype(float)
    scenes = leave_one_out(np.repeat(np.arange(4), 3))
    forth = probability_of_improvement(first, second, scenes)
    back = probability_of_improvement(second, first, scenes)
    assert forth.mean + back.mean == pytest.approx(1.0)
    assert forth.low == pytest.approx(1.0 - back.high)


def test_new_statistics_of_one_scene_or_run_have_no_bounds():
    values = np.ones((1, 6))
    for scenes in (scenes_of(1, 6), scenes_of(6)):
        assert not interquartile_mean(values, scenes).has_bounds
        assert not probability_of_improvement(values, values, scenes).has_bounds
        assert probability_of_improvement(values, values, scenes).mean == pytest.approx(0.5)
